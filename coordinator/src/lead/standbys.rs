//! Who stands by, for people: each standby has a file `standby-N` in the state directory and writes a beat into it, which the
//! leader looks at. Nothing else depends on it.

use std::{
    collections::{BTreeMap, BTreeSet},
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
/// The leader looks at so many.
const MAX_STANDBYS: usize = 16;
/// A file that stood still for so long is removed: its standby was killed.
const FORGOTTEN: Duration = Duration::from_secs(60);

/// A standby's file; removed when this is dropped.
#[derive(Debug)]
pub(super) struct Presence {
    path: PathBuf,
    liveness: Liveness,
    beat: u64,
    shown: Option<Instant>,
}

impl Presence {
    pub(super) fn new(directory: &Path, liveness: Liveness) -> Self {
        let number = RandomState::new().hash_one("standby");
        Self { path: FILES.path(directory, number), liveness, beat: 0, shown: None }
    }

    /// Writes a beat where the last one is a heartbeat ago.
    ///
    /// # Errors
    /// The first one cannot be written: this one could not lead either.
    pub(super) fn show(&mut self) -> io::Result<()> {
        let heartbeat = Duration::from_millis(self.liveness.heartbeat_ms);
        if self.shown.is_some_and(|shown| shown.elapsed() < heartbeat) {
            return Ok(());
        }
        let text = Content::new(self.beat, self.liveness).to_text();
        // A leader that saw it stand still has removed it.
        let file = OpenOptions::new().write(true).create(true).truncate(false).mode(0o600).open(&self.path);
        let written = file.and_then(|file| file.write_all_at(text.as_bytes(), 0));
        self.beat += 1;
        match self.shown.replace(Instant::now()) {
            None => written,
            Some(_) => Ok(()),
        }
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
}

impl Standbys {
    /// Those that write, in words.
    pub(crate) fn present(&self) -> Vec<String> {
        let seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let words = seen.values().filter(|seen| seen.lives).filter_map(|seen| {
            let content = Content::parse(&seen.text)?;
            (seen.since.elapsed() < Duration::from_millis(content.dead_ms)).then_some(content.holder)
        });
        words.collect()
    }

    /// Reads what they have written. One that cannot be read is not there.
    pub(super) fn look(&self, directory: &Path) {
        let mut found: Vec<u64> = FILES.all(directory).unwrap_or_default();
        found.sort_unstable();
        found.truncate(MAX_STANDBYS);
        let mut texts = BTreeMap::new();
        for &number in &found {
            if let Ok(text) = File::open(FILES.path(directory, number)).and_then(|file| text_of(&file)) {
                texts.insert(number, text);
            }
        }
        let found: BTreeSet<u64> = found.into_iter().collect();
        let mut seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        seen.retain(|number, _| found.contains(number));
        for (number, text) in texts {
            match seen.get_mut(&number) {
                None => {
                    seen.insert(number, Seen { text, since: Instant::now(), lives: false });
                }
                Some(before) if before.text != text => {
                    *before = Seen { text, since: Instant::now(), lives: true };
                }
                Some(before) if before.since.elapsed() > FORGOTTEN => {
                    let _ = fs::remove_file(FILES.path(directory, number));
                }
                Some(_) => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_standby_is_seen_while_it_beats() {
        let directory = tempfile::tempdir().unwrap();
        let directory = directory.path();
        let liveness = Liveness { heartbeat_ms: 0, dead_ms: 60_000, ..Liveness::default() };
        let standbys = Standbys::default();
        let mut one = Presence::new(directory, liveness);
        let mut killed = Presence::new(directory, liveness);
        killed.show().unwrap();
        one.show().unwrap();
        standbys.look(directory);
        assert_eq!(standbys.present(), Vec::<String>::new(), "a file alone is nobody");
        one.show().unwrap();
        standbys.look(directory);
        assert_eq!(standbys.present(), [super::super::holder()]);
        standbys.0.lock().unwrap().values_mut().for_each(|seen| {
            seen.since = Instant::now() - Duration::from_secs(61);
        });
        assert_eq!(standbys.present(), Vec::<String>::new(), "it stands still");
        one.show().unwrap();
        standbys.look(directory);
        assert_eq!(standbys.present().len(), 1);
        assert_eq!(FILES.all(directory).unwrap().len(), 1, "what was left of the killed one is removed");
        drop(one);
        standbys.look(directory);
        assert_eq!(standbys.present(), Vec::<String>::new(), "it has ended");
    }
}
