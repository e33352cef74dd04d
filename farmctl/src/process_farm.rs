//! A farm of real processes on this machine: `farm-coordinator` and `farm-worker`s beside the running `farmctl`, over
//! loopback, with ports of the system's choice. What the benches measure. Nothing of it outlives its [`ProcessFarm`].

use std::{
    collections::VecDeque,
    env,
    ffi::OsString,
    fs,
    io::{BufRead as _, BufReader, Read, Write as _},
    path::PathBuf,
    process::{Child, ChildStderr, ChildStdout, Command, Stdio},
    sync::mpsc::{self, Receiver, RecvTimeoutError},
    thread::{self, JoinHandle},
    time::Duration,
};

use anyhow::{Context as _, bail};
use serde_json::Value;
use tempfile::{NamedTempFile, TempDir};

/// Longest wait for a daemon's ready line; a loaded two-core machine needs a second for nine.
const READY_PATIENCE: Duration = Duration::from_secs(30);
/// As much of a daemon's stderr is kept for error messages, in bytes; its end says why it died.
const STDERR_BYTES: usize = 16 << 10;
/// Length of a tick in `/proc/PID/stat`: USER_HZ is 100 on every Linux.
const TICK: Duration = Duration::from_millis(10);

/// What a farm consists of.
#[derive(Clone, Debug)]
pub(crate) struct Shape {
    /// The device specs of each worker.
    pub workers: Vec<Vec<String>>,
    /// Whether a worker's devices take queued jobs from each other.
    pub local_stealing: Stealing,
}

/// Whether work moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stealing {
    /// As production has it.
    On,
    /// For measuring what it gains.
    Off,
}

impl Shape {
    /// `workers` workers of `devices` simulated devices of speed 1 each.
    pub(crate) fn uniform(workers: usize, devices: usize) -> Self {
        let worker = vec!["sim:score=1000,speed=1.0".to_owned(); devices];
        Self { workers: vec![worker; workers], local_stealing: Stealing::On }
    }
}

/// Running daemons, killed when dropped.
#[derive(Debug)]
pub(crate) struct ProcessFarm {
    // Workers go before their coordinator: they would try to reach it again.
    workers: Vec<Daemon>,
    coordinator: Daemon,
    grpc: String,
    /// The coordinator's state, which its successors take over.
    state: TempDir,
    /// The workers' settings; the file lives as long as they do.
    _settings: NamedTempFile,
}

impl ProcessFarm {
    /// Starts the processes and waits, for a bounded time, until every worker is registered. Blocks.
    ///
    /// # Errors
    /// A binary is not beside this one, or a daemon does not become ready: the error holds the end of its stderr.
    pub(crate) fn start(shape: &Shape) -> anyhow::Result<Self> {
        let settings = worker_settings(shape.local_stealing)?;
        let state = TempDir::new().context("no place for the coordinator's state")?;
        let (coordinator, grpc) = start_coordinator("127.0.0.1:0", &state)?;
        let mut workers = Vec::with_capacity(shape.workers.len());
        for (number, devices) in shape.workers.iter().enumerate() {
            let name = format!("bench-{number}");
            let mut arguments: Vec<OsString> =
                ["--insecure", "--coordinator", &grpc, "--listen", "127.0.0.1:0", "--name", &name]
                    .map(OsString::from)
                    .into();
            arguments.extend(["--config".into(), settings.path().into()]);
            arguments.extend(devices.iter().flat_map(|device| ["--device".into(), device.into()]));
            workers.push(Daemon::start("farm-worker", arguments)?);
        }
        for worker in &mut workers {
            worker.ready()?;
        }
        Ok(Self { workers, coordinator, grpc, state, _settings: settings })
    }

    /// Kills the coordinator, and starts another one at the same address with what it has left on disk. Blocks.
    ///
    /// # Errors
    /// It does not become ready.
    pub(crate) fn replace_coordinator(&mut self) -> anyhow::Result<()> {
        self.coordinator.kill();
        (self.coordinator, self.grpc) = start_coordinator(&self.grpc, &self.state)?;
        Ok(())
    }

    /// Where applications connect.
    pub(crate) fn grpc(&self) -> &str {
        &self.grpc
    }

    /// CPU time so far.
    pub(crate) fn cpu_time(&self) -> anyhow::Result<CpuTime> {
        let workers = self.workers.iter().map(|worker| process_cpu_time(&worker.child.id().to_string()));
        Ok(CpuTime {
            application: process_cpu_time("self")?,
            coordinator: process_cpu_time(&self.coordinator.child.id().to_string())?,
            workers: workers.sum::<anyhow::Result<Duration>>()?,
        })
    }
}

/// A coordinator and its address.
fn start_coordinator(listen: &str, state: &TempDir) -> anyhow::Result<(Daemon, String)> {
    let mut arguments: Vec<OsString> =
        ["--insecure", "--listen", listen, "--http", "127.0.0.1:0", "--state"].map(OsString::from).into();
    arguments.push(state.path().into());
    let mut coordinator = Daemon::start("farm-coordinator", arguments)?;
    let ready = coordinator.ready()?;
    let grpc = ready["grpc"].as_str();
    let grpc = grpc.with_context(|| format!("the coordinator's ready line names no address: {ready}"))?;
    let grpc = grpc.to_owned();
    Ok((coordinator, grpc))
}

/// User and system time of a farm's processes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct CpuTime {
    /// This process, which is the application.
    pub application: Duration,
    /// The coordinator.
    pub coordinator: Duration,
    /// All workers together.
    pub workers: Duration,
}

impl CpuTime {
    /// What was spent since `earlier`.
    pub(crate) fn since(self, earlier: Self) -> Self {
        Self {
            application: self.application.saturating_sub(earlier.application),
            coordinator: self.coordinator.saturating_sub(earlier.coordinator),
            workers: self.workers.saturating_sub(earlier.workers),
        }
    }

