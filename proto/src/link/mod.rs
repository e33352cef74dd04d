//! The data plane: one QUIC connection between an application (which dials) and a node (which listens).
//!
//! What travels on it:
//! - **Frames** (a typed header and raw payload bytes). Those with at most [`SMALL_PAYLOAD_BYTES`] of payload go, in the
//!   order they were sent and coalesced, over one long-lived stream in each direction. Larger ones each open a stream
//!   of their own, so that a result of 26 MB does not hold up the small ones; they may overtake and be overtaken. The
//!   one promise across both: a link's first small frame (the hello) is received before any large one.
//! - **Content fetches**: the node asks by digest, the application answers from its [`ContentSource`].
//!
//! Every queue is bounded: a full one makes `send` wait and `try_send` refuse; a receiver that does not read stops its
//! peer through QUIC's flow control. Every length is checked against its cap before anything is allocated.
//! It never looks into payloads, and knows nothing about jobs or applications.

mod connect;
mod fetch;
mod outline;
mod receive;
mod send;
mod shared;
mod wire;

use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use bytes::Bytes;
use farm_core::{
    id::ContentHash,
    message::{AppToNode, NodeToApp},
};
use serde::{Serialize, de::DeserializeOwned};
use thiserror::Error;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

pub use self::{
    connect::{
        BindError, CONNECT_TIMEOUT, ConnectError, DataServer, Incoming, LINK_WINDOW_BYTES, MAX_LINKS, connect,
    },
    fetch::{Arrived, FetchError, STALL_TIMEOUT},
    outline::{ContentBytes, PIECE_BYTES},
    receive::LinkReceiver,
    send::{LinkSender, TrySendError},
    wire::{decode_frames, encode_frame},
};
use crate::codec::{CodecError, MAX_PACKED_BYTES};

/// Frames with at most this much payload share the ordered stream, in bytes.
pub const SMALL_PAYLOAD_BYTES: usize = 64 << 10;
/// Most bytes of one content (task allocation or module).
pub const MAX_CONTENT_BYTES: u64 = 16 << 30;
/// Frames that wait to be sent on one link, and received frames that wait to be read: at most this many each.
pub const QUEUED_FRAMES: usize = 1_024;
/// Large frames on the way at once in one direction of a link.
pub const BULK_STREAMS: u32 = 8;
/// Content fetches on the way at once on one link; further ones wait.
pub const FETCH_STREAMS: u32 = 8;

/// What can be a frame's header.
pub trait Header: Serialize + DeserializeOwned + fmt::Debug + Send + Sync + 'static {
    /// Most payload of one such frame, in bytes.
    const MAX_PAYLOAD_BYTES: u64;
}

impl Header for AppToNode {
    /// One program; several go in smaller frames.
    const MAX_PAYLOAD_BYTES: u64 = MAX_PACKED_BYTES;
}

impl Header for NodeToApp {
    /// The most a program may yield (`ProgramQuota::result_bytes`).
    const MAX_PAYLOAD_BYTES: u64 = 1 << 30;
}

/// One received frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame<H> {
    /// What it says.
    pub header: H,
    /// Raw bytes; empty for most headers.
    pub payload: Bytes,
}

/// The two ends of an established link: `S` is what this side says, `R` what it hears. The link closes when the
/// receiver and every sender are dropped (queued frames are lost then; see [`LinkSender::close_after_sent`]).
#[derive(Debug)]
pub struct Link<S, R> {
    /// Cloneable.
    pub sender: LinkSender<S>,
    /// The one reader.
    pub receiver: LinkReceiver<R>,
}

/// Answers the other side's content fetches: the bytes of a digest, or `None` if they are not here.
#[derive(Clone)]
pub struct ContentSource {
    at_hand: Lookup,
    stored: Option<(Lookup, Arc<Semaphore>)>,
    served_bytes: Arc<AtomicU64>,
}

/// Contents that were read from storage for others, and are not sent yet; each is in memory whole.
const STORED_AT_ONCE: usize = 4;

type Lookup = Arc<dyn Fn(ContentHash) -> Option<ContentBytes> + Send + Sync>;

impl ContentSource {
    /// A source that asks `lookup`. Called on a network task: it looks up, it does not compute or block.
    pub fn new(lookup: impl Fn(ContentHash) -> Option<ContentBytes> + Send + Sync + 'static) -> Self {
        Self { at_hand: Arc::new(lookup), stored: None, served_bytes: Arc::default() }
    }

    /// Where that has nothing, `lookup` is asked, which may block: it is called on a thread for that. Four answers of it are in
    /// memory at once; further ones wait until one is sent.
    #[must_use]
    pub fn or_stored(
        self,
        lookup: impl Fn(ContentHash) -> Option<ContentBytes> + Send + Sync + 'static,
    ) -> Self {
        Self { stored: Some((Arc::new(lookup), Arc::new(Semaphore::new(STORED_AT_ONCE)))), ..self }
    }

    /// A source that has nothing.
    #[must_use]
    pub fn empty() -> Self {
        Self::new(|_| None)
    }

    /// Adds the bytes of contents that are sent to this count, those of fetches that break off too.
    #[must_use]
    pub fn counted_in(self, served_bytes: Arc<AtomicU64>) -> Self {
        Self { served_bytes, ..self }
    }

    fn count(&self, bytes: u64) {
        self.served_bytes.fetch_add(bytes, Ordering::Relaxed);
    }

    /// The bytes, and what to keep until they are sent.
    async fn get(&self, hash: ContentHash) -> Option<(ContentBytes, Option<OwnedSemaphorePermit>)> {
        if let Some(bytes) = (self.at_hand)(hash) {
            return Some((bytes, None));
        }
        let (stored, room) = self.stored.as_ref()?;
        let (stored, permit) = (Arc::clone(stored), Arc::clone(room).acquire_owned().await.ok()?);
        // A runtime that ends answers nothing any more.
        let bytes = tokio::task::spawn_blocking(move || stored(hash)).await.ok().flatten()?;
        Some((bytes, Some(permit)))
    }
}

impl fmt::Debug for ContentSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("ContentSource")
    }
}

/// Why a link carries nothing further. Final: a new link may be tried.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum LinkError {
    /// The other side closed it.
    #[error("closed by the peer: {reason}")]
    ClosedByPeer {
        /// Its words.
        reason: String,
    },
    /// This side closed it.
    #[error("closed here: {reason}")]
    ClosedHere {
        /// The words given.
        reason: String,
    },
    /// The peer fell silent, or the network lost it.
    #[error("lost: {reason}")]
    Lost {
        /// The network stack's words.
        reason: String,
    },
    /// The peer broke the protocol; the link was closed for it.
    #[error("protocol broken by the peer: {reason}")]
    Protocol {
        /// How.
        reason: String,
    },
    /// A frame is over its cap and was not sent; the link stands.
    #[error("frame not sent: {reason}")]
    Frame {
        /// Which cap.
        reason: String,
    },
}

impl From<CodecError> for LinkError {
    fn from(error: CodecError) -> Self {
        Self::Frame { reason: error.to_string() }
    }
}

#[cfg(test)]
mod tests;
