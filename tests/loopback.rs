//! The whole farm as real processes on 127.0.0.1: a coordinator, workers on lavapipe, `farmctl` as the application.
//! Whatever happens to the workers, the image is byte for byte the undisturbed one.

use std::{collections::BTreeMap, fs, path::Path};

use client_sdk::Journal;
use farm_core::id::AppId;
use serde_json::Value;
use tempfile::TempDir;
use tests::{Farm, Process, Signal, farmctl};

/// Small enough for lavapipe, large enough for many jobs (a 3 x 2 raster of tiles, several sample slices).
const RENDER: [&str; 6] = ["--size", "160x128", "--spp", "32", "--seed", "7"];

fn cornell(folder: &TempDir) -> String {
    let scene = folder.path().join("cornell").display().to_string();
    let made = farmctl(["scene", "cornell-box", &scene]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    scene
}

fn start_render(farm: &Farm, scene: &str, image: &Path) -> Process {
    start_render_with(farm, scene, image, &[])
}

fn start_render_with(farm: &Farm, scene: &str, image: &Path, more: &[&str]) -> Process {
    let image = image.display().to_string();
    let fixed = ["--coordinator", &farm.grpc, "render", scene, "-o", &image, "--progress", "ndjson"];
    Process::start("farmctl", fixed.iter().chain(RENDER.iter()).chain(more))
}

fn finish_render(render: Process, image: &Path) -> Vec<u8> {
    let (status, stderr) = render.finish();
    assert!(status.success(), "{status}; stderr:\n{stderr}");
    fs::read(image).expect("a finished render leaves its image")
}

fn wait_until_jobs_done(render: &mut Process, jobs: u64) {
    render.wait_for(|line| {
        line["event"] == "progress" && line["jobs_done"].as_u64().is_some_and(|done| done >= jobs)
    });
}

#[test]
fn an_image_survives_a_killed_worker_and_a_joining_one_byte_for_byte() {
    let folder = TempDir::new().expect("a temporary folder");
    let scene = cornell(&folder);

    let quiet_image = folder.path().join("quiet.exr");
    let quiet_farm = Farm::with_cpu_workers(1);
    let quiet = finish_render(start_render(&quiet_farm, &scene, &quiet_image), &quiet_image);
    drop(quiet_farm);

    let image = folder.path().join("disturbed.exr");
    let mut farm = Farm::with_cpu_workers(3);
    let mut render = start_render(&farm, &scene, &image);
    wait_until_jobs_done(&mut render, 2);
    farm.workers[1].signal(Signal::Kill);
    farm.begin_worker("cpu");
    let disturbed = finish_render(render, &image);

    assert_eq!(quiet.len(), disturbed.len(), "the images differ in size");
    assert!(quiet == disturbed, "the images differ in bytes");
}

/// Scenario 9, as people see it: the application's process is killed in mid-render, and the same command goes on.
#[test]
fn a_render_that_was_killed_goes_on_from_its_journal_byte_for_byte() {
    let folder = TempDir::new().expect("a temporary folder");
    let scene = cornell(&folder);
    let farm = Farm::with_cpu_workers(2);
    let quiet_image = folder.path().join("quiet.exr");
    let quiet = finish_render(start_render(&farm, &scene, &quiet_image), &quiet_image);

    let image = folder.path().join("killed.exr");
    let journal = folder.path().join("killed.exr.gleaner-journal");
    let mut render = start_render_with(&farm, &scene, &image, &["--resume"]);
    // A result has some hundred kilobytes: some are whole.
    let written = || fs::metadata(&journal).map_or(0, |file| file.len());
    render
        .wait_for(|line| line["jobs_done"].as_u64().is_some_and(|done| done >= 24) && written() > 2_000_000);
    render.signal(Signal::Kill);
    let (status, _) = render.finish();
    assert!(!status.success() && !image.exists(), "it was killed before it wrote an image");
    let label = "render, 160x128 px, 32 spp, seed 7";
    let kept = Journal::open(&journal, label).expect("what a kill leaves can be used").results();
    assert!(kept > 0, "some results are in the journal");

    let mut resumed = start_render_with(&farm, &scene, &image, &["--resume"]);
    let done = resumed.wait_for(|line| line["event"] == "done");
    let (status, stderr) = resumed.finish();
    assert!(status.success(), "{status}; stderr:\n{stderr}");
    assert!(stderr.contains(&format!("{kept} results")), "what was taken over is said:\n{stderr}");
    assert_eq!(done["jobs_journalled"].as_u64(), Some(kept), "{done}");
    let (before, since) = completed_by_the_last_two(&farm);
    let ended_first = since.iter().map(|job| job.ended_at).min().expect("it had jobs left");
    let late = before.iter().filter(|job| job.started_at > ended_first).count();
    assert_eq!(late, 0, "of the killed render nothing begins any more");
    let jobs = done["jobs"].as_u64().expect("a number");
    let again = (before.len() + since.len()) as u64 - jobs;
    println!(
        "s09: {kept} of {jobs} jobs taken over, {again} computed again; bar: 5 %, or what is on the devices and on its way"
    );
    assert!(fs::read(&image).expect("the image is there") == quiet, "the images differ in bytes");
    assert!(!journal.exists(), "a journal is removed when the image is written");
}

/// When a job ran, on the coordinator's clock.
struct Ran {
    started_at: u64,
    ended_at: u64,
}

/// What the last two applications of a farm have completed.
fn completed_by_the_last_two(farm: &Farm) -> (Vec<Ran>, Vec<Ran>) {
    let output = farmctl(["--coordinator", &farm.grpc, "timeline", "@all", "-o", "json"]);
    let timeline: Value = serde_json::from_slice(&output.stdout).expect("the timeline is JSON");
    let mut of_apps: BTreeMap<AppId, Vec<Ran>> = BTreeMap::new();
    for segment in timeline["segments"].as_array().expect("segments") {
        let number = |value: &Value| value.as_u64().unwrap_or_else(|| panic!("a number in {segment}"));
        let ran = Ran { started_at: number(&segment["started_at"]), ended_at: number(&segment["ended_at"]) };
        if segment["outcome"] == "completed" {
            let app = segment["job"]["job"]["app"].as_str().expect("an id").parse().expect("as it is shown");
            of_apps.entry(app).or_default().push(ran);
        }
    }
    let (_, last) = of_apps.pop_last().expect("the last application");
    let (_, before) = of_apps.pop_last().expect("the one before it");
    (before, last)
}

#[test]
fn a_scene_that_was_changed_does_not_meet_old_results() {
    let folder = TempDir::new().expect("a temporary folder");
    let scene = cornell(&folder);
    let farm = Farm::with_cpu_workers(1);
    let image = folder.path().join("image.exr");
    let mut render = start_render_with(&farm, &scene, &image, &["--resume"]);
    wait_until_jobs_done(&mut render, 2);
    render.signal(Signal::Term);
    let (status, stderr) = render.finish();
    assert_eq!(status.code(), Some(1), "an incomplete image is not a success; stderr:\n{stderr}");
    assert!(stderr.contains("the same command goes on"), "what to do is said:\n{stderr}");

    // Another picture under the same name: refused with the reason and what to do, and nothing is lost.
    let other =
        ["--coordinator", &farm.grpc, "render", &scene, "-o", &image.display().to_string(), "--resume"];
    let refused = farmctl(other.iter().chain(&["--size", "32x32", "--spp", "2"]));
    let words = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(2), "{words}");
    assert!(words.contains("of another run") && words.contains("32x32") && words.contains("rm "), "{words}");

    let materials = folder.path().join("cornell");
    let materials =
        fs::read_dir(materials).expect("the scene's folder").map(|entry| entry.expect("a file").path());
    let materials = materials.into_iter().find(|path| path.extension().is_some_and(|end| end == "mtl"));
    let materials = materials.expect("the scene has materials");
    let text = fs::read_to_string(&materials).expect("the materials");
    let changed = text.replacen("Kd 0.", "Kd 0.0", 1);
    assert_ne!(text, changed, "a colour is darker now");
    fs::write(&materials, changed).expect("the folder is writable");
    let (status, stderr) = start_render_with(&farm, &scene, &image, &["--resume"]).finish();
    assert_eq!(status.code(), Some(2), "stderr:\n{stderr}");
    assert!(stderr.contains("of other inputs"), "the reason is said:\n{stderr}");

    fs::write(&materials, text).expect("the folder is writable");
    let mut resumed = start_render_with(&farm, &scene, &image, &["--resume"]);
    let done = resumed.wait_for(|line| line["event"] == "done");
    assert!(done["jobs_journalled"].as_u64().is_some_and(|jobs| jobs >= 2), "nothing was lost: {done}");
    assert!(resumed.finish().0.success(), "and the image is complete");
}

