//! Who stands by, for people: each standby has a file `standby-N` in the state directory and writes a beat into it, which the
//! leader looks at. Nothing else depends on it.

use std::{
    cmp::Reverse,
    collections::BTreeMap,
    fs::{self, File, OpenOptions},
    hash::{BuildHasher as _, RandomState},
    io,
    os::unix::fs::{FileExt as _, OpenOptionsExt as _},
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

use farm_core::message::Liveness;

use super::{Content, text_of};
use crate::numbered::Numbered;

const FILES: Numbered = Numbered { before: "standby-", after: "" };
/// The leader looks at so many, those written last.
const MAX_STANDBYS: usize = 16;
/// A file that stood still for so long, and for several of its writer's silences, is removed: its standby was killed.
const FORGOTTEN: Duration = Duration::from_secs(60);
const SILENCES: u32 = 6;
/// What is said of one, at most.
const HOLDER_CHARACTERS: usize = 64;

/// A standby's file; removed when this is dropped.
#[derive(Debug)]
pub(super) struct Presence {
    path: PathBuf,
    liveness: Liveness,
    beat: u64,
    shown: Option<Instant>,
    failing: bool,
}

impl Presence {
    pub(super) fn new(directory: &Path, liveness: Liveness) -> Self {
        let number = RandomState::new().hash_one("standby");
        Self { path: FILES.path(directory, number), liveness, beat: 0, shown: None, failing: false }
    }

    /// Writes a beat where the last one is a heartbeat ago. One that cannot is not seen, and takes over all the same.
    pub(super) fn show(&mut self) {
        let heartbeat = Duration::from_millis(self.liveness.heartbeat_ms);
        if self.shown.is_some_and(|shown| shown.elapsed() < heartbeat) {
            return;
        }
        let written = self.write();
        if let Err(error) = &written
            && !self.failing
        {
            tracing::warn!(path = %self.path.display(), %error, "the leader cannot see this standby");
        }
        self.failing = written.is_err();
        self.beat += 1;
        self.shown = Some(Instant::now());
    }

    fn write(&self) -> io::Result<()> {
        // A leader that saw it stand still has removed it.
        let file =
            OpenOptions::new().write(true).create(true).truncate(false).mode(0o600).open(&self.path)?;
        file.write_all_at(Content::new(self.beat, self.liveness).to_text().as_bytes(), 0)
    }
}

impl Drop for Presence {
    fn drop(&mut self) {
        // It is forgotten after a while if this fails.
        let _ = fs::remove_file(&self.path);
    }
}

/// The standbys that a leader sees.
#[derive(Debug, Default)]
pub(crate) struct Standbys(Mutex<BTreeMap<u64, Seen>>);

#[derive(Debug)]
struct Seen {
    text: String,
    since: Instant,
    /// It was seen to write.
    lives: bool,
    /// A longer silence says that it does not any more.
    silence: Duration,
    holder: String,
}

impl Standbys {
    /// Those that write, in words.
    pub(crate) fn present(&self) -> Vec<String> {
        let seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let present = seen.values().filter(|seen| seen.lives && seen.since.elapsed() < seen.silence);
        present.map(|seen| seen.holder.clone()).collect()
    }

    /// Reads what they have written; a silence is at least `patience`. One that cannot be read is not there.
    pub(super) fn look(&self, directory: &Path, patience: Duration) {
        let written = |number| {
            let metadata = fs::symlink_metadata(FILES.path(directory, number)).ok()?;
            // Opening what is no file may wait for somebody else.
            if metadata.is_file() { Some((Reverse(metadata.modified().ok()?), number)) } else { None }
        };
        let mut found: Vec<_> =
            FILES.all(directory).unwrap_or_default().into_iter().filter_map(written).collect();
        found.sort_unstable();
        found.truncate(MAX_STANDBYS);
        let texts: BTreeMap<u64, String> = found
            .into_iter()
            .filter_map(|(_, number)| {
                let file = File::open(FILES.path(directory, number)).ok()?;
                Some((number, text_of(&file).ok()?))
            })
            .collect();
        for number in self.take(texts, patience) {
            let _ = fs::remove_file(FILES.path(directory, number));
        }
    }

    /// Gives the numbers of those that are forgotten.
    fn take(&self, texts: BTreeMap<u64, String>, patience: Duration) -> Vec<u64> {
        let mut seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        seen.retain(|number, _| texts.contains_key(number));
        let mut forgotten = Vec::new();
        for (number, text) in texts {
            let before = seen.get(&number);
            if let Some(before) = before
                && before.text == text
            {
                if before.since.elapsed() > FORGOTTEN.max(before.silence.saturating_mul(SILENCES)) {
                    forgotten.push(number);
                }
                continue;
            }
            let content = Content::parse(&text);
            let lives = before.is_some() && content.is_some();
            let (dead_ms, holder) =
                content.map(|content| (content.dead_ms, content.holder)).unwrap_or_default();
            let now = Seen {
                lives,
                text,
                since: Instant::now(),
                silence: Duration::from_millis(dead_ms).max(patience),
                holder: holder.chars().take(HOLDER_CHARACTERS).collect(),
            };
            seen.insert(number, now);
        }
        forgotten
    }
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::{super::HOLDER, *};

    const PATIENCE: Duration = Duration::from_secs(10);

    fn presence(directory: &Path) -> Presence {
        Presence::new(directory, Liveness { heartbeat_ms: 0, dead_ms: 400, ..Liveness::default() })
    }

    fn names(standbys: &Standbys, directory: &Path) -> Vec<String> {
        standbys.look(directory, PATIENCE);
        standbys.present()
    }

    #[test]
    fn a_standby_is_seen_while_it_beats() {
        let directory = tempfile::tempdir().unwrap();
        let directory = directory.path();
        let standbys = Standbys::default();
        let (mut one, mut killed) = (presence(directory), presence(directory));
        killed.show();
        one.show();
        assert!(names(&standbys, directory).is_empty(), "a file alone is nobody");
        one.show();
        assert_eq!(names(&standbys, directory), [HOLDER.as_str()]);
        let ago = |seconds| {
            let since = Instant::now() - Duration::from_secs(seconds);
            standbys.0.lock().unwrap().values_mut().for_each(|seen| seen.since = since);
        };
        ago(9);
        assert_eq!(standbys.present().len(), 1, "the leader looks less often than it writes");
        ago(11);
        assert!(standbys.present().is_empty(), "it stands still");
        ago(61);
        one.show();
        assert_eq!(names(&standbys, directory).len(), 1);
        assert_eq!(FILES.all(directory).unwrap().len(), 1, "what was left of the killed one is removed");
        drop(one);
        assert!(names(&standbys, directory).is_empty(), "it has ended");
    }

    #[test]
    fn what_else_lies_there_hides_no_standby_and_holds_nobody_up() {
        let directory = tempfile::tempdir().unwrap();
        let directory = directory.path();
        let standbys = Standbys::default();
        for junk in 0..40 {
            let junk = File::create(FILES.path(directory, junk)).unwrap();
            junk.set_modified(SystemTime::now() - PATIENCE).unwrap();
        }
        fs::create_dir(FILES.path(directory, 40)).unwrap();
        let fifo = std::process::Command::new("mkfifo").arg(FILES.path(directory, 41)).status();
        assert!(fifo.unwrap().success());
        let mut one = presence(directory);
        for _ in 0..2 {
            one.show();
            standbys.look(directory, PATIENCE);
        }
        assert_eq!(standbys.present(), [HOLDER.as_str()]);
        let talker = FILES.path(directory, 42);
        for beat in 0..2 {
            fs::write(
                &talker,
                Content { holder: "x".repeat(400), ..Content::new(beat, one.liveness) }.to_text(),
            )
            .unwrap();
            standbys.look(directory, PATIENCE);
        }
        assert!(standbys.present().iter().all(|name| name.len() <= HOLDER_CHARACTERS), "as long as a name");
        assert_eq!(standbys.present().len(), 2);
    }

    #[test]
    fn a_standby_that_cannot_write_stands_by() {
        let directory = tempfile::tempdir().unwrap();
        let mut one = presence(&directory.path().join("not there"));
        one.show();
        one.show();
    }
}
