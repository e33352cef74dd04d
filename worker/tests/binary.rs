//! `farm-worker` as a process: ready line, signals, exit codes.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{
    io::{BufRead as _, BufReader},
    net::{TcpListener, UdpSocket},
    process::{Child, ChildStderr, ChildStdout, Command, Stdio},
};

use coordinator::CoordinatorOptions;

fn command(flags: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_farm-worker"));
    command.args(flags).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    for (variable, _) in std::env::vars_os() {
        if variable.to_string_lossy().starts_with("GLEANER_") {
            command.env_remove(variable);
        }
    }
    command
}

/// A worker that ends with the test.
struct Running {
    child: Child,
    ready: serde_json::Value,
    // Kept open: a closed pipe would disturb the process.
    _stdout: BufReader<ChildStdout>,
    stderr: ChildStderr,
}

impl Running {
    fn start(mut command: Command) -> Self {
        let mut child = command.spawn().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut stderr = child.stderr.take().unwrap();
        let mut line = String::new();
        stdout.read_line(&mut line).unwrap();
        if line.is_empty() {
            panic!("no ready line; stderr:\n{}", std::io::read_to_string(&mut stderr).unwrap());
        }
        Self { child, ready: serde_json::from_str(&line).unwrap(), _stdout: stdout, stderr }
    }

    fn terminate(mut self) -> (Option<i32>, String) {
        let sent = Command::new("kill").arg("-TERM").arg(self.child.id().to_string()).status().unwrap();
        assert!(sent.success(), "kill was sent");
        let code = self.child.wait().unwrap().code();
        (code, std::io::read_to_string(&mut self.stderr).unwrap())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // Already over in the good case.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Starts a worker, lets it register, and drains it; gives its ready line and its log.
async fn registered_and_drained(devices: &'static [&'static str]) -> (serde_json::Value, String) {
    let coordinator = coordinator::start(CoordinatorOptions::embedded()).await.unwrap();
    let address = coordinator.grpc_addr().to_string();
    let dialled = address.clone();
    let running = tokio::task::spawn_blocking(move || {
        let mut flags = vec!["--coordinator", dialled.as_str(), "--name", "w"];
        flags.extend(devices.iter().flat_map(|device| ["--device", *device]));
        Running::start(command(&flags))
    });
    let running = running.await.unwrap();
    let ready = running.ready.clone();
    let status = proto::control::status(&address, None).await.unwrap();
    assert_eq!(status.nodes.len(), 1, "it is registered when it says so");
    assert_eq!(serde_json::json!(status.nodes[0].node.to_string()), ready["node"], "under its own name");
    let (code, stderr) = tokio::task::spawn_blocking(|| running.terminate()).await.unwrap();
    assert_eq!(code, Some(0), "stderr:\n{stderr}");
    assert!(proto::control::status(&address, None).await.unwrap().nodes.is_empty(), "it said goodbye");
    coordinator.shutdown().await;
    (ready, stderr)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn it_says_what_it_gives_and_drains_on_sigterm() {
    let (ready, stderr) = registered_and_drained(&["sim:score=5", "sim:score=6,speed=2"]).await;
    assert_eq!(ready["event"], "ready");
    assert_eq!(ready["name"], "w");
    assert!(ready["data"].as_str().unwrap().starts_with("127.0.0.1:"), "{ready}");
    let devices = ready["devices"].as_array().unwrap();
    assert_eq!(devices.len(), 2);
    assert_eq!((devices[0]["kind"].as_str(), devices[1]["score"].as_f64()), (Some("sim"), Some(6.0)));
    assert!(stderr.contains("draining"), "the log goes to stderr:\n{stderr}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_real_device_is_closed_before_the_process_ends() {
    let (ready, _) = registered_and_drained(&["all"]).await;
    let devices = ready["devices"].as_array().unwrap();
    assert!(devices[0]["score"].as_f64().unwrap() > 0.0, "{ready}");
    assert_ne!(devices[0]["kind"], "sim");
}

#[test]
fn mistakes_exit_with_a_code_and_a_place() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("broken.toml");
    std::fs::write(&config, "coordinator = '127.0.0.1:1'\nno_such_setting = 1\n").unwrap();
    let config = config.to_str().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    let file = file.to_str().unwrap();
    // A port that was free a moment ago: nobody answers there.
    let silent = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let taken = UdpSocket::bind("127.0.0.1:0").unwrap();
    let listen = taken.local_addr().unwrap().to_string();
    let sim = ["--device", "sim", "--connect-timeout", "300ms", "--coordinator", &silent];
    let with = |flags: &[&'static str]| [sim.as_slice(), flags].concat();
    let cases: [(Vec<&str>, i32, &[&str]); 8] = [
        (vec!["--no-such-flag"], 2, &["--no-such-flag"]),
        (vec![], 2, &["--coordinator"]),
        (vec!["--config", config], 2, &["broken.toml", "no_such_setting", "line 2"]),
        (vec!["--coordinator", "nonsense"], 2, &["coordinator", "nonsense"]),
        (with(&["--device", "tpu"]), 2, &["tpu", "expected all"]),
        (with(&[]), 3, &[&silent, "cannot be reached", "300ms"]),
        ([sim.as_slice(), &["--listen", &listen]].concat(), 1, &[&listen, "in use"]),
        ([sim.as_slice(), &["--cache", file]].concat(), 1, &["cache folder", file]),
    ];
    for (flags, code, parts) in cases {
        let output = command(&flags).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{flags:?}: {stderr}");
        for part in parts {
            assert!(stderr.contains(part), "{flags:?}: {part:?} is missing in: {stderr}");
        }
        assert!(output.stdout.is_empty(), "{flags:?}: no ready line");
    }
}
