//! Who is who in a secured farm (20-delivery.md "Security"): the farm's own certificate authority, the identities that it
//! gives out, one-time join tokens, and capabilities by which a node knows an application.
//!
//! An identity is an X.509 certificate (ECDSA P-256) whose one URI names farm, role and name, with its key in one PEM file.
//! Nothing here listens or dials, and nothing here decides what a role may do: that is the coordinator's and the node's.

mod authority;
mod capability;
mod identity;
mod principal;
mod scope;
mod token;
pub(crate) mod verify;

use std::{
    fs::{self, OpenOptions},
    io::{self, Write as _},
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
    time::{Duration, SystemTime},
};

use ring::rand::{SecureRandom as _, SystemRandom};
use thiserror::Error;

pub use self::{
    authority::Authority,
    capability::{Capability, MAX_CAPABILITY_BYTES},
    identity::{Identity, Membership, NewKey, default_identity},
    principal::{Member, Principal, Role, check_name},
    scope::Scope,
    token::{JoinToken, SECRET_BYTES},
};

/// How long an identity lives; it is renewed, without a restart, when two thirds of it are over.
pub const IDENTITY_LIFETIME: Duration = Duration::from_secs(30 * 86_400);

/// Largest PEM file that is read, in bytes; an identity has about 2 kB.
const MAX_FILE_BYTES: u64 = 64 << 10;

/// Something about an identity is wrong. The text names the file, or says what was expected.
#[derive(Debug, Error)]
pub enum TrustError {
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// A file does not hold what it should.
    #[error("{}: {reason}", path.display())]
    Garbled {
        /// Which.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A farm, role, name, token or certificate is not what it must be.
    #[error("{0}")]
    Invalid(String),
    /// No certificate could be made.
    #[error("cannot make a certificate: {0}")]
    Certificate(#[from] rcgen::Error),
}

impl TrustError {
    fn garbled(path: &Path, reason: impl ToString) -> Self {
        Self::Garbled { path: path.to_owned(), reason: reason.to_string() }
    }
}

/// Bytes that nobody guesses.
///
/// # Errors
/// The system gives no randomness.
pub fn random<const BYTES: usize>() -> Result<[u8; BYTES], TrustError> {
    let mut bytes = [0; BYTES];
    let drawn = SystemRandom::new().fill(&mut bytes);
    drawn.map_err(|_| TrustError::Invalid("the system gives no randomness".to_owned()))?;
    Ok(bytes)
}

/// Seconds since 1970, as certificates, capabilities and logs count; before 1970 it is 1970.
#[must_use]
pub(crate) fn unix_seconds(time: SystemTime) -> u64 {
    time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs()
}

/// The same of now.
#[must_use]
pub fn unix_now() -> u64 {
    unix_seconds(SystemTime::now())
}

/// Reads a small text file.
fn read_text(path: &Path) -> Result<String, TrustError> {
    let fault = |source| TrustError::File { path: path.to_owned(), source };
    let metadata = fs::metadata(path).map_err(fault)?;
    if !metadata.is_file() {
        return Err(TrustError::garbled(path, "is not a file"));
    }
    if metadata.len() > MAX_FILE_BYTES {
        return Err(TrustError::garbled(path, format!("is over {MAX_FILE_BYTES} B")));
    }
    fs::read_to_string(path).map_err(fault)
}

/// Writes a secret: readable by its owner alone, and either the old text or the new one is there after a crash.
fn write_secret(path: &Path, text: &str) -> Result<(), TrustError> {
    let fault = |source| TrustError::File { path: path.to_owned(), source };
    let folder =
        path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."));
    fs::create_dir_all(folder).map_err(fault)?;
    let mut draft = path.as_os_str().to_owned();
    draft.push(format!(".new-{}", std::process::id()));
    let draft = PathBuf::from(draft);
    let write = || {
        let _ = fs::remove_file(&draft);
        let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&draft)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        fs::rename(&draft, path)?;
        fs::File::open(folder)?.sync_all()
    };
    write().map_err(|error| {
        // A half of it is of no use.
        let _ = fs::remove_file(&draft);
        fault(error)
    })
}
