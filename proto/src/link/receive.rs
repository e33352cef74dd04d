//! The receiving half of a link.

use std::marker::PhantomData;

use super::{Frame, Header, LinkError};

/// Receives frames.
#[derive(Debug)]
pub struct LinkReceiver<R>(PhantomData<R>);

impl<R: Header> LinkReceiver<R> {
    /// The next frame. Cancel-safe.
    ///
    /// # Errors
    /// The link is over; frames that came before are given first.
    pub async fn recv(&mut self) -> Result<Frame<R>, LinkError> {
        unimplemented!()
    }

    /// Waits for at least one frame and appends up to `limit` that are there to `frames`: a burst in one wake-up.
    /// Cancel-safe.
    ///
    /// # Errors
    /// The link is over; frames that came before are given first.
    pub async fn recv_many(&mut self, frames: &mut Vec<Frame<R>>, limit: usize) -> Result<(), LinkError> {
        let _ = (frames, limit);
        unimplemented!()
    }

    /// A frame that is already there; `Ok(None)` if there is none yet.
    ///
    /// # Errors
    /// The link is over.
    pub fn try_recv(&mut self) -> Result<Option<Frame<R>>, LinkError> {
        unimplemented!()
    }
}
