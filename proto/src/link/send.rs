//! The sending half of a link: one writer task for the small frames, one short task for each large one.

use std::{fmt, net::SocketAddr, sync::Arc, time::Duration};

use bytes::{BufMut, Bytes, BytesMut};
use farm_core::{id::ContentHash, program::Content};
use quinn::SendStream;
use thiserror::Error;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};

use super::{
    Arrived, BULK_STREAMS, ContentBytes, FetchError, Header, LinkError, QUEUED_FRAMES, SMALL_PAYLOAD_BYTES,
    fetch,
    shared::{Guard, Shared},
    wire,
};
use crate::codec;

/// Frames the writer takes from its queue at once.
const BURST_FRAMES: usize = 512;
/// The writer hands its buffer to the network when it holds this much, in bytes.
const WRITE_BYTES: usize = 64 << 10;
/// How long `close_after_sent` waits for the peer's acknowledgement.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(2);
/// The ordered stream goes before the bulk streams, and those go before contents, which have QUIC's default of 0: a job that waits
/// for nothing else does not wait for another one's data.
const ORDERED_PRIORITY: i32 = i32::MAX;
/// Frames of up to so many bytes go side by side. Of larger ones the older goes first: of several that are ready together the first is
/// there when it could be, not when all are.
const SIDE_BY_SIDE_BYTES: usize = 8 << 20;

/// A frame was not taken.
#[derive(Debug, Error)]
pub enum TrySendError<S> {
    /// The queue is full: the frame is handed back, try again later or use [`LinkSender::send`].
    #[error("the link's queue is full")]
    Full(S, Vec<Bytes>),
    /// The link is over.
    #[error(transparent)]
    Link(LinkError),
}

/// Sends frames and fetches contents; cloneable.
pub struct LinkSender<S> {
    guard: Arc<Guard>,
    queue: mpsc::Sender<Queued<S>>,
    bulk: Arc<Semaphore>,
}

enum Queued<S> {
    Frame(S, Vec<Bytes>),
    /// Everything before this is to be acknowledged by the peer; then the sender is told.
    Flush(oneshot::Sender<()>),
}

impl<S> Clone for LinkSender<S> {
    fn clone(&self) -> Self {
        Self { guard: Arc::clone(&self.guard), queue: self.queue.clone(), bulk: Arc::clone(&self.bulk) }
    }
}

impl<S> fmt::Debug for LinkSender<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("LinkSender").field(&self.remote_address()).finish()
    }
}

impl<S: Header> LinkSender<S> {
    pub(super) fn new(guard: Arc<Guard>) -> Self {
        let (queue, queued) = mpsc::channel(QUEUED_FRAMES);
        tokio::spawn(write_ordered(guard.shared(), queued));
        Self { guard, queue, bulk: Arc::new(Semaphore::new(BULK_STREAMS as usize)) }
    }

    /// Queues a frame; waits while the queue is full. The payload's chunks are sent one after the other.
    /// `Ok` means queued, not received.
    ///
    /// # Errors
    /// The link is over, or the payload is over its cap.
    pub async fn send(&self, header: S, payload: Vec<Bytes>) -> Result<(), LinkError> {
        if payload_bytes::<S>(&payload)? <= SMALL_PAYLOAD_BYTES {
            return self.queue.send(Queued::Frame(header, payload)).await.map_err(|_| self.guard.error());
        }
        // The semaphore is never closed; the permit comes back when the peer has the frame or the link is over.
        let permit = Arc::clone(&self.bulk).acquire_owned().await.map_err(|_| self.guard.error())?;
        self.spawn_bulk(permit, header, payload)
    }

    /// Queues a frame without waiting.
    ///
    /// # Errors
    /// The queue is full (the frame comes back), the link is over, or the payload is over its cap.
    pub fn try_send(&self, header: S, payload: Vec<Bytes>) -> Result<(), TrySendError<S>> {
        if payload_bytes::<S>(&payload).map_err(TrySendError::Link)? <= SMALL_PAYLOAD_BYTES {
            return self.queue.try_send(Queued::Frame(header, payload)).map_err(|error| match error {
                mpsc::error::TrySendError::Full(Queued::Frame(header, payload)) => {
                    TrySendError::Full(header, payload)
                }
                mpsc::error::TrySendError::Full(Queued::Flush(_)) | mpsc::error::TrySendError::Closed(_) => {
                    TrySendError::Link(self.guard.error())
                }
            });
        }
        match Arc::clone(&self.bulk).try_acquire_owned() {
            Ok(permit) => self.spawn_bulk(permit, header, payload).map_err(TrySendError::Link),
            Err(_) => Err(TrySendError::Full(header, payload)),
        }
    }

