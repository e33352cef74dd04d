//! What the coordinator keeps over its own death: today the epoch alone. Plans, load and fairness are rebuilt from
//! re-registration and never stored.

use std::{
    fs::{self, File},
    io::{self, Write as _},
    path::{Path, PathBuf},
};

use farm_core::id::Epoch;

use crate::StartError;

/// The file that holds the last epoch begun, as a decimal number.
const EPOCH_FILE: &str = "epoch";
/// Where the next one is written before it takes the file's place.
const EPOCH_DRAFT: &str = "epoch.new";
/// Longest epoch file that is believed, in bytes: a u32 has ten digits.
const MAX_EPOCH_BYTES: u64 = 16;

/// Durable state of a coordinator.
pub(crate) trait ControlStore {
    /// Begins a new life: larger than every earlier one, and durable when this returns.
    fn begin_epoch(&mut self) -> Result<Epoch, StartError>;
}

/// No state: each life is the first. Workers and applications that outlive it refuse nothing, but cannot tell lives apart.
#[derive(Debug)]
pub(crate) struct MemoryStore;

impl ControlStore for MemoryStore {
    fn begin_epoch(&mut self) -> Result<Epoch, StartError> {
        Ok(Epoch(1))
    }
}

/// State in a directory of its own.
#[derive(Debug)]
pub(crate) struct FileStore {
    directory: PathBuf,
}

impl FileStore {
    /// Makes the directory if it is not there.
    pub(crate) fn open(directory: &Path) -> Result<Self, StartError> {
        fs::create_dir_all(directory).map_err(|error| fault(directory, &error))?;
        Ok(Self { directory: directory.to_owned() })
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
        assert_eq!(MemoryStore.begin_epoch().unwrap(), Epoch(1));
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
