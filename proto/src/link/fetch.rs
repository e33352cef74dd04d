//! Content fetches over a link: one bidirectional stream each. The request is the digest and the size; the answer is
//! one byte (found or not), the size, and the bytes.

use std::{sync::Arc, time::Duration};

use bytes::{BufMut, Bytes, BytesMut};
use farm_core::{id::ContentHash, program::Content};
use quinn::{ReadExactError, RecvStream, SendStream, WriteError};
use thiserror::Error;

use super::{ContentSource, LinkError, MAX_CONTENT_BYTES, shared::Shared, wire::protocol};

/// A fetch in which no byte comes for this long is given up.
pub const STALL_TIMEOUT: Duration = Duration::from_secs(30);
/// A content is sent in pieces of this size, in bytes.
const PIECE_BYTES: usize = 1 << 20;
/// The receiving buffer starts at most this large and doubles as bytes really come, in bytes.
const FIRST_BYTES: usize = 4 << 20;
const REQUEST_BYTES: usize = 32 + 8;
const ANSWER_BYTES: usize = 1 + 8;
const NOT_FOUND: u8 = 0;
const FOUND: u8 = 1;

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
    /// It is over [`MAX_CONTENT_BYTES`].
    #[error("content {hash} of {size_bytes} B is over the cap")]
    TooLarge {
        /// What was asked for.
        hash: ContentHash,
        /// Its size.
        size_bytes: u64,
    },
    /// No byte came for [`STALL_TIMEOUT`]. May be retried.
    #[error("content {0}: no byte came for 30 s")]
    Stalled(ContentHash),
    /// The link is over. May be retried on another.
    #[error(transparent)]
    Link(#[from] LinkError),
}

/// The asking side.
pub(super) async fn fetch(shared: Arc<Shared>, content: Content) -> Result<Bytes, FetchError> {
    let hash = content.hash;
    let size = match usize::try_from(content.size_bytes) {
        Ok(size) if content.size_bytes <= MAX_CONTENT_BYTES => size,
        _ => return Err(FetchError::TooLarge { hash, size_bytes: content.size_bytes }),
    };
    let lost = |_| FetchError::Link(shared.error());
    // Waits while FETCH_STREAMS are on the way.
    let (mut request, mut answer) = shared.connection.open_bi().await.map_err(LinkError::from)?;
    let mut buffer = BytesMut::with_capacity(REQUEST_BYTES);
    buffer.put_slice(&hash.0);
    buffer.put_u64_le(content.size_bytes);
    request.write_chunk(buffer.freeze()).await.map_err(lost)?;
    // The stream is new and was written to: it cannot be closed.
    let _ = request.finish();

    let mut head = [0; ANSWER_BYTES];
    within_stall(hash, answer.read_exact(&mut head)).await?.map_err(|_: ReadExactError| {
        FetchError::Link(
            shared.over().unwrap_or_else(|| protocol("a fetch's answer ends in its head".to_owned())),
        )
    })?;
    let [found, announced @ ..] = head;
    if found != FOUND {
        return Err(FetchError::NotFound(hash));
    }
    let announced = u64::from_le_bytes(announced);
    if announced != content.size_bytes {
        let reason = format!("the peer has {announced} B under this name, not {} B", content.size_bytes);
        return Err(FetchError::Corrupt { hash, reason });
    }
    read_content(&shared, &mut answer, hash, size).await
}

async fn read_content(
    shared: &Shared,
    answer: &mut RecvStream,
    hash: ContentHash,
    size: usize,
) -> Result<Bytes, FetchError> {
    let mut bytes = BytesMut::with_capacity(size.min(FIRST_BYTES));
    let mut hasher = blake3::Hasher::new();
    loop {
        let read = within_stall(hash, answer.read_chunk(PIECE_BYTES, true)).await?;
        let Some(chunk) = read.map_err(|_| FetchError::Link(shared.error()))? else { break };
        if bytes.len() + chunk.bytes.len() > size {
            return Err(FetchError::Corrupt { hash, reason: format!("more than {size} B came") });
        }
        hasher.update(&chunk.bytes);
        bytes.extend_from_slice(&chunk.bytes);
    }
    if bytes.len() < size {
        return Err(FetchError::Corrupt { hash, reason: format!("{} B came of {size} B", bytes.len()) });
    }
    if *hasher.finalize().as_bytes() != hash.0 {
        return Err(FetchError::Corrupt { hash, reason: "the bytes have another digest".to_owned() });
    }
    Ok(bytes.freeze())
}

async fn within_stall<T>(hash: ContentHash, step: impl Future<Output = T>) -> Result<T, FetchError> {
    tokio::time::timeout(STALL_TIMEOUT, step).await.map_err(|_| FetchError::Stalled(hash))
}

/// The answering side: until the link is over.
pub(super) async fn serve_contents(shared: Arc<Shared>, source: ContentSource) {
    // QUIC's stream limit bounds the answers on the way.
    while let Ok((answer, request)) = shared.connection.accept_bi().await {
        let (shared, source) = (Arc::clone(&shared), source.clone());
        tokio::spawn(async move {
            if let Err(reason) = answer_fetch(&source, answer, request).await {
                tracing::debug!(%reason, peer = %shared.connection.remote_address(), "a fetch broke off");
            }
        });
    }
}

async fn answer_fetch(
    source: &ContentSource,
    mut answer: SendStream,
    mut request: RecvStream,
) -> Result<(), String> {
    let mut asked = [0; REQUEST_BYTES];
    request.read_exact(&mut asked).await.map_err(|error| error.to_string())?;
    let mut hash = [0; 32];
    hash.copy_from_slice(&asked[..32]);
    let (found, _room) = source.get(ContentHash(hash)).await.unzip();
    let mut head = BytesMut::with_capacity(ANSWER_BYTES);
    head.put_u8(if found.is_some() { FOUND } else { NOT_FOUND });
    head.put_u64_le(found.as_ref().map_or(0, |bytes| bytes.len() as u64));
    let write = |error: WriteError| error.to_string();
    answer.write_chunk(head.freeze()).await.map_err(write)?;
    let mut rest = found.unwrap_or_default();
    while !rest.is_empty() {
        // Slices of the source's own memory: nothing is copied, and flow control holds the rest back.
        let piece = rest.split_to(rest.len().min(PIECE_BYTES));
        answer.write_chunk(piece).await.map_err(write)?;
    }
    answer.finish().map_err(|error| error.to_string())
}
