//! The receiving half of a link: an acceptor, one reader of the ordered stream, one short reader for each large frame.

use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use bytes::{Buf, Bytes, BytesMut};
use quinn::{ReadError, RecvStream};
use tokio::sync::{mpsc, watch};

use super::{
    Frame, Header, LinkError, QUEUED_FRAMES, SMALL_PAYLOAD_BYTES,
    shared::{Guard, Shared},
    wire::{self, Lengths, PREFIX_BYTES, protocol, split_frame},
};

/// Chunks taken from the network at once.
const READ_CHUNKS: usize = 32;
/// The ordered stream's buffer grows in steps of this size, in bytes.
const READ_BYTES: usize = 64 << 10;
/// A large frame's buffer starts at most this large and doubles as bytes really come, in bytes.
const FIRST_BULK_BYTES: usize = 4 << 20;
/// Large frames that are complete and wait to be read. The others wait on their streams.
const QUEUED_BULK_FRAMES: usize = 1;

/// Receives frames.
pub struct LinkReceiver<R> {
    guard: Arc<Guard>,
    small: mpsc::Receiver<Frame<R>>,
    bulk: mpsc::Receiver<Frame<R>>,
    /// The first small frame was received: until then large ones wait.
    greeted: bool,
}

impl<R> fmt::Debug for LinkReceiver<R> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("LinkReceiver").field(&self.guard.connection().remote_address()).finish()
    }
}

impl<R: Header> LinkReceiver<R> {
    pub(super) fn new(guard: Arc<Guard>) -> Self {
        let (small_sender, small) = mpsc::channel(QUEUED_FRAMES);
        let (bulk_sender, bulk) = mpsc::channel(QUEUED_BULK_FRAMES);
        let inbox = Inbox {
            shared: guard.shared(),
            small: small_sender,
            bulk: bulk_sender,
            ordered_seen: AtomicBool::new(false),
            opened: watch::Sender::new(false),
        };
        tokio::spawn(accept_streams(Arc::new(inbox)));
        Self { guard, small, bulk, greeted: false }
    }

    /// The next frame. Cancel-safe.
    ///
    /// # Errors
    /// The link is over; frames that came before are given first.
    pub async fn recv(&mut self) -> Result<Frame<R>, LinkError> {
        if let Some(hello) = self.hello().await {
            return Ok(hello);
        }
        tokio::select! {
            Some(frame) = self.small.recv() => Ok(frame),
            Some(frame) = self.bulk.recv() => Ok(frame),
            else => Err(self.guard.error()),
        }
    }

    /// Waits for at least one frame and appends up to `limit` (at least 1) that are there to `frames`: a burst in one
    /// wake-up. Cancel-safe.
    ///
    /// # Errors
    /// The link is over; frames that came before are given first.
    pub async fn recv_many(&mut self, frames: &mut Vec<Frame<R>>, limit: usize) -> Result<(), LinkError> {
        let limit = limit.max(1);
        let end = frames.len() + limit;
        if let Some(hello) = self.hello().await {
            frames.push(hello);
            return Ok(());
        }
        tokio::select! {
            1.. = self.small.recv_many(frames, limit) => {
                if frames.len() < end && let Ok(frame) = self.bulk.try_recv() {
                    frames.push(frame);
                }
                Ok(())
            }
            Some(frame) = self.bulk.recv() => {
                frames.push(frame);
                while frames.len() < end && let Ok(frame) = self.small.try_recv() {
                    frames.push(frame);
                }
                Ok(())
            }
            else => Err(self.guard.error()),
        }
    }

    /// A frame that is already there; `Ok(None)` if there is none yet.
    ///
    /// # Errors
    /// The link is over.
    pub fn try_recv(&mut self) -> Result<Option<Frame<R>>, LinkError> {
        use mpsc::error::TryRecvError::{Disconnected, Empty};
        match self.small.try_recv() {
            Ok(frame) => {
                self.greeted = true;
                Ok(Some(frame))
            }
            Err(Empty) if !self.greeted => Ok(None),
            Err(small) => match (small, self.bulk.try_recv()) {
                (_, Ok(frame)) => Ok(Some(frame)),
                (Disconnected, Err(Disconnected)) => Err(self.guard.error()),
                (Empty | Disconnected, Err(Empty | Disconnected)) => Ok(None),
            },
        }
    }

    /// The first small frame, once; a large one may be there as soon as it is. `None` if it has been received, or never comes.
    /// Cancel-safe.
    async fn hello(&mut self) -> Option<Frame<R>> {
        if self.greeted {
            return None;
        }
        let hello = self.small.recv().await;
        self.greeted = true;
        hello
    }
}

/// Where the readers of one link put what they read.
struct Inbox<R> {
    shared: Arc<Shared>,
    small: mpsc::Sender<Frame<R>>,
    bulk: mpsc::Sender<Frame<R>>,
    /// A link has one ordered stream; a second one breaks the protocol.
    ordered_seen: AtomicBool,
    /// Whether the first small frame (the hello) is in the queue: large ones wait for it.
    opened: watch::Sender<bool>,
}

/// Why a reader stops.
enum Stop {
    /// The peer is at fault.
    Fault(LinkError),
    /// The link is over, or nobody reads frames any more.
    Over,
}

