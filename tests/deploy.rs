//! What `deploy/` ships works with the binaries of today: sample configuration, units, compose file.

#![allow(clippy::unwrap_used, reason = "a panic in a test is its failure, also in its helpers")]

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use tempfile::TempDir;
use tests::{Process, Signal, binary};

fn deploy(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().join("deploy").join(file)
}

#[test]
fn daemons_start_from_the_sample_configuration() {
    let coordinator_config = deploy("config/coordinator.toml").display().to_string();
    let state = TempDir::new().unwrap();
    let state_path = state.path().display().to_string();
    // Flags come after the file: the ports here must be free ones.
    let mut coordinator = Process::start(
        "farm-coordinator",
        [
            "--config",
            &coordinator_config,
            "--listen",
            "127.0.0.1:0",
            "--http",
            "127.0.0.1:0",
            "--state",
            &state_path,
        ],
    );
    let ready = coordinator.next_json();
    assert_eq!(ready["event"], "ready", "{ready}");
    let grpc = ready["grpc"].as_str().unwrap().to_owned();

    let worker_config = deploy("config/worker.toml").display().to_string();
    let cache = state.path().join("cache").display().to_string();
    let worker_flags =
        ["--config", &worker_config, "--coordinator", &grpc, "--listen", "127.0.0.1:0", "--cache", &cache];
    let simulated = ["--device", "sim:score=1,speed=1"];
    let mut worker = Process::start("farm-worker", worker_flags.iter().chain(&simulated));
    let ready = worker.next_json();
    assert_eq!(ready["event"], "ready", "{ready}");

    for daemon in [worker, coordinator] {
        daemon.signal(Signal::Term);
        let (status, stderr) = daemon.finish();
        assert!(status.success(), "{status}; stderr:\n{stderr}");
    }
}

#[test]
fn an_unknown_setting_is_refused_at_its_place() {
    // Negative control of the test above: the files are read.
    let folder = TempDir::new().unwrap();
    for (daemon, sample) in
        [("farm-coordinator", "config/coordinator.toml"), ("farm-worker", "config/worker.toml")]
    {
        let text = fs::read_to_string(deploy(sample)).unwrap();
        let broken = folder.path().join("broken.toml");
        fs::write(&broken, format!("no_such_setting = 1\n{text}")).unwrap();
        let output = Command::new(binary(daemon))
            .arg("--config")
            .arg(&broken)
            .env_remove("GLEANER_COORDINATOR")
            .output()
            .unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success(), "{daemon} took an unknown setting");
        assert!(stderr.contains("no_such_setting") && stderr.contains("broken.toml"), "{daemon}: {stderr}");
    }
}

#[test]
fn units_are_what_systemd_accepts() {
    if Command::new("systemd-analyze").arg("--version").output().is_err() {
        eprintln!("skipped: systemd-analyze is not installed");
        return;
    }
    let folder = TempDir::new().unwrap();
    for (unit, daemon) in
        [("gleaner-coordinator.service", "farm-coordinator"), ("gleaner-worker.service", "farm-worker")]
    {
        let text = fs::read_to_string(deploy("systemd").join(unit)).unwrap();
        let installed = format!("ExecStart=/usr/local/bin/{daemon} ");
        assert!(text.contains(&installed), "{unit} starts {daemon}");
        let here = text.replace(&installed, &format!("ExecStart={} ", binary(daemon).display()));
        let verdict = |text: &str| {
            let path = folder.path().join(unit);
            fs::write(&path, text).unwrap();
            let output =
                Command::new("systemd-analyze").arg("verify").arg("--man=no").arg(&path).output().unwrap();
            (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
        };
        let (accepted, complaints) = verdict(&here);
        let ours: Vec<&str> = complaints.lines().filter(|line| line.contains(unit)).collect();
        assert!(accepted && ours.is_empty(), "{unit}: {complaints}");
        let (_, complaints) = verdict(&here.replace("ProtectSystem=", "ProtectSytem="));
        assert!(complaints.contains("ProtectSytem"), "negative control: {complaints}");
    }
}
