//! The client's end of a control session.

use std::{marker::PhantomData, time::Duration};

use farm_core::{
    coordinator::FarmStatus,
    id::NodeId,
    message::{AppToCoordinator, CoordinatorToApp, CoordinatorToNode, NodeToCoordinator},
};
use thiserror::Error;

/// How long connecting and each admin request may take.
pub const ADMIN_TIMEOUT: Duration = Duration::from_secs(5);

/// A session could not be had or ended.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum SessionError {
    /// The address is not `HOST:PORT`. Not to be retried.
    #[error("{address:?} is not an address of the form HOST:PORT: {reason}")]
    Address {
        /// What was given.
        address: String,
        /// What is wrong.
        reason: String,
    },
    /// Nobody answers there. May be retried.
    #[error("the coordinator at {address} cannot be reached: {reason}")]
    Unreachable {
        /// Where.
        address: String,
        /// Why.
        reason: String,
    },
    /// The session ended. May be retried.
    #[error("the session with the coordinator ended: {reason}")]
    Ended {
        /// Why.
        reason: String,
    },
    /// The coordinator said something that this build does not understand. Not to be retried.
    #[error("a message of the coordinator is malformed: {reason}")]
    Malformed {
        /// Which field.
        reason: String,
    },
    /// The request was refused (an unknown node, say).
    #[error("refused by the coordinator: {reason}")]
    Refused {
        /// Why.
        reason: String,
    },
    /// The outgoing queue is full: the coordinator does not read. The caller drops the session.
    #[error("the session's queue is full")]
    Full,
}

/// A session with the coordinator: `S` is what this side says, `R` what it hears.
#[derive(Debug)]
pub struct Session<S, R> {
    /// Cloneable; the session ends when the last one is dropped (what is queued is still sent).
    pub sender: SessionSender<S>,
    /// The one reader.
    pub receiver: SessionReceiver<R>,
}

/// Sends on a session.
#[derive(Debug)]
pub struct SessionSender<S>(PhantomData<S>);

impl<S> Clone for SessionSender<S> {
    fn clone(&self) -> Self {
        Self(PhantomData)
    }
}

impl<S> SessionSender<S> {
    /// Queues a message without waiting.
    ///
    /// # Errors
    /// [`SessionError::Full`] or [`SessionError::Ended`].
    pub fn try_send(&self, message: S) -> Result<(), SessionError> {
        let _ = message;
        unimplemented!()
    }
}

/// Receives on a session.
#[derive(Debug)]
pub struct SessionReceiver<R>(PhantomData<R>);

impl<R> SessionReceiver<R> {
    /// The next message. Cancel-safe.
    ///
    /// # Errors
    /// The session ended, or a message is malformed.
    pub async fn recv(&mut self) -> Result<R, SessionError> {
        unimplemented!()
    }
}

/// Opens an application's session with the coordinator at `HOST:PORT`.
///
/// # Errors
/// Nobody answers within [`ADMIN_TIMEOUT`].
pub async fn connect_app(
    coordinator: &str,
) -> Result<Session<AppToCoordinator, CoordinatorToApp>, SessionError> {
    let _ = coordinator;
    unimplemented!()
}

/// Opens a node's session with the coordinator at `HOST:PORT`.
///
/// # Errors
/// Nobody answers within [`ADMIN_TIMEOUT`].
pub async fn connect_node(
    coordinator: &str,
) -> Result<Session<NodeToCoordinator, CoordinatorToNode>, SessionError> {
    let _ = coordinator;
    unimplemented!()
}

/// Asks the coordinator at `HOST:PORT` how the farm stands.
///
/// # Errors
/// Nobody answers within [`ADMIN_TIMEOUT`].
pub async fn status(coordinator: &str) -> Result<FarmStatus, SessionError> {
    let _ = coordinator;
    unimplemented!()
}

/// Asks a node to finish what it has and leave.
///
/// # Errors
/// Nobody answers, or the node is unknown.
pub async fn drain(coordinator: &str, node: NodeId) -> Result<(), SessionError> {
    let _ = (coordinator, node);
    unimplemented!()
}
