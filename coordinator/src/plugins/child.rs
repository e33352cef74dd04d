//! One process of a plug-in: its start, its questions, its end.

use std::{io, process::Stdio, time::Duration};

use farm_core::coordinator::policy::Question;
use serde::de::DeserializeOwned;
use tokio::{
    io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader},
    process::{self, ChildStdin, ChildStdout, Command},
    time::{Instant, timeout},
};

use super::{Launch, stderr};
use crate::policy_host::{Answer, Greeting, Loaded, MAX_LINE_BYTES};

/// How long a process may take to load its plug-in.
const START_LIMIT: Duration = Duration::from_secs(5);
/// How long the end of a process that closed its pipes may take; then it is killed.
const ENDING_LIMIT: Duration = Duration::from_secs(1);
/// Longest rest of a plug-in between two starts.
const MAX_RESTART_DELAY: Duration = Duration::from_secs(60);

/// A running host with its plug-in loaded. Dropping it kills it.
#[derive(Debug)]
pub(super) struct Child {
    process: process::Child,
    questions: ChildStdin,
    answers: BufReader<ChildStdout>,
    about: String,
}

impl Child {
    /// Starts a process and waits until it has loaded the plug-in; the reason, for people, if that fails.
    pub(super) async fn start(launch: &Launch) -> Result<Self, String> {
        let mut process = Command::new(&launch.host)
            .arg("policy-host")
            .arg(&launch.path)
            .env_clear()
            .current_dir("/")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .map_err(|error| format!("its host {} does not start: {error}", launch.host.display()))?;
        let questions = process.stdin.take().expect("piped");
        let answers = BufReader::new(process.stdout.take().expect("piped"));
        // Ends with the process.
        tokio::spawn(stderr::log(launch.name.clone(), process.stderr.take().expect("piped")));
        let mut child = Self { process, questions, answers, about: String::new() };
        match timeout(START_LIMIT, child.read_line::<Greeting>()).await {
            Ok(Ok(Ok(Loaded { about }))) => Ok(Self { about, ..child }),
            Ok(Ok(Err(reason))) => Err(reason),
            Ok(Err(error)) => Err(format!("{error}; {}", child.ending().await)),
            Err(_) => Err(format!("was not loaded within {START_LIMIT:?} and was killed")),
        }
    }

    /// What the plug-in says about itself.
    pub(super) fn about(&self) -> &str {
        &self.about
    }

    /// Asks one question. After an error, or when this is dropped half-way, the process is of no more use.
    pub(super) async fn ask(&mut self, question: &Question) -> io::Result<Answer> {
        let mut line = serde_json::to_vec(question)?;
        line.push(b'\n');
        if u64::try_from(line.len()).is_ok_and(|length| length > MAX_LINE_BYTES) {
            // Nothing was sent: the process is as good as before.
            return Ok(Err(format!("the question has {} B, at most {MAX_LINE_BYTES} are asked", line.len())));
        }
        self.questions.write_all(&line).await?;
        self.read_line().await
    }

    /// Waits until the process has ended, or ends it, and says how it did.
    pub(super) async fn ending(&mut self) -> String {
        use std::os::unix::process::ExitStatusExt as _;
        match timeout(ENDING_LIMIT, self.process.wait()).await {
            Ok(Ok(status)) => match status.signal() {
                Some(signal) => format!("crashed with signal {signal}"),
                None => format!("ended with exit code {}", status.code().unwrap_or_default()),
            },
            Ok(Err(error)) => format!("its end cannot be seen: {error}"),
            Err(_) => "killed".to_owned(),
        }
    }

    async fn read_line<T: DeserializeOwned>(&mut self) -> io::Result<T> {
        let mut line = Vec::new();
        (&mut self.answers).take(MAX_LINE_BYTES).read_until(b'\n', &mut line).await?;
        if line.last() != Some(&b'\n') {
            return Err(io::Error::new(io::ErrorKind::UnexpectedEof, "its process broke off"));
        }
        Ok(serde_json::from_slice(&line)?)
    }
}

/// When a plug-in that failed may start again.
#[derive(Debug)]
pub(super) struct Backoff {
    first: Duration,
    next: Duration,
    not_before: Option<Instant>,
}

impl Backoff {
    pub(super) fn new(first: Duration) -> Self {
        let first = first.min(MAX_RESTART_DELAY);
        Self { first, next: first, not_before: None }
    }

    /// How long it has to rest from now on; `None` if it may start.
    pub(super) fn rest(&self, now: Instant) -> Option<Duration> {
        self.not_before.and_then(|at| at.checked_duration_since(now)).filter(|rest| !rest.is_zero())
    }

    /// It ended; how long it rests.
    pub(super) fn failed(&mut self, now: Instant) -> Duration {
        let rest = self.next;
        self.not_before = Some(now + rest);
        self.next = (rest * 2).min(MAX_RESTART_DELAY);
        rest
    }

    /// It works: its next failure is a first one.
    pub(super) fn answered(&mut self) {
        self.next = self.first;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rests_double_up_to_a_minute_and_an_answer_starts_over() {
        let now = Instant::now();
        let mut backoff = Backoff::new(Duration::from_secs(1));
        assert_eq!(backoff.rest(now), None, "it may start at first");
        let rests: Vec<u64> = (0..8).map(|_| backoff.failed(now).as_secs()).collect();
        assert_eq!(rests, [1, 2, 4, 8, 16, 32, 60, 60]);
        assert_eq!(backoff.rest(now + Duration::from_secs(59)), Some(Duration::from_secs(1)));
        assert_eq!(backoff.rest(now + Duration::from_secs(60)), None);
        backoff.answered();
        assert_eq!(backoff.failed(now).as_secs(), 1);
    }
}
