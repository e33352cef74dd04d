//! The journals that `--resume` of `render` and `mi` keeps beside what they write. What is in them is the SDK's.

use std::{fs, io, path::Path};

use anyhow::anyhow;
use client_sdk::{Journal, JournalError};

use crate::failure::Failure;

/// What a journal's name ends with.
pub(crate) const EXTENSION: &str = "gleaner-journal";

/// Opens or begins the journal of a run, and says what is in it.
pub(crate) fn open(path: &Path, label: &str) -> Result<Journal, Failure> {
    let journal = Journal::open(path, label).map_err(failure)?;
    let shown = path.display();
    if journal.cut_bytes() > 0 {
        tell!("farmctl: {shown}: the last {} B were torn and are cut off", journal.cut_bytes());
    }
    match journal.results() {
        0 => tell!(
            "farmctl: results are kept in {shown}: should this end early, the same command goes on from there"
        ),
        results => {
            tell!("farmctl: going on from {shown}: {results} results, {:.1} MB", megabytes(journal.bytes()))
        }
    }
    Ok(journal)
}

/// Says that there is a journal that was not asked for.
pub(crate) fn mention(path: &Path) {
    if path.exists() {
        tell!("farmctl: {} is there and not used: --resume goes on from it", path.display());
    }
}

/// Says where an incomplete run goes on.
pub(crate) fn tell_kept(path: &Path) {
    tell!("farmctl: what was computed is in {}: the same command goes on from there", path.display());
}

/// Removes the journal of a run whose output is written.
pub(crate) fn remove(path: &Path) {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            tell!(
                "farmctl: warning: {} is of no use any more and cannot be removed: {error}",
                path.display()
            );
        }
        Ok(()) | Err(_) => {}
    }
}

/// Why a journal cannot be used, and what to do.
pub(crate) fn failure(error: JournalError) -> Failure {
    match &error {
        JournalError::OtherRun { path, .. }
        | JournalError::OtherTasks { path, .. }
        | JournalError::OtherInputs { path, .. } => {
            let path = path.display();
            Failure::Usage(anyhow!("{error}; repeat the command that it is of, or `rm {path}` to begin anew"))
        }
        JournalError::Version { path, .. } | JournalError::Damaged { path, .. } => {
            let path = path.display();
            Failure::Work(anyhow!("{error}; `rm {path}` to begin anew"))
        }
        JournalError::Io { .. }
        | JournalError::InUse { .. }
        | JournalError::NotAJournal { .. }
        | JournalError::Full { .. }
        | JournalError::OverBound { .. } => Failure::Work(error.into()),
    }
}

#[expect(clippy::cast_precision_loss, reason = "a size for people")]
fn megabytes(bytes: u64) -> f64 {
    bytes as f64 / 1e6
}
