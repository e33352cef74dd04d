//! `farmctl` as scripts and people meet it: exit codes, error texts that name the place, JSON.

use std::{
    fs,
    io::{BufRead as _, BufReader},
    net::TcpListener,
    process::{Command, Stdio},
};

use serde_json::Value;
use tempfile::TempDir;
use tests::{Farm, Process, command, farmctl};

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// A loopback address on which nobody listens: bound once, then let go.
fn dead_address() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    listener.local_addr().expect("bound").to_string()
}

#[test]
fn status_shows_nodes_and_devices_as_json() {
    let mut farm = Farm::coordinator();
    farm.add_worker("sim:score=1000,speed=1.0");
    let output = farmctl(["--coordinator", &farm.grpc, "-o", "json", "status"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let status: Value = serde_json::from_slice(&output.stdout).expect("JSON on stdout");
    assert_eq!(status["nodes"][0]["name"], "w0", "{status}");
    assert_eq!(status["nodes"][0]["devices"][0]["score"], 1000.0, "{status}");
}

#[test]
fn a_farm_whose_own_worker_was_drained_says_so_and_ends_in_order() {
    let mut up = command("farmctl")
        .args(["up", "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"])
        .args(["--device", "sim:score=1000,speed=1.0"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("farmctl starts");
    let mut ready = String::new();
    BufReader::new(up.stdout.take().expect("it is piped")).read_line(&mut ready).expect("a line comes");
    let ready: Value = serde_json::from_str(&ready).expect("JSON");
    let grpc = ready["grpc"].as_str().expect("an address");
    let status = farmctl(["--coordinator", grpc, "-o", "json", "status"]);
    let status: Value = serde_json::from_slice(&status.stdout).expect("JSON on stdout");
    let node = status["nodes"][0]["node"].as_str().expect("as the table shows it");
    assert!(farmctl(["--coordinator", grpc, "node", "drain", node]).status.success());
    // The runner ends a test that hangs.
    let mut told = BufReader::new(up.stderr.take().expect("it is piped")).lines().map_while(Result::ok);
    assert!(told.any(|line| line.contains("has left (it was drained)")));
    let asked = Command::new("sh").args(["-c", &format!("kill {}", up.id())]).status();
    assert!(asked.expect("a shell is there").success());
    assert!(up.wait().expect("it ends").success());
}

/// `farmctl status --watch | head -1`: once nobody reads, it ends.
#[test]
fn a_watch_ends_when_its_reader_does() {
    let farm = Farm::coordinator();
    let mut watch = command("farmctl")
        .args(["--coordinator", &farm.grpc, "status", "--watch", "100ms"])
        .stdout(Stdio::piped())
        .spawn()
        .expect("farmctl starts");
    let mut line = String::new();
    let mut reader = BufReader::new(watch.stdout.take().expect("it is piped"));
    reader.read_line(&mut line).expect("a line comes");
    assert!(line.starts_with("EMPTY"), "no codes for a screen that is none: {line:?}");
    drop(reader);
    // The runner ends a test that hangs.
    assert!(watch.wait().expect("it ends").success());
}

#[test]
fn an_unreachable_coordinator_is_exit_code_3_and_named() {
    let address = dead_address();
    let output = farmctl(["--coordinator", &address, "status"]);
    assert_eq!(output.status.code(), Some(3), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains(&address), "{}", text(&output.stderr));
}

#[test]
fn a_worker_without_coordinator_is_exit_code_3_and_names_it() {
    let address = dead_address();
    let worker = Process::start(
        "farm-worker",
        ["--coordinator", &address, "--device", "sim", "--connect-timeout", "1s"],
    );
    let (status, stderr) = worker.finish();
    assert_eq!(status.code(), Some(3), "{stderr}");
    assert!(stderr.contains(&address), "{stderr}");
}

#[test]
fn a_taken_port_is_named() {
    let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = taken.local_addr().expect("bound").to_string();
    let coordinator = Process::start("farm-coordinator", ["--listen", &address, "--http", "127.0.0.1:0"]);
    let (status, stderr) = coordinator.finish();
    assert_eq!(status.code(), Some(1), "{stderr}");
    assert!(stderr.contains(&address), "{stderr}");
}

#[test]
fn bad_renders_name_the_place_and_leave_no_image() {
    let folder = TempDir::new().expect("a temporary folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    let write = |name: &str, scene_toml: &str, obj: &str| {
        let scene = folder.path().join(name);
        fs::create_dir(&scene).expect("a new folder");
        fs::write(scene.join("scene.toml"), scene_toml).expect("written");
        fs::write(scene.join("a.obj"), obj).expect("written");
        scene.display().to_string()
    };
    let toml = |extra: &str| {
        format!(
            "geometry = [\"a.obj\"]\n[film]\nwidth = 8\nheight = 8\n[camera]\neye = [0, 0, 5]\ntarget = [0, 0, 0]\n\
             up = [0, 1, 0]\nhfov_deg = 40\n[environment]\nradiance = [1, 1, 1]\n{extra}"
        )
    };
    let triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
    let cases = [
        ("missing", path("nowhere"), vec!["nowhere"]),
        ("empty", write("empty", &toml(""), ""), vec!["a.obj"]),
        ("nan", write("nan", &toml(""), "v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n"), vec!["a.obj", "2"]),
        ("index", write("index", &toml(""), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"), vec!["a.obj", "4"]),
        ("key", write("key", &toml("[film2]\nx = 1\n"), triangle), vec!["scene.toml", "film2"]),
        (
            "type",
            write("type", &toml("[materials.\"A\"]\ntype = \"velvet\"\n"), triangle),
            vec!["scene.toml", "velvet"],
        ),
        (
            "light",
            write("light", &toml("").replace("[environment]\nradiance = [1, 1, 1]\n", ""), triangle),
            vec!["light"],
        ),
        (
            "size",
            write("size", &toml("").replace("width = 8", "width = 0"), triangle),
            vec!["scene.toml", "width"],
        ),
    ];
    for (name, scene, places) in cases {
        let image = path(&format!("{name}.png"));
        let output = farmctl(["render", &scene, "-o", &image, "--spp", "1"]);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{name}: {stderr}");
        for place in places {
            assert!(stderr.contains(place), "{name}: {place:?} is not named in {stderr}");
        }
        assert!(!fs::exists(&image).expect("readable"), "{name}: an image was left");
    }
}

#[test]
fn an_unwritable_output_is_refused_before_rendering() {
    let folder = TempDir::new().expect("a temporary folder");
    let scene = folder.path().join("cornell").display().to_string();
    assert!(farmctl(["scene", "cornell-box", &scene]).status.success(), "a scene is written");
    for output in ["/proc/nowhere/image.png", "/nonexistent-folder/image.exr"] {
        let done = farmctl(["render", &scene, "-o", output, "--spp", "100000"]);
        assert_eq!(done.status.code(), Some(1), "{}", text(&done.stderr));
        assert!(text(&done.stderr).contains(output), "{}", text(&done.stderr));
    }
}

#[test]
fn a_folder_that_takes_no_results_is_refused_before_computing() {
    let folder = TempDir::new().expect("a temporary folder");
    let alignment = folder.path().join("a.txt");
    fs::write(&alignment, "ACDE\nACCE\n").expect("the folder can be written");
    let alignment = alignment.display().to_string();
    // Nobody can write there, and nobody answers: the folder is looked at first.
    let run = farmctl(["--coordinator", &dead_address(), "mi", &alignment, "-o", "/proc"]);
    assert_eq!(run.status.code(), Some(1), "{}", text(&run.stderr));
    assert!(text(&run.stderr).contains("/proc"), "{}", text(&run.stderr));
}

#[test]
fn wrong_usage_is_exit_code_2() {
    for arguments in [
        vec!["fly-to-the-moon"],
        vec!["render"],
        vec!["render", "x", "-o", "x.png", "--size", "0x0"],
        vec!["render", "x", "-o", "x.bmp"],
        vec!["render", "x", "-o", "x.png", "--exposure", "nan"],
        vec!["--coordinator", "http://127.0.0.1:1", "status"],
    ] {
        let output = farmctl(&arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", text(&output.stderr));
    }
}

#[test]
fn a_farm_of_its_own_that_can_never_render_ends() {
    let folder = TempDir::new().expect("a temporary folder");
    let scene = folder.path().join("cornell").display().to_string();
    assert!(farmctl(["scene", "cornell-box", &scene]).status.success(), "a scene is written");
    let image = folder.path().join("image.png").display().to_string();
    let output = farmctl(["render", &scene, "-o", &image, "--spp", "1", "--device", "sim"]);
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("no device"), "{}", text(&output.stderr));
}

#[test]
fn version_is_printed() {
    let output = farmctl(["version"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(text(&output.stdout).contains(env!("CARGO_PKG_VERSION")), "{}", text(&output.stdout));
}