    fn spawn_bulk(
        &self,
        permit: OwnedSemaphorePermit,
        header: S,
        payload: Vec<Bytes>,
    ) -> Result<(), LinkError> {
        if let Some(error) = self.guard.over() {
            return Err(error);
        }
        tokio::spawn(write_bulk(self.guard.shared(), permit, header, payload));
        Ok(())
    }
}

impl<S> LinkSender<S> {
    /// Fetches a content from the other side's [`super::ContentSource`], or what is missing of it; the bytes are checked against
    /// size and digest, piece by piece. After an error `arrived` holds what is right; it must not be of another content.
    ///
    /// # Errors
    /// Not found, wrong bytes, stalled, or the link is over.
    pub async fn fetch(&self, content: Content, arrived: &mut Arrived) -> Result<ContentBytes, FetchError> {
        self.fetch_named(content.hash, content, arrived).await
    }

    /// The same of a content that the other side has under another name than its digest.
    ///
    /// # Errors
    /// As [`Self::fetch`].
    pub async fn fetch_named(
        &self,
        name: ContentHash,
        content: Content,
        arrived: &mut Arrived,
    ) -> Result<ContentBytes, FetchError> {
        fetch::fetch(self.guard.shared(), name, content, arrived).await
    }

    /// The peer's address.
    #[must_use]
    pub fn remote_address(&self) -> SocketAddr {
        self.guard.connection().remote_address()
    }

    /// Closes at once; what is queued or on the way is lost. The peer gets the reason.
    pub fn close(&self, reason: &str) {
        self.guard.close(reason);
    }

    /// Sends what is queued, waits (at most two seconds) until the peer has it, then closes.
    pub async fn close_after_sent(&self, reason: &str) {
        let flushed = async {
            let (done, flushed) = oneshot::channel();
            if self.queue.send(Queued::Flush(done)).await.is_ok() {
                // An error means that the writer is gone with the link: nothing is left to wait for.
                let _ = flushed.await;
            }
            // All permits: no large frame is on the way any more.
            let _ = self.bulk.acquire_many(BULK_STREAMS).await;
        };
        // Late or not, the link ends here.
        let _ = tokio::time::timeout(FLUSH_TIMEOUT, flushed).await;
        self.close(reason);
    }

    /// Waits until the link is over, and says why. Cancel-safe.
    pub async fn closed(&self) -> LinkError {
        self.guard.connection().closed().await;
        self.guard.error()
    }
}

fn payload_bytes<S: Header>(payload: &[Bytes]) -> Result<usize, LinkError> {
    let bytes: usize = payload.iter().map(Bytes::len).sum();
    let cap = S::MAX_PAYLOAD_BYTES;
    if bytes as u64 > cap {
        return Err(LinkError::Frame { reason: format!("payload of {bytes} B is over {cap} B") });
    }
    Ok(bytes)
}

/// Writes small frames until every sender is gone or the link is over.
async fn write_ordered<S: Header>(shared: Arc<Shared>, mut queue: mpsc::Receiver<Queued<S>>) {
    let Ok(mut stream) = shared.connection.open_uni().await else { return };
    // Fails only if the stream is gone, which the first write reports.
    let _ = stream.set_priority(ORDERED_PRIORITY);
    let mut buffer = BytesMut::with_capacity(WRITE_BYTES);
    buffer.put_u8(wire::ORDERED_STREAM);
    let mut queued = Vec::with_capacity(BURST_FRAMES);
    while queue.recv_many(&mut queued, BURST_FRAMES).await > 0 {
        for item in queued.drain(..) {
            match item {
                Queued::Frame(header, payload) => {
                    if let Err(error) = append_small(&mut buffer, &header, &payload) {
                        shared.fail(error.into());
                        return;
                    }
                    if buffer.len() >= WRITE_BYTES && !write(&mut stream, &mut buffer).await {
                        return;
                    }
                }
                Queued::Flush(done) => {
                    if write(&mut stream, &mut buffer).await && stream.finish().is_ok() {
                        // Whether acknowledged or given up by the peer: there is nothing more to wait for.
                        let _ = stream.stopped().await;
                    }
                    let _ = done.send(());
                    return;
                }
            }
        }
        if !buffer.is_empty() && !write(&mut stream, &mut buffer).await {
            return;
        }
    }
}

