//! Content fetches over a link: one bidirectional stream each. The request is the digest, the size, and from which piece on;
//! the answer is one byte (found or not), the size, the outline (see [`super::outline`]) and the pieces. Each is checked as it
//! comes; what was checked outlives the fetch, and the next one, of whichever peer, goes on from there.

use std::{sync::Arc, time::Duration};

use bytes::{Buf as _, BufMut as _, BytesMut};
use farm_core::{id::ContentHash, program::Content};
use quinn::{ReadExactError, RecvStream, SendStream, WriteError};
use thiserror::Error;

use super::{
    ContentSource, LinkError, MAX_CONTENT_BYTES,
    outline::{ContentBytes, Outline, PIECE_BYTES},
    shared::Shared,
    wire::protocol,
};

/// A fetch in which no byte comes for this long is given up.
pub const STALL_TIMEOUT: Duration = Duration::from_secs(30);
/// The receiving buffer starts at most this large and doubles as bytes really come, in bytes.
const FIRST_BYTES: usize = 4 << 20;
const REQUEST_BYTES: usize = 32 + 8 + 4;
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

/// What of a content has come and was checked.
#[derive(Debug, Default)]
pub struct Arrived {
    /// Whole pieces from the start.
    bytes: BytesMut,
}

impl Arrived {
    /// All of a content.
    #[cfg(test)]
    pub(super) fn of(content: &ContentBytes) -> Self {
        Self { bytes: BytesMut::from(&content[..]) }
    }

    /// How many bytes are here.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        self.bytes.len() as u64
    }
}

/// The asking side.
pub(super) async fn fetch(
    shared: Arc<Shared>,
    name: ContentHash,
    content: Content,
    arrived: &mut Arrived,
) -> Result<ContentBytes, FetchError> {
    let hash = content.hash;
    let size = match usize::try_from(content.size_bytes) {
        Ok(size) if content.size_bytes <= MAX_CONTENT_BYTES => size,
        _ => return Err(FetchError::TooLarge { hash, size_bytes: content.size_bytes }),
    };
    let lost = |_| FetchError::Link(shared.error());
    // Waits while FETCH_STREAMS are on the way.
    let (mut request, mut answer) = shared.connection.open_bi().await.map_err(LinkError::from)?;
    // Of another size under the same name nothing counts; nor does the last piece, if all was here but its end was not heard.
    let whole_pieces = if arrived.bytes.len() > size { 0 } else { arrived.bytes.len() / PIECE_BYTES };
    arrived.bytes.truncate(whole_pieces * PIECE_BYTES);
    let first = u32::try_from(whole_pieces).expect("the cap is some thousand pieces");
    let mut buffer = BytesMut::with_capacity(REQUEST_BYTES);
    buffer.put_slice(&name.0);
    buffer.put_u64_le(content.size_bytes);
    buffer.put_u32_le(first);
    request.write_chunk(buffer.freeze()).await.map_err(lost)?;
    // The stream is new and was written to: it cannot be closed.
    let _ = request.finish();

    let cut = |_: ReadExactError| {
        FetchError::Link(
            shared.over().unwrap_or_else(|| protocol("a fetch's answer ends in its head".to_owned())),
        )
    };
    let mut head = [0; ANSWER_BYTES];
    within_stall(hash, answer.read_exact(&mut head)).await?.map_err(cut)?;
    let [found, announced @ ..] = head;
    if found != FOUND {
        return Err(FetchError::NotFound(hash));
    }
    let announced = u64::from_le_bytes(announced);
    if announced != content.size_bytes {
        let reason = format!("the peer has {announced} B under this name, not {} B", content.size_bytes);
        return Err(FetchError::Corrupt { hash, reason });
    }
    let mut told = vec![0; Outline::values(size) * blake3::OUT_LEN];
    within_stall(hash, answer.read_exact(&mut told)).await?.map_err(cut)?;
    let outline = Outline::parse(&told, hash, size)
        .ok_or_else(|| FetchError::Corrupt { hash, reason: "the outline is of another digest".to_owned() })?;
    read_pieces(&shared, &mut answer, (hash, size), &outline, &mut arrived.bytes).await?;
    let bytes = std::mem::take(arrived).bytes.freeze();
    Ok(ContentBytes::checked(hash, bytes, outline))
}

