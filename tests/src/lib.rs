//! What tests share. Here: Gleaner's real binaries as child processes on 127.0.0.1, with ports chosen by the system, every
//! wait bounded, and nothing left running when a test ends. In [`sim`]: its machines alone, in one process.

pub mod sim;

use std::{
    env,
    ffi::OsStr,
    fs::{self, OpenOptions},
    io::{BufRead, BufReader, Read},
    path::PathBuf,
    process::{Child, ChildStdout, Command, ExitStatus, Output, Stdio},
    sync::mpsc::{self, Receiver},
    thread,
    time::{Duration, Instant},
};

use serde_json::Value;

/// Longest wait for a daemon's ready line or for its end; far past what a loaded two-core machine needs.
const DAEMON_PATIENCE: Duration = Duration::from_secs(90);
/// Longest wait for one line of a running `farmctl`.
const LINE_PATIENCE: Duration = Duration::from_secs(240);

/// The path of a workspace binary, built by `cargo build --workspace --bins` (as `make test` does).
///
/// # Panics
/// The binary is not there.
#[must_use]
pub fn binary(name: &str) -> PathBuf {
    let mut folder = env::current_exe().expect("the test has a path");
    folder.pop();
    if folder.ends_with("deps") {
        folder.pop();
    }
    let path = folder.join(name);
    assert!(
        path.exists(),
        "{} is missing: run `cargo build --workspace --bins --examples` first (`make test` does)",
        path.display()
    );
    path
}

/// A workspace binary that does not know the farms of whoever runs the tests.
#[must_use]
pub fn command(name: &str) -> Command {
    isolated(Command::new(binary(name)))
}

fn isolated(mut command: Command) -> Command {
    command
        .env_remove("GLEANER_COORDINATOR")
        .env_remove("GLEANER_IDENTITY")
        .env("XDG_CONFIG_HOME", "/nonexistent");
    command
}

/// A child process whose stdout is read line by line, killed when dropped.
#[derive(Debug)]
pub struct Process {
    name: String,
    child: Child,
    lines: Receiver<String>,
    stderr: Option<thread::JoinHandle<String>>,
}

/// Signals that tests send.
#[derive(Clone, Copy, Debug)]
pub enum Signal {
    /// Polite end.
    Term,
    /// Ctrl-C.
    Int,
    /// Instant death.
    Kill,
    /// It stands still.
    Stop,
    /// And goes on.
    Continue,
}

impl Process {
    /// Starts a workspace binary.
    ///
    /// # Panics
    /// It cannot be started.
    pub fn start<S: AsRef<OsStr>>(name: &str, arguments: impl IntoIterator<Item = S>) -> Self {
        Self::start_with(command(name).args(arguments), name, Stdio::piped())
    }

    /// Starts a workspace binary that [`Self::fill_disk`] does not kill.
    ///
    /// # Panics
    /// It cannot be started.
    pub fn start_on_small_disk<S: AsRef<OsStr>>(name: &str, arguments: impl IntoIterator<Item = S>) -> Self {
        // The system sends this signal with the error where a limit is reached.
        let shell = ["-c", "trap '' XFSZ; exec \"$0\" \"$@\""];
        let mut command = isolated(Command::new("sh"));
        Self::start_with(command.args(shell).arg(binary(name)).args(arguments), name, Stdio::piped())
    }

    /// From now on the disk takes nothing more of it, or everything again.
    ///
    /// # Panics
    /// The limit cannot be set.
    pub fn fill_disk(&self, full: bool) {
        let limit = if full { "--fsize=0:" } else { "--fsize=unlimited:" };
        let set = Command::new("prlimit").args(["--pid", &self.child.id().to_string(), limit]).status();
        assert!(set.expect("util-linux is there").success(), "{limit} of {} cannot be set", self.name);
    }

    /// Starts a workspace binary whose stderr cannot be written, as on a full disk.
    ///
    /// # Panics
    /// It cannot be started.
    pub fn start_muted<S: AsRef<OsStr>>(name: &str, arguments: impl IntoIterator<Item = S>) -> Self {
        let full = OpenOptions::new().write(true).open("/dev/full").expect("Linux has /dev/full");
        Self::start_with(command(name).args(arguments), name, full.into())
    }

    fn start_with(command: &mut Command, name: &str, stderr: Stdio) -> Self {
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(stderr)
            .spawn()
            .expect("the binary starts");
        let lines = read_lines(child.stdout.take().expect("stdout is piped"));
        let errors = child.stderr.take();
        let stderr = thread::spawn(move || {
            let mut text = Vec::new();
            // A child that dies closes the pipe; what came before is what there is to show.
            let _ = errors.map(|mut errors| errors.read_to_end(&mut text));
            String::from_utf8_lossy(&text).into_owned()
        });
        Self { name: name.to_owned(), child, lines, stderr: Some(stderr) }
    }

    /// The next line of stdout as JSON.
    ///
    /// # Panics
    /// No line came in time, or it is not JSON; the message holds the child's stderr.
    pub fn next_json(&mut self) -> Value {
        match self.lines.recv_timeout(LINE_PATIENCE) {
            Ok(line) => serde_json::from_str(&line)
                .unwrap_or_else(|error| panic!("{}: {error} in {line:?}", self.name)),
            Err(reason) => {
                let _ = self.child.kill();
                let stderr = self.take_stderr();
                panic!("{}: no line on stdout ({reason}); stderr:\n{stderr}", self.name);
            }
        }
    }

