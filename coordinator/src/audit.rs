//! The audit log of a secured farm: who was let in, who was refused, and what operators did. One JSON object a line, in the
//! state directory, bounded in size, and in refusals so that strangers do not write it full.

use std::{
    fs::{self, File, OpenOptions},
    io::{self, Write as _},
    os::unix::fs::{MetadataExt as _, OpenOptionsExt as _},
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

use proto::trust::unix_now;
use serde_json::{Value, json};

/// The log, and the one before it.
const FILE: &str = "audit.ndjson";
const EARLIER_FILE: &str = "audit.1.ndjson";
/// A log of this size becomes the earlier one, in bytes.
const MAX_BYTES: u64 = 16 << 20;
/// Most refusals written in a second, and in an hour: at a kilobyte each the two logs go back for a day and more, whatever
/// strangers do. Further ones are counted.
const REFUSALS_PER_SECOND: u64 = 20;
const REFUSALS_PER_HOUR: u64 = 1_200;
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
    second: Window,
    hour: Window,
    /// Refusals that were counted only.
    unwritten: u64,
}

/// A stretch of time in which so many lines may be written.
#[derive(Debug)]
struct Window {
    length: Duration,
    most: u64,
    since: Instant,
    used: u64,
}

impl Window {
    fn new(length: Duration, most: u64) -> Self {
        Self { length, most, since: Instant::now(), used: 0 }
    }

    fn has_room(&mut self) -> bool {
        if self.since.elapsed() >= self.length {
            (self.since, self.used) = (Instant::now(), 0);
        }
        self.used < self.most
    }
}

impl Audit {
    /// # Errors
    /// The file cannot be opened.
    pub(crate) fn open(directory: &Path) -> io::Result<Self> {
        let (file, bytes) = open(directory)?;
        Ok(Self(Mutex::new(Log {
            directory: directory.to_owned(),
            file,
            bytes,
            second: Window::new(Duration::from_secs(1), REFUSALS_PER_SECOND),
            hour: Window::new(Duration::from_secs(3_600), REFUSALS_PER_HOUR),
            unwritten: 0,
        })))
    }

    /// Something was done; it is on disk when this returns.
    pub(crate) fn done(&self, what: &str, who: &str, details: Value) {
        let mut log = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        log.append(&json!({ "time_s": unix_now(), "event": what, "who": who, "details": details }), true);
    }

    /// Something was refused.
    pub(crate) fn refused(&self, what: &str, who: &str, reason: &str) {
        let mut log = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if !(log.second.has_room() && log.hour.has_room()) {
            log.unwritten += 1;
            return;
        }
        log.second.used += 1;
        log.hour.used += 1;
        let unwritten = std::mem::take(&mut log.unwritten);
        if unwritten > 0 {
            log.append(&json!({ "time_s": unix_now(), "event": "refused", "unwritten": unwritten }), false);
        }
        let reason = reason.chars().take(MAX_REASON_CHARS).collect::<String>();
        let line =
            json!({ "time_s": unix_now(), "event": "refused", "what": what, "who": who, "reason": reason });
        log.append(&line, false);
    }
}

impl Log {
    fn append(&mut self, line: &Value, durable: bool) {
        let written = self.find_again().and_then(|()| self.turn_over()).and_then(|()| {
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

    /// A log that was moved or removed under us is begun anew.
    fn find_again(&mut self) -> io::Result<()> {
        let ours = self.file.metadata()?;
        let there = fs::metadata(self.directory.join(FILE));
        if !there.is_ok_and(|there| (there.dev(), there.ino()) == (ours.dev(), ours.ino())) {
            (self.file, self.bytes) = open(&self.directory)?;
        }
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
    fn a_log_that_was_removed_is_begun_anew() {
        let directory = tempfile::tempdir().unwrap();
        let audit = Audit::open(directory.path()).unwrap();
        audit.done("first", "x", Value::Null);
        fs::remove_file(directory.path().join(FILE)).unwrap();
        audit.done("second", "x", Value::Null);
        assert_eq!(lines(directory.path(), FILE)[0]["event"], "second");
    }

    #[test]
    fn strangers_do_not_write_the_log_full() {
        let directory = tempfile::tempdir().unwrap();
        let audit = Audit::open(directory.path()).unwrap();
        for _ in 0..3 * REFUSALS_PER_HOUR {
            audit.0.lock().unwrap().second.used = 0;
            audit.refused("apps", "somebody", "why");
        }
        assert_eq!(lines(directory.path(), FILE).len() as u64, REFUSALS_PER_HOUR);
        audit.0.lock().unwrap().hour.used = 0;
        audit.refused("apps", "somebody", "why");
        let lines = lines(directory.path(), FILE);
        assert_eq!(lines[lines.len() - 2]["unwritten"], 2 * REFUSALS_PER_HOUR, "the others are counted");
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
