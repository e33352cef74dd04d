//! The sending half of a link.

use std::{marker::PhantomData, net::SocketAddr};

use bytes::Bytes;
use farm_core::program::Content;
use thiserror::Error;

use super::{FetchError, Header, LinkError};

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
#[derive(Debug)]
pub struct LinkSender<S>(PhantomData<S>);

impl<S> Clone for LinkSender<S> {
    fn clone(&self) -> Self {
        Self(PhantomData)
    }
}

impl<S: Header> LinkSender<S> {
    /// Queues a frame; waits while the queue is full. The payload's chunks are sent one after the other.
    /// `Ok` means queued, not received.
    ///
    /// # Errors
    /// The link is over, or the payload is over its cap.
    pub async fn send(&self, header: S, payload: Vec<Bytes>) -> Result<(), LinkError> {
        let _ = (header, payload);
        unimplemented!()
    }

    /// Queues a frame without waiting.
    ///
    /// # Errors
    /// The queue is full (the frame comes back), the link is over, or the payload is over its cap.
    pub fn try_send(&self, header: S, payload: Vec<Bytes>) -> Result<(), TrySendError<S>> {
        let _ = (header, payload);
        unimplemented!()
    }
}

impl<S> LinkSender<S> {
    /// Fetches a content from the other side's [`super::ContentSource`]; the bytes are checked against size and digest.
    ///
    /// # Errors
    /// Not found, wrong bytes, stalled, or the link is over.
    pub async fn fetch(&self, content: Content) -> Result<Bytes, FetchError> {
        let _ = content;
        unimplemented!()
    }

    /// The peer's address.
    #[must_use]
    pub fn remote_address(&self) -> SocketAddr {
        unimplemented!()
    }

    /// Closes at once; what is queued or on the way is lost. The peer gets the reason.
    pub fn close(&self, reason: &str) {
        let _ = reason;
        unimplemented!()
    }

    /// Sends what is queued, waits (at most two seconds) until the peer has it, then closes.
    pub async fn close_after_sent(&self, reason: &str) {
        let _ = reason;
        unimplemented!()
    }

    /// Waits until the link is over, and says why. Cancel-safe.
    pub async fn closed(&self) -> LinkError {
        unimplemented!()
    }
}
