//! Content fetches over a link: one bidirectional stream each.

use farm_core::id::ContentHash;
use thiserror::Error;

use super::LinkError;

/// A content could not be had.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum FetchError {
    /// The peer does not have it.
    #[error("the peer does not have content {0}")]
    NotFound(ContentHash),
    /// The peer has other bytes under that name, or the name carries a wrong size.
    #[error("content {hash}: {reason}")]
    Corrupt {
        /// What was asked for.
        hash: ContentHash,
        /// What is wrong.
        reason: String,
    },
    /// It is over `MAX_CONTENT_BYTES`.
    #[error("content {hash} of {size_bytes} B is over the cap")]
    TooLarge {
        /// What was asked for.
        hash: ContentHash,
        /// Its size.
        size_bytes: u64,
    },
    /// No byte came for too long. May be retried.
    #[error("content {0}: no byte came for 30 s")]
    Stalled(ContentHash),
    /// The link is over. May be retried on another.
    #[error(transparent)]
    Link(#[from] LinkError),
}
