//! Two coordinators that share a state directory, as real processes: one leads, one stands by (docs/standby.md).

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{
    fs,
    net::TcpListener,
    path::Path,
    thread,
    time::{Duration, Instant},
};

use tests::{Process, Signal, farmctl};

/// A port that was free a moment ago: who stands by listens later, and its clients have to know where.
fn free_address() -> String {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string()
}

fn coordinator(address: &str, state: &Path) -> Process {
    let state = state.to_str().unwrap();
    let flags = ["--standby", "--listen", address, "--http", "127.0.0.1:0", "--state", state];
    let mut process = Process::start("farm-coordinator", flags);
    assert_eq!(process.next_json()["event"], "standby", "before it waits");
    process
}

fn render(coordinators: &str, scene: &str, image: &Path) -> Process {
    let image = image.to_str().unwrap();
    let what = ["--size", "160x128", "--spp", "32", "--seed", "7", "--progress", "ndjson"];
    let fixed = ["--coordinator", coordinators, "render", scene, "-o", image];
    Process::start("farmctl", fixed.iter().chain(&what))
}

fn finish(render: Process, image: &Path) -> Vec<u8> {
    let (status, stderr) = render.finish();
    assert!(status.success(), "{status}; stderr:\n{stderr}");
    fs::read(image).unwrap()
}

/// Scenario 7: the leader is stopped (SIGSTOP), a standby leads, what runs goes on, what is new is planned; the old leader ends
/// once it can see what has become of it.
#[test]
fn s07_a_standby_leads_when_the_leader_is_stopped() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let anywhere = ["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0", "--standby", "--state"];
    let unmounted = Process::start("farm-coordinator", anywhere.iter().copied().chain(state.to_str()));
    let (status, stderr) = unmounted.finish();
    assert_eq!(status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("state directory") && stderr.contains("No such file"), "{stderr}");
    fs::create_dir(&state).unwrap();
    let scene = folder.path().join("cornell").display().to_string();
    assert!(farmctl(["scene", "cornell-box", &scene]).status.success());
    let (first_address, second_address) = (free_address(), free_address());
    let coordinators = format!("{first_address},{second_address}");
    let mut first = coordinator(&first_address, &state);
    assert_eq!(first.next_json()["event"], "ready");
    let mut second = coordinator(&second_address, &state);
    let workers: Vec<Process> = ["a", "b"]
        .map(|name| {
            let flags = ["--coordinator", &coordinators, "--name", name, "--device", "cpu"];
            Process::start("farm-worker", flags)
        })
        .into();
    let quiet_image = folder.path().join("quiet.exr");
    let quiet = finish(render(&coordinators, &scene, &quiet_image), &quiet_image);

    let standbys = || {
        let status = farmctl(["--coordinator", &coordinators, "-o", "json", "status"]);
        serde_json::from_slice::<serde_json::Value>(&status.stdout).unwrap()["standbys"].clone()
    };
    let seen = |who: &serde_json::Value| who[0].as_str().is_some_and(|who| who.starts_with("process "));
    let came = Instant::now();
    while !seen(&standbys()) {
        assert!(
            came.elapsed() < Duration::from_secs(30),
            "the one that stands by is shown after two heartbeats"
        );
        thread::sleep(Duration::from_millis(100));
    }
    let running_image = folder.path().join("running.exr");
    let mut running = render(&coordinators, &scene, &running_image);
    running.wait_for(|line| line["jobs_done"].as_u64().is_some_and(|done| done >= 2));
    first.signal(Signal::Stop);
    let stopped = Instant::now();
    assert_eq!(second.next_json()["event"], "ready");
    let led = stopped.elapsed();
    assert!(finish(running, &running_image) == quiet, "what was planned goes on");
    let new_image = folder.path().join("new.exr");
    let mut new = render(&coordinators, &scene, &new_image);
    new.wait_for(|line| line["jobs_done"].as_u64().is_some_and(|done| done >= 1));
    println!(
        "a standby leads: {led:.1?} after the stop, first new result after {:.1?} (20 s)",
        stopped.elapsed()
    );
    assert!(finish(new, &new_image) == quiet, "what is new is computed under the standby");

    first.signal(Signal::Continue);
    let (status, stderr) = first.finish();
    assert_eq!(status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("another coordinator has taken the farm over"), "{stderr}");
    assert!(!stderr.contains('\x1b'), "a log that is no terminal has no colours: {stderr}");
    assert_eq!(standbys(), serde_json::json!([]), "it leads, and nobody stands by");

    // And back: the other one stands by again, and the leader's process is killed.
    let mut first = coordinator(&first_address, &state);
    second.signal(Signal::Kill);
    assert_eq!(first.next_json()["event"], "ready");
    let last_image = folder.path().join("last.exr");
    assert!(finish(render(&coordinators, &scene, &last_image), &last_image) == quiet);
    drop(workers);
}
