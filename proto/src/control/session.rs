//! The client's end of a control session, and the operator's requests.

use std::fmt;

use farm_core::{
    coordinator::{
        ContentsStatus, FarmStatus,
        timeline::{MAX_SEGMENTS, Segment, Timeline, TimelineQuery},
    },
    id::{ContentHash, NodeId},
    message::{AppToCoordinator, CoordinatorToApp, CoordinatorToNode, NodeToCoordinator},
};
use thiserror::Error;
use tokio::sync::mpsc;
use tokio_stream::{StreamExt, wrappers::ReceiverStream};
use tonic::{Code, Request, Status, Streaming, metadata::MetadataValue, transport::Channel};

use super::{
    ADMIN_TIMEOUT, MAX_MESSAGE_BYTES, WireError, transport,
    v1::{self, admin_client::AdminClient, apps_client::AppsClient, nodes_client::NodesClient},
};
use crate::{tls, trust::Identity};

/// Where an application that comes back shows its capability.
pub const CAPABILITY_METADATA: &str = "gleaner-capability-bin";

/// Messages that wait to be sent on a session, at most.
pub const QUEUED_MESSAGES: usize = 1_024;

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
    #[error("a message of the coordinator is malformed: {0}")]
    Malformed(#[from] WireError),
    /// The coordinator could not do it.
    #[error("the coordinator failed: {reason}")]
    Failed {
        /// Its words.
        reason: String,
    },
    /// The request was refused (an unknown node, say). Not to be retried.
    #[error("refused by the coordinator: {reason}")]
    Refused {
        /// Why.
        reason: String,
    },
    /// The request came later than the coordinator. Not to be retried.
    #[error("the coordinator does not know this request: it is of an earlier version, upgrade it")]
    UnknownRequest,
    /// The farm does not let this caller in, or is not the caller's. Not to be retried.
    #[error("denied: {reason}")]
    Denied {
        /// Why.
        reason: String,
    },
    /// The outgoing queue is full: the coordinator does not read. The caller drops the session.
    #[error("{QUEUED_MESSAGES} messages wait for a coordinator that does not read")]
    Full,
}

/// A session with the coordinator: `S` is what this side says, `R` what it hears.
#[derive(Debug)]
pub struct Session<S, R: Heard> {
    /// Cloneable; the session ends when the last one is dropped (what is queued is still sent).
    pub sender: SessionSender<S>,
    /// The one reader.
    pub receiver: SessionReceiver<R>,
}

/// Sends on a session.
pub struct SessionSender<S>(mpsc::Sender<S>);

impl<S> Clone for SessionSender<S> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<S> fmt::Debug for SessionSender<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SessionSender")
    }
}

impl<S> SessionSender<S> {
    /// Queues a message; waits while the queue is full.
    ///
    /// # Errors
    /// [`SessionError::Ended`].
    pub async fn send(&self, message: S) -> Result<(), SessionError> {
        self.0.send(message).await.map_err(|_| nobody_listens())
    }

    /// Queues a message without waiting.
    ///
    /// # Errors
    /// [`SessionError::Full`] or [`SessionError::Ended`].
    pub fn try_send(&self, message: S) -> Result<(), SessionError> {
        self.0.try_send(message).map_err(|error| match error {
            mpsc::error::TrySendError::Full(_) => SessionError::Full,
            mpsc::error::TrySendError::Closed(_) => nobody_listens(),
        })
    }
}

fn nobody_listens() -> SessionError {
    SessionError::Ended { reason: "the connection is closed".to_owned() }
}

/// What a session's client hears; each has its shape on the wire.
pub trait Heard: TryFrom<Self::Wire, Error = WireError> + Send + 'static {
    /// The generated message.
    type Wire: fmt::Debug + Send + 'static;
}

impl Heard for CoordinatorToApp {
    type Wire = v1::CoordinatorToApp;
}

impl Heard for CoordinatorToNode {
    type Wire = v1::CoordinatorToNode;
}

/// Receives on a session.
#[derive(Debug)]
pub struct SessionReceiver<R: Heard>(Streaming<R::Wire>);