/// Hands the buffer to the network without copying it; false if the link is over.
async fn write(stream: &mut SendStream, buffer: &mut BytesMut) -> bool {
    stream.write_chunk(buffer.split().freeze()).await.is_ok()
}

fn append_small<S: Header>(
    buffer: &mut BytesMut,
    header: &S,
    payload: &[Bytes],
) -> Result<(), codec::CodecError> {
    wire::append_header(buffer, header, payload)?;
    for chunk in payload {
        buffer.extend_from_slice(chunk);
    }
    Ok(())
}

/// Of a frame of so many bytes on the stream with this number.
fn bulk_priority(bytes: usize, stream: u64) -> i32 {
    const OLDEST: i32 = 1 << 30;
    if bytes <= SIDE_BY_SIDE_BYTES {
        return OLDEST + 1;
    }
    // Numbers wrap after 2^30 frames: then one younger frame goes first.
    i32::try_from(stream % u64::from(OLDEST.unsigned_abs())).map_or(1, |age| OLDEST - age)
}

async fn write_bulk<S: Header>(
    shared: Arc<Shared>,
    permit: OwnedSemaphorePermit,
    header: S,
    payload: Vec<Bytes>,
) {
    let mut buffer = BytesMut::new();
    buffer.put_u8(wire::BULK_STREAM);
    if let Err(error) = wire::append_header(&mut buffer, &header, &payload) {
        shared.fail(error.into());
        return;
    }
    let Ok(mut stream) = shared.connection.open_uni().await else { return };
    // As above: the first write says whether the stream is gone.
    let bytes = payload.iter().map(Bytes::len).sum();
    let _ = stream.set_priority(bulk_priority(bytes, stream.id().index()));
    let mut chunks = Vec::with_capacity(payload.len() + 1);
    chunks.push(buffer.freeze());
    chunks.extend(payload);
    if stream.write_all_chunks(&mut chunks).await.is_ok() && stream.finish().is_ok() {
        // The permit is held until the peer has the frame, so that the bound counts what is on the way.
        let _ = stream.stopped().await;
    }
    drop(permit);
}

#[cfg(test)]
mod tests {
    use farm_core::message::AppToNode;

    use super::*;
    use crate::codec::{MAX_PROGRAM_BYTES, pack_programs};

    /// Zeros, of which the system makes memory when they are read.
    #[test]
    fn a_program_of_any_size_goes_in_a_frame() {
        let largest = pack_programs([&Bytes::from(vec![0; MAX_PROGRAM_BYTES])]);
        assert!(payload_bytes::<AppToNode>(&largest).unwrap() > MAX_PROGRAM_BYTES);
        let larger = [largest, vec![Bytes::from_static(b".")]].concat();
        payload_bytes::<AppToNode>(&larger).unwrap_err();
    }

    #[test]
    fn small_frames_pass_large_ones_and_all_pass_contents() {
        const CONTENTS: i32 = 0;
        let (small, large) = (SIDE_BY_SIDE_BYTES, SIDE_BY_SIDE_BYTES + 1);
        assert!(ORDERED_PRIORITY > bulk_priority(small, 1));
        assert_eq!(bulk_priority(small, 1), bulk_priority(0, 1 << 40), "side by side");
        assert!(bulk_priority(small, 9) > bulk_priority(large, 0));
        assert!(bulk_priority(large, 7) > bulk_priority(large, 8), "the older one first");
        assert!(bulk_priority(large, (1 << 30) - 1) > CONTENTS);
    }
}
