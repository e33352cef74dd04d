//! The audit log of a secured farm: who was let in, who was refused, and what operators did. One JSON object a line, in the
//! state directory, bounded in size and in refusals a second.

use std::{
    fs::{self, File, OpenOptions},
    io::{self, Write as _},
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
    time::{Duration, Instant, SystemTime},
};

use proto::trust::unix_seconds;
use serde_json::{Value, json};

/// The log, and the one before it.
const FILE: &str = "audit.ndjson";
const EARLIER_FILE: &str = "audit.1.ndjson";
/// A log of this size becomes the earlier one, in bytes.
const MAX_BYTES: u64 = 16 << 20;
/// Most refusals written in a second; further ones are counted.
const REFUSALS_PER_SECOND: u64 = 20;
/// As much of a refusal's reason is written, in characters: some repeat what a stranger has said.
const MAX_REASON_CHARS: usize = 512;

/// Appends to the log.
#[derive(Debug)]
pub(crate) struct Audit(Mutex<Log>);

#[derive(Debug)]
struct Log {
    directory: PathBuf,
    file: File,
    bytes: u64,
    /// Refusals since `second`.
    refusals: u64,
    second: Instant,
}

impl Audit {
    /// # Errors
    /// The file cannot be opened.
    pub(crate) fn open(directory: &Path) -> io::Result<Self> {
        let (file, bytes) = open(directory)?;
        let log = Log { directory: directory.to_owned(), file, bytes, refusals: 0, second: Instant::now() };
        Ok(Self(Mutex::new(log)))
    }

    /// Something was done; it is on disk when this returns.
    pub(crate) fn done(&self, what: &str, who: &str, details: Value) {
        let mut log = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        log.append(&json!({ "time_s": unix_seconds(SystemTime::now()), "event": what, "who": who, "details": details }), true);
    }

    /// Something was refused.
    pub(crate) fn refused(&self, what: &str, who: &str, reason: &str) {
        let mut log = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if log.second.elapsed() >= Duration::from_secs(1) {
            let unwritten = log.refusals.saturating_sub(REFUSALS_PER_SECOND);
            (log.second, log.refusals) = (Instant::now(), 0);
            if unwritten > 0 {
                log.append(&json!({ "time_s": unix_seconds(SystemTime::now()), "event": "refused", "unwritten": unwritten }), false);
            }
        }
        log.refusals += 1;
        if log.refusals <= REFUSALS_PER_SECOND {
            let reason = reason.chars().take(MAX_REASON_CHARS).collect::<String>();
            let line = json!({ "time_s": unix_seconds(SystemTime::now()), "event": "refused", "what": what, "who": who, "reason": reason });
            log.append(&line, false);
        }
    }
}

impl Log {
    fn append(&mut self, line: &Value, durable: bool) {
        let written = self.turn_over().and_then(|()| {
            let text = format!("{line}\n");
            self.bytes += text.len() as u64;
            self.file.write_all(text.as_bytes())?;
            if durable { self.file.sync_data() } else { Ok(()) }
        });
        if let Err(error) = written {
            tracing::error!(%error, %line, "the audit log cannot be written");
        }
    }

    fn turn_over(&mut self) -> io::Result<()> {
        if self.bytes < MAX_BYTES {
            return Ok(());
        }
        fs::rename(self.directory.join(FILE), self.directory.join(EARLIER_FILE))?;
        (self.file, self.bytes) = open(&self.directory)?;
        Ok(())
    }
}

fn open(directory: &Path) -> io::Result<(File, u64)> {
    let file = OpenOptions::new().create(true).append(true).mode(0o600).open(directory.join(FILE))?;
    let bytes = file.metadata()?.len();
    Ok((file, bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(directory: &Path, file: &str) -> Vec<Value> {
        let text = fs::read_to_string(directory.join(file)).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    #[test]
    fn refusals_are_bounded_and_counted_and_deeds_are_all_there() {
        let directory = tempfile::tempdir().unwrap();
        let audit = Audit::open(directory.path()).unwrap();
        for _ in 0..200 {
            audit.refused("apps", "somebody", "why");
        }
        for number in 0..30 {
            audit.done("token", "gleaner://farm/operator/o", json!({ "id": number }));
        }
        let lines = lines(directory.path(), FILE);
        let refused = lines.iter().filter(|line| line["event"] == "refused").count();
        // The loop may cross a second's end, on a machine that does other things.
        assert!((20..60).contains(&refused), "{refused} of 200 refusals were written");
        assert_eq!(lines.iter().filter(|line| line["event"] == "token").count(), 30);
    }

    #[test]
    fn a_full_log_becomes_the_earlier_one() {
        let directory = tempfile::tempdir().unwrap();
        let audit = Audit::open(directory.path()).unwrap();
        audit.done("first", "x", Value::Null);
        audit.0.lock().unwrap().bytes = MAX_BYTES;
        audit.done("second", "x", Value::Null);
        assert_eq!(lines(directory.path(), EARLIER_FILE)[0]["event"], "first");
        assert_eq!(lines(directory.path(), FILE)[0]["event"], "second");
        drop(audit);
        let again = Audit::open(directory.path()).unwrap();
        again.done("third", "x", Value::Null);
        assert_eq!(lines(directory.path(), FILE).len(), 2, "a new life goes on in the same file");
    }
}