impl<R: Heard> SessionReceiver<R> {
    /// The next message. Cancel-safe.
    ///
    /// # Errors
    /// The session ended, or a message is malformed.
    pub async fn recv(&mut self) -> Result<R, SessionError> {
        match self.0.message().await {
            Ok(Some(message)) => Ok(R::try_from(message)?),
            Ok(None) => Err(SessionError::Ended { reason: "closed by the coordinator".to_owned() }),
            Err(status) if is_denial(&status) => {
                Err(SessionError::Denied { reason: status.message().to_owned() })
            }
            Err(status) => Err(SessionError::Ended { reason: words(&status) }),
        }
    }
}

fn is_denial(status: &Status) -> bool {
    matches!(status.code(), Code::Unauthenticated | Code::PermissionDenied)
}

/// Opens an application's session with the coordinator at `HOST:PORT`, as a member of a secured farm if an identity is given. There,
/// an application that comes back shows the capability that it was given before; empty: none. The hello is the caller's first message.
///
/// # Errors
/// Nobody answers within [`ADMIN_TIMEOUT`].
pub async fn connect_app(
    coordinator: &str,
    identity: Option<&Identity>,
    capability: &[u8],
) -> Result<Session<AppToCoordinator, CoordinatorToApp>, SessionError> {
    let mut client = AppsClient::new(channel(coordinator, identity).await?)
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES);
    let (sender, queue) = mpsc::channel(QUEUED_MESSAGES);
    let outgoing = ReceiverStream::new(queue).map(v1::AppToCoordinator::from);
    let mut request = Request::new(outgoing);
    if !capability.is_empty() {
        request.metadata_mut().insert_bin(CAPABILITY_METADATA, MetadataValue::from_bytes(capability));
    }
    let answer = within_timeout(coordinator, client.session(request)).await?;
    Ok(Session { sender: SessionSender(sender), receiver: SessionReceiver(answer.into_inner()) })
}

/// Opens a node's session with the coordinator at `HOST:PORT`. The hello is the caller's first message.
///
/// # Errors
/// Nobody answers within [`ADMIN_TIMEOUT`].
pub async fn connect_node(
    coordinator: &str,
    identity: Option<&Identity>,
) -> Result<Session<NodeToCoordinator, CoordinatorToNode>, SessionError> {
    let mut client = NodesClient::new(channel(coordinator, identity).await?)
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES);
    let (sender, queue) = mpsc::channel(QUEUED_MESSAGES);
    let outgoing = ReceiverStream::new(queue).map(v1::NodeToCoordinator::from);
    let answer = within_timeout(coordinator, client.session(outgoing)).await?;
    Ok(Session { sender: SessionSender(sender), receiver: SessionReceiver(answer.into_inner()) })
}

/// Asks the coordinator at `HOST:PORT` how the farm stands.
///
/// # Errors
/// Nobody answers within [`ADMIN_TIMEOUT`].
pub async fn status(coordinator: &str, identity: Option<&Identity>) -> Result<FarmStatus, SessionError> {
    let mut client = admin(coordinator, identity).await?;
    let answer = within_timeout(coordinator, client.status(Request::new(v1::StatusRequest {}))).await?;
    Ok(answer.into_inner().try_into()?)
}

/// Asks a node to finish what it has and leave.
///
/// # Errors
/// Nobody answers, or the node is unknown.
pub async fn drain(coordinator: &str, identity: Option<&Identity>, node: NodeId) -> Result<(), SessionError> {
    let mut client = admin(coordinator, identity).await?;
    within_timeout(coordinator, client.drain(Request::new(v1::DrainRequest { node: node.0 }))).await?;
    Ok(())
}

/// Asks what large contents the caches of nodes hold.
///
/// # Errors
/// Nobody answers.
pub async fn contents(
    coordinator: &str,
    identity: Option<&Identity>,
) -> Result<ContentsStatus, SessionError> {
    let mut client = admin(coordinator, identity).await?;
    let answer = within_timeout(coordinator, client.contents(Request::new(v1::ContentsRequest {}))).await?;
    Ok(answer.into_inner().try_into()?)
}