#[test]
fn another_seed_gives_another_image() {
    // Negative control of the byte comparisons above.
    let folder = TempDir::new().expect("a temporary folder");
    let scene = cornell(&folder);
    let render = |seed: &str| {
        let image = folder.path().join(format!("seed-{seed}.exr"));
        let path = image.display().to_string();
        let done = farmctl(["render", &scene, "-o", &path, "--size", "32x32", "--spp", "2", "--seed", seed]);
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        fs::read(image).expect("the image is there")
    };
    assert_ne!(render("1"), render("2"));
}

#[test]
fn an_interrupted_render_saves_a_partial_image_and_says_so() {
    let folder = TempDir::new().expect("a temporary folder");
    let scene = cornell(&folder);
    let farm = Farm::with_cpu_workers(1);
    let image = folder.path().join("partial.exr");
    let finished = folder.path().join("finished.png");
    fs::write(&finished, "of an earlier render").expect("a file");
    let mut render = start_render_with(&farm, &scene, &image, &["-o", &finished.display().to_string()]);
    // Past the light paths, which alone are no picture: some of the 64 jobs are tiles by now.
    wait_until_jobs_done(&mut render, 24);
    render.signal(Signal::Int);
    let (status, stderr) = render.finish();
    assert_eq!(status.code(), Some(1), "an incomplete image is not a success; stderr:\n{stderr}");
    assert!(stderr.contains("partial"), "stderr does not say that the image is partial:\n{stderr}");
    assert!(fs::metadata(&image).is_ok_and(|file| file.len() > 0), "no partial image was saved");
    assert_eq!(fs::read(&finished).expect("it stays"), b"of an earlier render");
    assert!(folder.path().join("finished.partial.png").exists(), "stderr:\n{stderr}");
}

#[test]
fn sigterm_ends_every_daemon_in_order() {
    let mut farm = Farm::with_cpu_workers(1);
    let worker = farm.workers.pop().expect("one worker");
    worker.signal(Signal::Term);
    let (status, stderr) = worker.finish();
    assert_eq!(status.code(), Some(0), "worker stderr:\n{stderr}");
    farm.coordinator.signal(Signal::Term);
    let (status, stderr) = farm.coordinator.finish();
    assert_eq!(status.code(), Some(0), "coordinator stderr:\n{stderr}");
}

#[test]
fn a_stranger_kernel_runs_through_the_sdk() {
    let farm = Farm::with_cpu_workers(2);
    let example = Process::start("examples/vector_add", ["--coordinator", &farm.grpc]);
    let (status, stderr) = example.finish();
    assert!(status.success(), "{status}; stderr:\n{stderr}");
}
