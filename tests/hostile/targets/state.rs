//! The coordinator's state folder, applications' journals, and folders for decoders of files.

use std::{
    fs::{self, File},
    io::{self, BufWriter, Seek, Write},
    path::{Path, PathBuf},
};

use tempfile::TempDir;

use super::{Verdict, refused};

/// Longest run of zeros that is spelled out in a packed store, in bytes.
const LONGEST_ZEROS: usize = 8;

/// A folder that is gone with its owner.
pub(crate) struct Folder(TempDir);

impl Folder {
    pub(crate) fn new() -> Self {
        Self(TempDir::new().expect("a temporary folder"))
    }

    /// Lends the thread's own one: making one for each input would cost more than most decoders.
    pub(crate) fn of_thread<T>(use_it: impl FnOnce(&Self) -> T) -> T {
        thread_local! {
            static FOLDER: Folder = Folder::new();
        }
        FOLDER.with(use_it)
    }

    /// Where it is.
    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }

    /// Writes a file into it.
    pub(crate) fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.path().join(name);
        fs::write(&path, bytes).expect("a file in a temporary folder");
        path
    }

    /// Reads a file of it.
    pub(crate) fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path().join(name)).expect("a file in a temporary folder")
    }

    /// The file that `write` writes.
    pub(crate) fn new_file(write: impl FnOnce(&Path)) -> Vec<u8> {
        let folder = Self::new();
        write(&folder.path().join("file"));
        folder.read("file")
    }

    /// What `read` makes of a file with these bytes.
    pub(crate) fn with<T>(&self, name: &str, bytes: &[u8], read: impl FnOnce(&Path) -> T) -> T {
        read(&self.write(name, bytes))
    }
}

/// A control store, its zeros packed: most of it are.
pub(super) fn control_store(bytes: &[u8]) -> Verdict {
    let folder = Folder::new();
    let file = File::create(folder.path().join("control.redb")).expect("a file in a temporary folder");
    unpack(bytes, BufWriter::new(file)).expect("a file in a temporary folder");
    coordinator::check_state(folder.path()).map_err(refused)
}

/// Where versions before the store kept the epoch.
pub(super) fn epoch_file(bytes: &[u8]) -> Verdict {
    let folder = Folder::new();
    folder.write("epoch", bytes);
    coordinator::check_state(folder.path()).map_err(refused)
}

/// A run's journal: opened, and what was torn at its end is cut off.
pub(super) fn run_journal(bytes: &[u8]) -> Verdict {
    Folder::of_thread(|folder| {
        folder.with("journal", bytes, |path| {
            let journal = client_sdk::Journal::open(path, JOURNAL_LABEL).map_err(refused)?;
            let (results, size) = (journal.results(), journal.bytes());
            drop(journal);
            // What was left is sound: the next process finds the same.
            let again = client_sdk::Journal::open(path, JOURNAL_LABEL).expect("it was opened before");
            assert_eq!(
                (again.results(), again.bytes(), again.cut_bytes()),
                (results, size, 0),
                "opened again"
            );
            Ok(())
        })
    })
}

/// The label of the corpus' journals: any other is refused after the header.
const JOURNAL_LABEL: &str = "test, seed 7";

/// Bytes with each long run of zeros as an escape: `GLZ`, then the length of the run (`u32`, little-endian).
pub(crate) fn packed(bytes: &[u8]) -> Vec<u8> {
    let mut packed = Vec::new();
    let mut rest = bytes;
    while let Some(&byte) = rest.first() {
        let zeros = rest.iter().take_while(|byte| **byte == 0).count();
        if zeros > LONGEST_ZEROS {
            packed.extend_from_slice(ESCAPE);
            packed.extend_from_slice(&u32::try_from(zeros).expect("a small store").to_le_bytes());
            rest = &rest[zeros..];
        } else {
            packed.push(byte);
            rest = &rest[1..];
        }
    }
    packed
}

const ESCAPE: &[u8] = b"GLZ";
/// Largest store that is unpacked, in bytes.
const MAX_STORE_BYTES: u64 = 8 << 20;

/// Writes what [`packed`] packed; the zeros are holes of the file.
fn unpack(mut packed: &[u8], mut file: impl Write + Seek) -> io::Result<()> {
    let mut room = MAX_STORE_BYTES;
    while room > 0 && !packed.is_empty() {
        if let Some((zeros, rest)) =
            packed.strip_prefix(ESCAPE).and_then(|rest| rest.split_first_chunk::<4>())
        {
            let zeros = u64::from(u32::from_le_bytes(*zeros)).min(room);
            if zeros > 0 {
                file.seek_relative(zeros.cast_signed() - 1)?;
                file.write_all(&[0])?;
            }
            (packed, room) = (rest, room - zeros);
        } else {
            file.write_all(&packed[..1])?;
            (packed, room) = (&packed[1..], room - 1);
        }
    }
    file.flush()
}