/// Has nodes drop contents that no job needs: one node or all, these contents or all.
///
/// # Errors
/// Nobody answers, or the node is unknown.
pub async fn evict(
    coordinator: &str,
    identity: Option<&Identity>,
    node: Option<NodeId>,
    contents: &[ContentHash],
) -> Result<(), SessionError> {
    let mut client = admin(coordinator, identity).await?;
    let contents = contents.iter().map(|hash| hash.0.into()).collect();
    let request = v1::EvictRequest { node: node.map(|node| node.0), contents };
    within_timeout(coordinator, client.evict(Request::new(request))).await?;
    Ok(())
}

/// Asks what ran when and where.
///
/// # Errors
/// Nobody answers, the answer breaks off, or it is more than the record can hold.
pub async fn timeline(
    coordinator: &str,
    identity: Option<&Identity>,
    query: TimelineQuery,
) -> Result<Timeline, SessionError> {
    let mut client = admin(coordinator, identity).await?;
    let request = Request::new(v1::TimelineRequest::from(query));
    let mut parts = within_timeout(coordinator, client.timeline(request)).await?.into_inner();
    let mut timeline = Timeline::default();
    let mut headed = false;
    while let Some(part) = within_timeout(coordinator, parts.message()).await? {
        use v1::timeline_part::Part;
        match part.part.ok_or(WireError::Missing { field: "TimelinePart.part" })? {
            Part::Head(head) => (timeline.head, headed) = (head.try_into()?, true),
            Part::Segments(segments) => {
                let mut segments: Vec<Segment> = segments.try_into()?;
                timeline.segments.append(&mut segments);
            }
        }
        let count = timeline.segments.len();
        if count > MAX_SEGMENTS {
            let too_many = WireError::TooMany { field: "TimelinePart.segments", count, cap: MAX_SEGMENTS };
            return Err(too_many.into());
        }
    }
    if headed { Ok(timeline) } else { Err(WireError::Missing { field: "TimelinePart.head" }.into()) }
}

async fn admin(coordinator: &str, identity: Option<&Identity>) -> Result<AdminClient<Channel>, SessionError> {
    Ok(AdminClient::new(channel(coordinator, identity).await?)
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES))
}

/// A connection as a member, or in plain text.
pub(super) async fn channel(coordinator: &str, identity: Option<&Identity>) -> Result<Channel, SessionError> {
    let denied = |reason: String| SessionError::Denied { reason };
    let config = match identity {
        Some(identity) if identity.is_over() => {
            return Err(denied(format!("the certificate of {} is over: join again", identity.principal())));
        }
        Some(identity) => {
            Some(tls::control_client_config(identity).map_err(|error| denied(error.to_string()))?)
        }
        None => None,
    };
    transport::connect(coordinator, config).await
}

pub(super) async fn within_timeout<T>(
    coordinator: &str,
    request: impl Future<Output = Result<T, Status>>,
) -> Result<T, SessionError> {
    let unreachable = |reason| SessionError::Unreachable { address: coordinator.to_owned(), reason };
    match tokio::time::timeout(ADMIN_TIMEOUT, request).await {
        Err(_) => Err(unreachable(format!("no answer within {ADMIN_TIMEOUT:?}"))),
        Ok(Ok(answer)) => Ok(answer),
        Ok(Err(status))
            if matches!(status.code(), Code::NotFound | Code::InvalidArgument | Code::FailedPrecondition) =>
        {
            Err(SessionError::Refused { reason: status.message().to_owned() })
        }
        Ok(Err(status)) if status.code() == Code::Unimplemented => Err(SessionError::UnknownRequest),
        Ok(Err(status)) if status.code() == Code::Internal => {
            Err(SessionError::Failed { reason: status.message().to_owned() })
        }
        Ok(Err(status)) if is_denial(&status) => {
            Err(SessionError::Denied { reason: status.message().to_owned() })
        }
        Ok(Err(status)) => Err(unreachable(words(&status))),
    }
}

fn words(status: &Status) -> String {
    match status.message() {
        "" => transport::root_cause(status),
        message => message.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Scenario 33: operators are not told that nobody answers there.
    #[tokio::test]
    async fn a_request_that_came_later_than_the_coordinator_is_not_taken_for_silence() {
        let unknown = async { Err::<(), _>(Status::unimplemented("")) };
        let error = within_timeout("127.0.0.1:1", unknown).await;
        assert!(matches!(error, Err(SessionError::UnknownRequest)), "{error:?}");
    }
}
