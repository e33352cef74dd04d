//! What the tasks and handles of one link share: the connection, and why it ended.

use std::{
    ops::Deref,
    sync::{Arc, OnceLock},
};

use quinn::{Connection, ConnectionError, VarInt};

use super::LinkError;

/// Close code: this side is done.
const CODE_DONE: VarInt = VarInt::from_u32(0);
/// Close code: the peer broke the protocol, or a frame could not be coded.
const CODE_FAULT: VarInt = VarInt::from_u32(1);

#[derive(Debug)]
pub(super) struct Shared {
    pub(super) connection: Connection,
    /// Why this side closed it; the first reason counts.
    ended: OnceLock<LinkError>,
}

impl Shared {
    pub(super) fn new(connection: Connection) -> Self {
        Self { connection, ended: OnceLock::new() }
    }

    /// Closes for a fault.
    pub(super) fn fail(&self, error: LinkError) {
        let reason = error.to_string();
        if self.ended.set(error).is_ok() {
            self.connection.close(CODE_FAULT, reason.as_bytes());
        }
    }

    /// Closes because this side is done.
    pub(super) fn close(&self, reason: &str) {
        if self.ended.set(LinkError::ClosedHere { reason: reason.to_owned() }).is_ok() {
            self.connection.close(CODE_DONE, reason.as_bytes());
        }
    }

    /// Why the link is over, if it is.
    pub(super) fn over(&self) -> Option<LinkError> {
        let seen = self.connection.close_reason()?;
        Some(match (seen, self.ended.get()) {
            (ConnectionError::LocallyClosed, Some(ended)) => ended.clone(),
            (seen, _) => LinkError::from(seen),
        })
    }

    /// Why the link is over.
    pub(super) fn error(&self) -> LinkError {
        self.over()
            .or_else(|| self.ended.get().cloned())
            .unwrap_or_else(|| LinkError::Lost { reason: "the peer stopped listening".to_owned() })
    }
}

impl From<ConnectionError> for LinkError {
    fn from(error: ConnectionError) -> Self {
        match error {
            ConnectionError::ApplicationClosed(close) => {
                Self::ClosedByPeer { reason: String::from_utf8_lossy(&close.reason).into_owned() }
            }
            ConnectionError::LocallyClosed => Self::ClosedHere { reason: "shut down".to_owned() },
            ConnectionError::TimedOut => Self::Lost { reason: "the peer fell silent".to_owned() },
            other @ (ConnectionError::VersionMismatch
            | ConnectionError::TransportError(_)
            | ConnectionError::ConnectionClosed(_)
            | ConnectionError::Reset
            | ConnectionError::CidsExhausted) => Self::Lost { reason: other.to_string() },
        }
    }
}

/// Held by the handles of a link, not by its tasks: the last one dropped closes the connection.
#[derive(Debug)]
pub(super) struct Guard(Arc<Shared>);

impl Guard {
    pub(super) fn new(shared: Arc<Shared>) -> Self {
        Self(shared)
    }

    pub(super) fn shared(&self) -> Arc<Shared> {
        Arc::clone(&self.0)
    }

    pub(super) fn connection(&self) -> &Connection {
        &self.0.connection
    }
}

impl Deref for Guard {
    type Target = Shared;

    fn deref(&self) -> &Shared {
        &self.0
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        self.0.close("dropped");
    }
}
