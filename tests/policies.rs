//! Placement policies through real processes: the shipped plug-in, one that crashes, one that is not there.

use std::{fs, path::Path, process::Command};

use serde_json::Value;
use tempfile::TempDir;
use tests::{Farm, farmctl};

/// A folder of plug-ins, the scene to render, and a coordinator with one lavapipe worker that knows them.
fn farm(folder: &TempDir) -> (Farm, String) {
    let plugins = folder.path().join("plugins");
    fs::create_dir(&plugins).expect("a fresh folder");
    let coordinator = Path::new(env!("CARGO_MANIFEST_DIR")).join("../coordinator");
    let compile = |source: &Path, name: &str| {
        let status = Command::new("cc")
            .args(["-shared", "-fPIC", "-O1", "-I"])
            .arg(coordinator.join("include"))
            .arg(source)
            .arg("-o")
            .arg(plugins.join(name))
            .status()
            .expect("a C compiler is there wherever Rust links");
        assert!(status.success(), "{name} compiles");
    };
    compile(&coordinator.join("plugin-example/spread.c"), "spread.so");
    let crash = folder.path().join("crash.c");
    fs::write(
        &crash,
        "#include <stdlib.h>\n#include \"gleaner_policy_v1.h\"\n\
         static int32_t place(const gleaner_batch_v1 *b, gleaner_choice_v1 *c) { (void)b; (void)c; abort(); }\n\
         const struct gleaner_policy_v1 gleaner_policy_v1 =\n\
         { GLEANER_POLICY_ABI_V1, sizeof(struct gleaner_policy_v1), \"crashes\", place };\n",
    )
    .expect("the folder is ours");
    compile(&crash, "crash.so");

    let config = folder.path().join("coordinator.toml");
    fs::write(&config, format!("plugins = {:?}\n", plugins.display().to_string()))
        .expect("the folder is ours");
    let mut farm = Farm::coordinator_with(&["--config", &config.display().to_string()]);
    assert_eq!(farm.add_worker("cpu")["event"], "ready", "the worker serves");
    let scene = folder.path().join("cornell").display().to_string();
    assert!(farmctl(["scene", "cornell-box", &scene]).status.success(), "the scene is written");
    (farm, scene)
}

fn render(farm: &Farm, scene: &str, policy: &str, image: &Path) -> (bool, String) {
    let image = image.display().to_string();
    let fixed = ["--coordinator", &farm.grpc, "render", scene, "-o", &image, "--size", "64x64", "--spp", "2"];
    let output = farmctl(fixed.iter().chain(&["--policy", policy]));
    (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
}

fn fallbacks(farm: &Farm) -> u64 {
    let output = farmctl(["--coordinator", &farm.grpc, "-o", "json", "status"]);
    let status: Value = serde_json::from_slice(&output.stdout).expect("the status is JSON");
    status["policy_fallbacks"].as_u64().expect("a count")
}

#[test]
fn a_plug_in_places_a_crashing_one_is_passed_over_and_an_unknown_one_is_named() {
    let folder = TempDir::new().expect("a temporary folder");
    let (farm, scene) = farm(&folder);
    let image = |name: &str| folder.path().join(name);
    for policy in ["fcfs", "history", "spread"] {
        let (done, stderr) = render(&farm, &scene, policy, &image(&format!("{policy}.exr")));
        assert!(done, "{policy}: {stderr}");
        assert_eq!(fallbacks(&farm), 0, "{policy} answers by itself");
    }
    let (done, stderr) = render(&farm, &scene, "crash", &image("crash.exr"));
    assert!(done, "first come, first served instead: {stderr}");
    assert!(fallbacks(&farm) > 0, "and it is counted");
    let bytes = |name: &str| fs::read(image(name)).expect("the image is there");
    assert!(bytes("fcfs.exr") == bytes("crash.exr"), "where a job runs does not show in the image");
    let (done, stderr) = render(&farm, &scene, "nonesuch", &image("none.exr"));
    assert!(!done && stderr.contains("`nonesuch`") && stderr.contains("spread"), "{stderr}");
}