    /// All processes together.
    pub(crate) fn total(self) -> Duration {
        self.application + self.coordinator + self.workers
    }
}

/// All threads of a process, ended ones too, to the tick: `schedstat` is finer and forgets ended threads.
fn process_cpu_time(process: &str) -> anyhow::Result<Duration> {
    let path = format!("/proc/{process}/stat");
    let stat = fs::read_to_string(&path).with_context(|| path.clone())?;
    parse_cpu_time(&stat).with_context(|| format!("{path} is not as proc(5) says: {stat:?}"))
}

/// proc(5): after the name in parentheses, utime and stime are the 12th and 13th fields.
fn parse_cpu_time(stat: &str) -> Option<Duration> {
    let (_, fields) = stat.rsplit_once(')')?;
    let mut times = fields.split_whitespace().skip(11).map(|field| field.parse::<u32>().ok());
    Some(TICK * times.next()?? + TICK * times.next()??)
}

fn worker_settings(local_stealing: Stealing) -> anyhow::Result<NamedTempFile> {
    let mut file = NamedTempFile::with_suffix(".toml").context("no place for the workers' settings")?;
    let text = match local_stealing {
        Stealing::On => "",
        Stealing::Off => "[scheduler]\nlocal_stealing = \"off\"\n",
    };
    file.write_all(text.as_bytes()).context("the workers' settings cannot be written")?;
    Ok(file)
}

/// A child process, killed when dropped.
#[derive(Debug)]
struct Daemon {
    name: &'static str,
    child: Child,
    lines: Receiver<String>,
    stderr: Option<JoinHandle<String>>,
}

impl Daemon {
    fn start(name: &'static str, arguments: impl IntoIterator<Item = OsString>) -> anyhow::Result<Self> {
        let path = beside(name)?;
        let mut command = Command::new(&path);
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        // What configures daemons of this machine is not for these.
        for (variable, _) in env::vars_os() {
            if variable.to_string_lossy().starts_with("GLEANER_") {
                command.env_remove(variable);
            }
        }
        let mut child = command.spawn().with_context(|| format!("{} does not start", path.display()))?;
        let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
        let lines = read_lines(stdout.expect("stdout is piped"));
        let stderr = Some(keep_end(stderr.expect("stderr is piped")));
        Ok(Self { name, child, lines, stderr })
    }

    fn ready(&mut self) -> anyhow::Result<Value> {
        let why = match self.lines.recv_timeout(READY_PATIENCE) {
            Ok(line) => match serde_json::from_str::<Value>(&line) {
                Ok(ready) if ready["event"] == "ready" => return Ok(ready),
                _ => format!("said {line:?} instead of its ready line"),
            },
            Err(RecvTimeoutError::Timeout) => format!("was not ready within {READY_PATIENCE:?}"),
            Err(RecvTimeoutError::Disconnected) => "ended before it was ready".to_owned(),
        };
        let last_words = self.last_words();
        bail!("{} {why}{last_words}", self.name)
    }

    fn last_words(&mut self) -> String {
        self.kill();
        let text = self.stderr.take().and_then(|reader| reader.join().ok()).unwrap_or_default();
        if text.trim().is_empty() { String::new() } else { format!("; it said:\n{}", text.trim_end()) }
    }

    fn kill(&mut self) {
        // One that has ended already is as dead as can be.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        self.kill();
    }
}

/// A binary in this executable's folder.
fn beside(name: &str) -> anyhow::Result<PathBuf> {
    let own = env::current_exe().context("this executable's path is not known")?;
    let path = own.with_file_name(name);
    if !path.is_file() {
        bail!(
            "{} is missing: a bench starts it as a process of its own (`make build` builds it)",
            path.display()
        );
    }
    Ok(path)
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

/// Reads until the child closes its stderr; gives the last [`STDERR_BYTES`] of it.
fn keep_end(mut stderr: ChildStderr) -> JoinHandle<String> {
    thread::spawn(move || {
        let mut end: VecDeque<u8> = VecDeque::with_capacity(STDERR_BYTES);
        let mut chunk = [0; 4_096];
        while let Ok(count @ 1..) = stderr.read(&mut chunk) {
            end.extend(&chunk[..count]);
            end.drain(..end.len().saturating_sub(STDERR_BYTES));
        }
        String::from_utf8_lossy(end.make_contiguous()).into_owned()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cpu_time_is_read_behind_any_name() {
        let stat = "17 (a (b) c) S 1 17 17 0 -1 4194560 9 0 0 0 250 50 7 8 20 0 4 0 100";
        assert_eq!(parse_cpu_time(stat), Some(Duration::from_secs(3)));
        assert_eq!(parse_cpu_time("17 (a) S 1 17"), None, "fields are missing");
        assert!(process_cpu_time("self").is_ok());
        let error = process_cpu_time("0").expect_err("there is no process 0").to_string();
        assert!(error.contains("/proc/0/stat"), "{error}");
    }

    #[test]
    fn a_missing_binary_is_named_by_its_path() {
        let error = beside("farm-nothing").expect_err("there is no such binary").to_string();
        assert!(error.contains("/farm-nothing is missing"), "{error}");
    }

    #[test]
    fn spent_time_is_per_process() {
        let seconds = Duration::from_secs;
        let before = CpuTime { application: seconds(1), coordinator: seconds(2), workers: seconds(3) };
        let after = CpuTime { application: seconds(2), coordinator: seconds(4), workers: seconds(7) };
        let spent = after.since(before);
        assert_eq!(spent, CpuTime { application: seconds(1), coordinator: seconds(2), workers: seconds(4) });
        assert_eq!(spent.total(), seconds(7));
    }
}