    /// Lines of stdout as JSON until one satisfies `wanted`.
    ///
    /// # Panics
    /// As [`Self::next_json`], or the lines end first.
    pub fn wait_for(&mut self, mut wanted: impl FnMut(&Value) -> bool) -> Value {
        loop {
            let line = self.next_json();
            if wanted(&line) {
                return line;
            }
        }
    }

    /// The most memory that it has had resident so far, in bytes.
    ///
    /// # Panics
    /// The process is gone already.
    #[must_use]
    pub fn peak_resident_bytes(&self) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id()));
        let status = status.expect("Linux tells of its processes");
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let number = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
        let kib = number.unwrap_or_else(|| panic!("{} is gone", self.name));
        kib << 10
    }

    /// Sends a signal.
    ///
    /// # Panics
    /// The process is gone already.
    pub fn signal(&self, signal: Signal) {
        let name = match signal {
            Signal::Term => "TERM",
            Signal::Int => "INT",
            Signal::Kill => "KILL",
            Signal::Stop => "STOP",
            Signal::Continue => "CONT",
        };
        let status = Command::new("sh")
            .args(["-c", &format!("kill -{name} {}", self.child.id())])
            .status()
            .expect("a shell is there");
        assert!(status.success(), "{} is gone before SIG{name}", self.name);
    }

    /// Waits for the end; gives the exit status and stderr.
    ///
    /// # Panics
    /// It does not end in time.
    pub fn finish(mut self) -> (ExitStatus, String) {
        let deadline = Instant::now() + LINE_PATIENCE.max(DAEMON_PATIENCE);
        // The stdout pipe closes when the process ends: wait on that instead of polling.
        loop {
            match self.lines.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(_) => {}
                Err(mpsc::RecvTimeoutError::Disconnected) => break,
                Err(mpsc::RecvTimeoutError::Timeout) => {
                    let _ = self.child.kill();
                    let stderr = self.take_stderr();
                    panic!("{} did not end in time; stderr:\n{stderr}", self.name);
                }
            }
        }
        let status = self.child.wait().expect("the child can be waited for");
        (status, self.take_stderr())
    }

    fn take_stderr(&mut self) -> String {
        self.stderr.take().map(|reader| reader.join().expect("the reader does not panic")).unwrap_or_default()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Already ended is fine.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn read_lines(stdout: ChildStdout) -> Receiver<String> {
    let (sender, receiver) = mpsc::channel();
    thread::spawn(move || {
        for line in BufReader::new(stdout).lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                break;
            }
        }
    });
    receiver
}

/// A coordinator process and its workers.
#[derive(Debug)]
pub struct Farm {
    /// The coordinator.
    pub coordinator: Process,
    /// Its gRPC address.
    pub grpc: String,
    /// Its HTTP address.
    pub http: String,
    /// The workers, in the order they were added.
    pub workers: Vec<Process>,
}

impl Farm {
    /// A coordinator without workers.
    ///
    /// # Panics
    /// It does not become ready.
    #[must_use]
    pub fn coordinator() -> Self {
        Self::coordinator_with(&[])
    }

    /// A coordinator without workers, with further arguments.
    ///
    /// # Panics
    /// It does not become ready.
    #[must_use]
    pub fn coordinator_with(arguments: &[&str]) -> Self {
        let fixed = ["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"];
        let mut coordinator = Process::start("farm-coordinator", fixed.iter().chain(arguments));
        let ready = coordinator.next_json();
        assert_eq!(ready["event"], "ready", "the coordinator's first line: {ready}");
        let address = |key: &str| ready[key].as_str().expect("an address").to_owned();
        Self { grpc: address("grpc"), http: address("http"), coordinator, workers: Vec::new() }
    }

    /// A coordinator with `count` workers of one lavapipe device each.
    #[must_use]
    pub fn with_cpu_workers(count: usize) -> Self {
        let mut farm = Self::coordinator();
        for _ in 0..count {
            farm.begin_worker("cpu");
        }
        for worker in &mut farm.workers {
            let ready = worker.next_json();
            assert_eq!(ready["event"], "ready", "a worker's first line: {ready}");
        }
        farm
    }

    /// Starts one more worker without waiting for its ready line.
    pub fn begin_worker(&mut self, device: &str) {
        let name = format!("w{}", self.workers.len());
        let arguments =
            ["--coordinator", &self.grpc, "--listen", "127.0.0.1:0", "--name", &name, "--device", device];
        self.workers.push(Process::start("farm-worker", arguments));
    }

    /// Starts one more worker and waits for its ready line.
    pub fn add_worker(&mut self, device: &str) -> Value {
        self.begin_worker(device);
        self.workers.last_mut().expect("just added").next_json()
    }
}

/// Runs `farmctl` to its end.
///
/// # Panics
/// It cannot be started.
pub fn farmctl<S: AsRef<OsStr>>(arguments: impl IntoIterator<Item = S>) -> Output {
    command("farmctl").args(arguments).stdin(Stdio::null()).output().expect("farmctl starts")
}