impl From<LinkError> for Stop {
    fn from(error: LinkError) -> Self {
        Self::Fault(error)
    }
}

async fn accept_streams<R: Header>(inbox: Arc<Inbox<R>>) {
    // QUIC's stream limit bounds the readers.
    while let Ok(stream) = inbox.shared.connection.accept_uni().await {
        let inbox = Arc::clone(&inbox);
        tokio::spawn(async move {
            if let Err(Stop::Fault(error)) = read_stream(&inbox, stream).await {
                inbox.shared.fail(error);
            }
        });
    }
}

async fn read_stream<R: Header>(inbox: &Inbox<R>, stream: RecvStream) -> Result<(), Stop> {
    let mut input = Input { stream, chunks: vec![Bytes::new(); READ_CHUNKS], filled: 0, next: 0 };
    match input.first_byte().await? {
        wire::ORDERED_STREAM if inbox.ordered_seen.swap(true, Ordering::Relaxed) => {
            Err(protocol("a second ordered stream".to_owned()).into())
        }
        wire::ORDERED_STREAM => read_ordered(inbox, input).await,
        wire::BULK_STREAM => read_bulk(inbox, input).await,
        unknown => Err(protocol(format!("stream of unknown kind {unknown}")).into()),
    }
}

async fn read_ordered<R: Header>(inbox: &Inbox<R>, mut input: Input) -> Result<(), Stop> {
    let mut buffer = BytesMut::with_capacity(READ_BYTES);
    loop {
        while let Some(lengths) = Lengths::parse(&buffer, SMALL_PAYLOAD_BYTES as u64)? {
            if buffer.len() < lengths.frame_bytes() {
                break;
            }
            let frame = split_frame(&mut buffer, lengths)?;
            inbox.small.send(frame).await.map_err(|_| Stop::Over)?;
            inbox.opened.send_if_modified(|opened| !std::mem::replace(opened, true));
        }
        if !input.read_into(&mut buffer).await? {
            return match buffer.len() {
                0 => Ok(()),
                left => Err(protocol(format!("the ordered stream ends {left} B into a frame")).into()),
            };
        }
    }
}

async fn read_bulk<R: Header>(inbox: &Inbox<R>, mut input: Input) -> Result<(), Stop> {
    const CUT: &str = "a bulk stream ends inside its frame";
    let mut opened = inbox.opened.subscribe();
    tokio::select! {
        // The sender lives in the inbox: this cannot fail.
        _ = opened.wait_for(|opened| *opened) => {}
        _ = inbox.shared.connection.closed() => {}
    }
    let mut buffer = BytesMut::with_capacity(PREFIX_BYTES);
    let lengths = loop {
        if let Some(lengths) = Lengths::parse(&buffer, R::MAX_PAYLOAD_BYTES)? {
            break lengths;
        }
        if !input.read_into(&mut buffer).await? {
            return Err(protocol(CUT.to_owned()).into());
        }
    };
    // One buffer holds the frame; it is allocated as bytes come, not on the word of the peer.
    buffer.reserve(lengths.frame_bytes().min(FIRST_BULK_BYTES).saturating_sub(buffer.len()));
    while buffer.len() < lengths.frame_bytes() {
        if !input.read_into(&mut buffer).await? {
            return Err(protocol(CUT.to_owned()).into());
        }
    }
    let frame = split_frame(&mut buffer, lengths)?;
    if !buffer.is_empty() || input.read_into(&mut buffer).await? {
        return Err(protocol("bytes follow the frame of a bulk stream".to_owned()).into());
    }
    inbox.bulk.send(frame).await.map_err(|_| Stop::Over)
}

/// A stream and the chunks read from it but not yet consumed.
struct Input {
    stream: RecvStream,
    chunks: Vec<Bytes>,
    filled: usize,
    next: usize,
}

impl Input {
    async fn first_byte(&mut self) -> Result<u8, Stop> {
        if !self.fill().await? {
            return Err(protocol("an empty stream".to_owned()).into());
        }
        // The network gives no empty chunks; if it did, the kind would be refused as unknown.
        let chunk = &mut self.chunks[self.next];
        Ok(if chunk.is_empty() { u8::MAX } else { chunk.get_u8() })
    }

    /// Appends what is there to `buffer`; false at the end of the stream.
    async fn read_into(&mut self, buffer: &mut BytesMut) -> Result<bool, Stop> {
        if self.next == self.filled && !self.fill().await? {
            return Ok(false);
        }
        for chunk in &mut self.chunks[self.next..self.filled] {
            buffer.extend_from_slice(chunk);
            *chunk = Bytes::new();
        }
        self.next = self.filled;
        Ok(true)
    }

    async fn fill(&mut self) -> Result<bool, Stop> {
        match self.stream.read_chunks(&mut self.chunks).await {
            Ok(None) => Ok(false),
            Ok(Some(filled)) => {
                (self.next, self.filled) = (0, filled);
                Ok(true)
            }
            Err(ReadError::Reset(code)) => Err(protocol(format!("a stream was reset (code {code})")).into()),
            Err(
                ReadError::ConnectionLost(_)
                | ReadError::ClosedStream
                | ReadError::IllegalOrderedRead
                | ReadError::ZeroRttRejected,
            ) => Err(Stop::Over),
        }
    }
}
