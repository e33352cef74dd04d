//! `farm-coordinator` as a process: ready line, signals, exit codes.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{
    io::{BufRead as _, BufReader},
    process::{Child, ChildStderr, ChildStdout, Command, Stdio},
};

fn command(flags: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_farm-coordinator"));
    command.args(flags).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    for (variable, _) in std::env::vars_os() {
        if variable.to_string_lossy().starts_with("GLEANER_") {
            command.env_remove(variable);
        }
    }
    command
}

/// A coordinator that ends with the test.
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
        let stderr = child.stderr.take().unwrap();
        let mut line = String::new();
        stdout.read_line(&mut line).unwrap();
        Self { child, ready: serde_json::from_str(&line).unwrap(), _stdout: stdout, stderr }
    }

    fn address(&self, key: &str) -> String {
        self.ready[key].as_str().unwrap().to_owned()
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

const ANY_PORTS: [&str; 4] = ["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"];

#[tokio::test]
async fn it_says_where_it_serves_and_ends_on_sigterm() {
    let running = Running::start(command(&ANY_PORTS));
    assert_eq!(running.ready["event"], "ready");
    // An open session does not hold the end up.
    let mut session = proto::control::connect_node(&running.address("grpc"), None).await.unwrap();
    assert!(proto::control::status(&running.address("grpc"), None).await.is_ok(), "it serves");
    let (code, stderr) = tokio::task::spawn_blocking(|| running.terminate()).await.unwrap();
    assert_eq!(code, Some(0), "stderr:\n{stderr}");
    assert!(stderr.contains("coordinator started"), "the log goes to stderr:\n{stderr}");
    assert!(session.receiver.recv().await.is_err(), "the session ended");
}

#[tokio::test]
async fn lives_are_counted_in_the_state_directory() {
    let state = tempfile::tempdir().unwrap();
    for expected in 1..=2 {
        let mut command = command(&ANY_PORTS);
        command.env("GLEANER_STATE", state.path());
        let running = Running::start(command);
        let status = proto::control::status(&running.address("grpc"), None).await.unwrap();
        assert_eq!(status.epoch.0, expected);
        let (code, stderr) = tokio::task::spawn_blocking(|| running.terminate()).await.unwrap();
        assert_eq!(code, Some(0), "stderr:\n{stderr}");
    }
}

#[test]
fn mistakes_exit_with_a_code_and_a_place() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("broken.toml");
    std::fs::write(&config, "listen = '127.0.0.1:0'\nno_such_setting = 1\n").unwrap();
    let config = config.to_str().unwrap();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let taken = taken.local_addr().map(|address| (address.to_string(), taken)).unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    let file = file.to_str().unwrap();
    let cases: [(&[&str], i32, &[&str]); 6] = [
        (&["--no-such-flag"], 2, &["--no-such-flag"]),
        (&["--listen", "nonsense"], 2, &["listen", "nonsense"]),
        (&["--config", config], 2, &["broken.toml", "no_such_setting", "line 2"]),
        (&["--insecure", "--listen", "0.0.0.0:0"], 2, &["--insecure", "0.0.0.0:0"]),
        (&["--listen", &taken.0, "--http", "127.0.0.1:0"], 1, &["gRPC", &taken.0, "in use"]),
        (
            &["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0", "--state", file],
            1,
            &["state directory", file],
        ),
    ];
    for (flags, code, parts) in cases {
        let output = command(flags).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{flags:?}: {stderr}");
        for part in parts {
            assert!(stderr.contains(part), "{flags:?}: {part:?} is missing in: {stderr}");
        }
        assert!(output.stdout.is_empty(), "{flags:?}: no ready line");
    }
}

#[test]
fn an_open_address_is_served_with_a_loud_warning() {
    let running = Running::start(command(&["--listen", "0.0.0.0:0", "--http", "127.0.0.1:0"]));
    let (code, stderr) = running.terminate();
    assert_eq!(code, Some(0), "stderr:\n{stderr}");
    assert!(stderr.contains("WITHOUT authentication"), "stderr:\n{stderr}");
}