/// Reads to the end of the answer. What is in `bytes` afterwards was checked, whatever the outcome.
async fn read_pieces(
    shared: &Shared,
    answer: &mut RecvStream,
    (hash, size): (ContentHash, usize),
    outline: &Outline,
    bytes: &mut BytesMut,
) -> Result<(), FetchError> {
    bytes.reserve((size - bytes.len()).min(FIRST_BYTES));
    let mut checked = bytes.len();
    let outcome = loop {
        let read = match within_stall(hash, answer.read_chunk(PIECE_BYTES, true)).await {
            Ok(read) => read.map_err(|_| FetchError::Link(shared.error())),
            Err(stalled) => Err(stalled),
        };
        match read {
            Ok(Some(chunk)) if bytes.len() + chunk.bytes.len() > size => {
                break Err(FetchError::Corrupt { hash, reason: format!("more than {size} B came") });
            }
            Ok(Some(chunk)) => bytes.extend_from_slice(&chunk.bytes),
            Ok(None) => break Ok(()),
            Err(error) => break Err(error),
        }
        if let Err(piece) = check(outline, hash, size, bytes, &mut checked) {
            let reason = format!("the bytes from {} on have another digest", piece * PIECE_BYTES);
            break Err(FetchError::Corrupt { hash, reason });
        }
    };
    let came = bytes.len();
    bytes.truncate(checked);
    outcome?;
    if came != size {
        return Err(FetchError::Corrupt { hash, reason: format!("{came} B came of {size} B") });
    }
    // Without any byte there was nothing to check.
    let empty_is_right = size > 0 || outline.proves(hash, 0, &[]);
    empty_is_right
        .then_some(())
        .ok_or_else(|| FetchError::Corrupt { hash, reason: "no bytes have another digest".to_owned() })
}

/// Checks the pieces that are complete and were not checked yet; the number of the first that is wrong otherwise.
fn check(
    outline: &Outline,
    hash: ContentHash,
    size: usize,
    bytes: &[u8],
    checked: &mut usize,
) -> Result<(), usize> {
    loop {
        let end = size.min(*checked + PIECE_BYTES);
        if *checked == end || bytes.len() < end {
            return Ok(());
        }
        let index = *checked / PIECE_BYTES;
        if !outline.proves(hash, index, &bytes[*checked..end]) {
            return Err(index);
        }
        *checked = end;
    }
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
    let mut asked = &asked[..];
    let mut hash = [0; 32];
    asked.copy_to_slice(&mut hash);
    let _size_bytes = asked.get_u64_le();
    let first = asked.get_u32_le() as usize;
    let write = |error: WriteError| error.to_string();
    let Some((found, _room)) = source.get(ContentHash(hash)).await else {
        answer.write_all(&[NOT_FOUND; ANSWER_BYTES]).await.map_err(write)?;
        return answer.finish().map_err(|error| error.to_string());
    };
    let mut head = BytesMut::new();
    head.put_u8(FOUND);
    head.put_u64_le(found.len() as u64);
    head.put_slice(found.outline().as_bytes());
    answer.write_chunk(head.freeze()).await.map_err(write)?;
    let mut rest = found.bytes().slice(found.len().min(first.saturating_mul(PIECE_BYTES))..);
    while !rest.is_empty() {
        // Slices of the source's own memory: nothing is copied, and flow control holds the rest back.
        let piece = rest.split_to(rest.len().min(PIECE_BYTES));
        let piece_bytes = piece.len() as u64;
        answer.write_chunk(piece).await.map_err(write)?;
        source.count(piece_bytes);
    }
    answer.finish().map_err(|error| error.to_string())
}
