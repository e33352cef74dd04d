//! What the coordinator keeps over its own death: today the epoch alone. Plans, load and fairness are rebuilt from
//! re-registration and never stored.

use std::{
    fmt::Debug,
    fs::{self, File, TryLockError},
    io::{self, Write as _},
    path::{Path, PathBuf},
    time::SystemTime,
};

use farm_core::id::Epoch;

use crate::StartError;

/// The file that holds the last epoch begun, as a decimal number.
const EPOCH_FILE: &str = "epoch";
/// Where the next one is written before it takes the file's place.
const EPOCH_DRAFT: &str = "epoch.new";
/// Held by the coordinator that uses the directory.
const LOCK_FILE: &str = "lock";
/// From 1970-01-01 to 2026-01-01: 56 years, 14 of them leap years.
const SECONDS_1970_TO_2026: u64 = (56 * 365 + 14) * 86_400;
/// Longest epoch file that is believed, in bytes: a u32 has ten digits.
const MAX_EPOCH_BYTES: u64 = 16;

/// Durable state of a coordinator.
pub(crate) trait ControlStore: Debug + Send {
    /// Begins a new life: larger than every earlier one, and durable when this returns.
    fn begin_epoch(&mut self) -> Result<Epoch, StartError>;
}

/// No state: lives are told apart by the wall clock, so that ids of an earlier life on the same address are never given out
/// again. Two starts within one second, or a clock set back between them, are what `FileStore` is for.
#[derive(Debug)]
pub(crate) struct MemoryStore;

impl ControlStore for MemoryStore {
    fn begin_epoch(&mut self) -> Result<Epoch, StartError> {
        let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let seconds = since_1970.as_secs().saturating_sub(SECONDS_1970_TO_2026).max(1);
        // Full in the year 2162.
        Ok(Epoch(u32::try_from(seconds).unwrap_or(u32::MAX)))
    }
}

/// State in a directory of its own, locked for as long as this lives.
#[derive(Debug)]
pub(crate) struct FileStore {
    directory: PathBuf,
    _lock: File,
}

impl FileStore {
    /// Makes the directory if it is not there; refuses one that another coordinator uses.
    pub(crate) fn open(directory: &Path) -> Result<Self, StartError> {
        fs::create_dir_all(directory).map_err(|error| fault(directory, &error))?;
        let path = directory.join(LOCK_FILE);
        let lock = File::create(&path).map_err(|error| fault(&path, &error))?;
        match lock.try_lock() {
            Ok(()) => Ok(Self { directory: directory.to_owned(), _lock: lock }),
            Err(TryLockError::WouldBlock) => Err(fault(directory, &"another coordinator uses it")),
            Err(TryLockError::Error(error)) => Err(fault(&path, &error)),
        }
    }

    fn last_epoch(&self) -> Result<u32, StartError> {
        let path = self.directory.join(EPOCH_FILE);
        let length = match fs::metadata(&path) {
            Ok(metadata) => metadata.len(),
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(0),
            Err(error) => return Err(fault(&path, &error)),
        };
        // Starting over at epoch 1 would let old attempts win over new ones: a file that makes no sense is an error.
        let garbled = || fault(&path, &"does not hold an epoch; restore it, or remove it if no worker runs");
        if length > MAX_EPOCH_BYTES {
            return Err(garbled());
        }
        let text = fs::read_to_string(&path).map_err(|error| fault(&path, &error))?;
        text.trim_end().parse().map_err(|_| garbled())
    }

    /// Draft, fsync, rename, fsync of the directory: after a power cut either the old number or the new one is there.
    fn write_epoch(&self, epoch: u32) -> io::Result<()> {
        let draft = self.directory.join(EPOCH_DRAFT);
        let mut file = File::create(&draft)?;
        writeln!(file, "{epoch}")?;
        file.sync_all()?;
        fs::rename(&draft, self.directory.join(EPOCH_FILE))?;
        File::open(&self.directory)?.sync_all()
    }
}

impl ControlStore for FileStore {
    fn begin_epoch(&mut self) -> Result<Epoch, StartError> {
        let last = self.last_epoch()?;
        let next = last.checked_add(1).ok_or_else(|| fault(&self.directory, &"all epochs are used up"))?;
        self.write_epoch(next).map_err(|error| fault(&self.directory, &error))?;
        Ok(Epoch(next))
    }
}

fn fault(path: &Path, reason: &dyn ToString) -> StartError {
    StartError::State { path: path.to_owned(), reason: reason.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn epochs_grow_over_lives() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("made/on/demand");
        for expected in 1..=3 {
            assert_eq!(FileStore::open(&path).unwrap().begin_epoch().unwrap(), Epoch(expected));
        }
        assert!(!path.join(EPOCH_DRAFT).exists(), "the draft took the file's place");
    }

    #[test]
    fn a_directory_has_one_coordinator() {
        let directory = tempfile::tempdir().unwrap();
        let first = FileStore::open(directory.path()).unwrap();
        let error = FileStore::open(directory.path()).unwrap_err();
        assert!(error.to_string().contains("another coordinator"), "got {error}");
        drop(first);
        FileStore::open(directory.path()).unwrap();
    }

    #[test]
    fn without_state_lives_are_told_apart_by_the_clock() {
        // The hostile test of 2026-11-23: with epoch 1 at each start, a stranger got the id of an application of the life
        // before, and the two took over each other's session for ever.
        assert!(MemoryStore.begin_epoch().unwrap() > Epoch(20_000_000), "the clock is past August 2026");
    }

    #[test]
    fn a_draft_left_by_a_crash_is_ignored() {
        let directory = tempfile::tempdir().unwrap();
        FileStore::open(directory.path()).unwrap().begin_epoch().unwrap();
        fs::write(directory.path().join(EPOCH_DRAFT), "9").unwrap();
        assert_eq!(FileStore::open(directory.path()).unwrap().begin_epoch().unwrap(), Epoch(2));
    }

    #[test]
    fn what_cannot_be_believed_is_an_error_naming_the_file() {
        let directory = tempfile::tempdir().unwrap();
        for garbage in ["", "x", "-1", "4294967296", "1\n2", "00000000000000000000001"] {
            fs::write(directory.path().join(EPOCH_FILE), garbage).unwrap();
            let error = FileStore::open(directory.path()).unwrap().begin_epoch().unwrap_err();
            assert!(error.to_string().contains(EPOCH_FILE), "{garbage:?}: got {error}");
        }
        fs::write(directory.path().join(EPOCH_FILE), u32::MAX.to_string()).unwrap();
        let error = FileStore::open(directory.path()).unwrap().begin_epoch().unwrap_err();
        assert!(error.to_string().contains("used up"), "got {error}");
        let file = directory.path().join("file");
        fs::write(&file, "").unwrap();
        let error = FileStore::open(&file).unwrap_err();
        assert!(error.to_string().contains("file"), "got {error}");
    }
}
