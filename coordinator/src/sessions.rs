//! The gRPC services: each session is a reader that feeds the owner, and a stream that the owner fills.

use std::{
    fmt, iter,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use farm_core::{
    coordinator::timeline::Timeline,
    id::{LinkId, NodeId},
    message::{AppToCoordinator, CoordinatorToApp, CoordinatorToNode, NodeToCoordinator},
};
use proto::control::{
    CAPABILITY_METADATA, WireError, eviction,
    v1::{self, admin_server::Admin, apps_server::Apps, nodes_server::Nodes},
};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};
use tokio_stream::{Stream, StreamExt as _, wrappers::ReceiverStream};
use tonic::{Request, Response, Status, Streaming};

use crate::{
    owner::{Command, OwnerHandle, Peer, QUEUED_MESSAGES},
    security::{Action, Gate},
};

/// Sessions of applications and nodes together, at most; further ones are refused.
const MAX_SESSIONS: usize = 4_096;
/// A session whose first message does not come within this time is closed.
const FIRST_MESSAGE_TIMEOUT: Duration = Duration::from_secs(10);

/// Segments in one part of a timeline, about half a megabyte: far below the message cap.
const PART_SEGMENTS: usize = 8_192;

/// The services of applications, nodes and operators; cloneable.
#[derive(Clone, Debug)]
pub(crate) struct Sessions {
    owner: OwnerHandle,
    gate: Gate,
    next_link: Arc<AtomicU64>,
    slots: Arc<Semaphore>,
}

impl Sessions {
    pub(crate) fn new(owner: OwnerHandle, gate: Gate) -> Self {
        let slots = Arc::new(Semaphore::new(MAX_SESSIONS));
        Self { owner, gate, next_link: Arc::new(AtomicU64::new(1)), slots }
    }

    /// Opens a session: `opened`, `said` wrap what the owner is told.
    async fn open<In, Out, Wire>(
        &self,
        request: Request<Streaming<Wire>>,
        action: Action,
        opened: fn(LinkId, Peer<Out>) -> Command,
        said: fn(LinkId, In) -> Command,
    ) -> Result<ReceiverStream<Result<Out, Status>>, Status>
    where
        In: TryFrom<Wire, Error = WireError> + Send + 'static,
        Out: Send + 'static,
        Wire: Send + 'static,
    {
        let member = self.gate.admit(request.extensions(), action)?;
        let project = self.gate.project_of(member.as_ref())?;
        let shown = request.metadata().get_bin(CAPABILITY_METADATA).and_then(|value| value.to_bytes().ok());
        let shown = self.gate.capability_of(member.as_ref(), shown.as_deref())?;
        let messages = request.into_inner();
        let Ok(slot) = Arc::clone(&self.slots).try_acquire_owned() else {
            return Err(Status::resource_exhausted(format!("{MAX_SESSIONS} sessions are open already")));
        };
        let link = LinkId(self.next_link.fetch_add(1, Ordering::Relaxed));
        let (outbound, outgoing) = mpsc::channel(QUEUED_MESSAGES);
        let (alive, ended) = oneshot::channel();
        if !self.owner.send(opened(link, Peer::new(outbound.clone(), alive, member, shown, project))).await {
            return Err(Status::unavailable("the coordinator stops"));
        }
        let reader = Reader { link, owner: self.owner.clone(), outbound, ended, _slot: slot };
        tokio::spawn(reader.run(messages, said));
        Ok(ReceiverStream::new(outgoing))
    }
}

/// Reads one session until either side ends it.
struct Reader<Out> {
    link: LinkId,
    owner: OwnerHandle,
    outbound: mpsc::Sender<Result<Out, Status>>,
    /// Resolves when the owner drops its end.
    ended: oneshot::Receiver<()>,
    _slot: OwnedSemaphorePermit,
}

impl<Out: Send + 'static> Reader<Out> {
    async fn run<In, Wire>(mut self, mut messages: Streaming<Wire>, said: fn(LinkId, In) -> Command)
    where
        In: TryFrom<Wire, Error = WireError>,
    {
        let mut timeout = Some(FIRST_MESSAGE_TIMEOUT);
        loop {
            let next = tokio::select! {
                next = messages.message() => next,
                _ = &mut self.ended => return,
                () = tokio::time::sleep(timeout.unwrap_or_default()), if timeout.is_some() => {
                    self.refuse(Status::deadline_exceeded("no hello came"));
                    break;
                }
            };
            timeout = None;
            match next {
                Ok(Some(message)) => match In::try_from(message) {
                    Ok(message) => {
                        if !self.owner.send(said(self.link, message)).await {
                            return;
                        }
                    }
                    Err(error) => {
                        self.refuse(Status::invalid_argument(error.to_string()));
                        break;
                    }
                },
                Ok(None) => break,
                Err(status) => {
                    tracing::debug!(link = %self.link, reason = status.message(), "session broke off");
                    break;
                }
            }
        }
        self.owner.send(Command::Closed(self.link)).await;
    }

    fn refuse(&self, status: Status) {
        tracing::warn!(link = %self.link, reason = status.message(), "session refused");
        // A peer that does not read its answers does not learn why.
        let _ = self.outbound.try_send(Err(status));
    }
}

/// What a session's client hears, in its shape on the wire.
type Answers<W> = std::pin::Pin<Box<dyn Stream<Item = Result<W, Status>> + Send>>;

#[tonic::async_trait]
impl Apps for Sessions {
    type SessionStream = Answers<v1::CoordinatorToApp>;

    async fn session(
        &self,
        request: Request<Streaming<v1::AppToCoordinator>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (opened, said) = (Command::AppOpened, Command::FromApp);
        let answers = self
            .open::<AppToCoordinator, CoordinatorToApp, _>(request, Action::Compute, opened, said)
            .await?;
        Ok(Response::new(Box::pin(answers.map(|answer| answer.map(Into::into)))))
    }
}

#[tonic::async_trait]
impl Nodes for Sessions {
    type SessionStream = Answers<v1::CoordinatorToNode>;

    async fn session(
        &self,
        request: Request<Streaming<v1::NodeToCoordinator>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (opened, said) = (Command::NodeOpened, Command::FromNode);
        let answers = self
            .open::<NodeToCoordinator, CoordinatorToNode, _>(request, Action::Serve, opened, said)
            .await?;
        Ok(Response::new(Box::pin(answers.map(|answer| answer.map(Into::into)))))
    }
}

#[tonic::async_trait]
impl Admin for Sessions {
    type TimelineStream = Answers<v1::TimelinePart>;

    async fn status(&self, request: Request<v1::StatusRequest>) -> Result<Response<v1::FarmStatus>, Status> {
        self.gate.admit(request.extensions(), Action::Look)?;
        let status = self.owner.status().await.ok_or_else(stopping)?;
        Ok(Response::new(status.into()))
    }

    async fn drain(&self, request: Request<v1::DrainRequest>) -> Result<Response<v1::DrainResponse>, Status> {
        let operator = self.gate.admit(request.extensions(), Action::Operate)?;
        let node = NodeId(request.into_inner().node);
        match self.owner.drain(node).await.ok_or_else(stopping)? {
            true => {
                self.gate.done("drain", operator.as_ref(), serde_json::json!({ "node": node.0 }));
                Ok(Response::new(v1::DrainResponse {}))
            }
            false => Err(Status::not_found(format!("{node} is not registered"))),
        }
    }

    async fn contents(
        &self,
        request: Request<v1::ContentsRequest>,
    ) -> Result<Response<v1::ContentsStatus>, Status> {
        self.gate.admit(request.extensions(), Action::Look)?;
        let contents = self.owner.contents().await.ok_or_else(stopping)?;
        Ok(Response::new(contents.into()))
    }

    async fn evict(&self, request: Request<v1::EvictRequest>) -> Result<Response<v1::EvictResponse>, Status> {
        let operator = self.gate.admit(request.extensions(), Action::Operate)?;
        let (node, contents) =
            eviction(request.into_inner()).map_err(|error| Status::invalid_argument(error.to_string()))?;
        let what = serde_json::json!({ "node": node.map(|node| node.0), "contents": contents.len() });
        match (self.owner.evict(node, contents).await.ok_or_else(stopping)?, node) {
            (false, Some(node)) => Err(Status::not_found(format!("{node} is not registered"))),
            (true, _) | (false, None) => {
                self.gate.done("evict", operator.as_ref(), what);
                Ok(Response::new(v1::EvictResponse {}))
            }
        }
    }

    async fn timeline(
        &self,
        request: Request<v1::TimelineRequest>,
    ) -> Result<Response<Self::TimelineStream>, Status> {
        self.gate.admit(request.extensions(), Action::Look)?;
        let timeline = self.owner.timeline(request.into_inner().into()).await.ok_or_else(stopping)?;
        Ok(Response::new(Box::pin(tokio_stream::iter(timeline_parts(timeline)).map(Ok))))
    }
}

/// The head, then the segments; each part is made when the connection has room for it.
fn timeline_parts(timeline: Timeline) -> impl Iterator<Item = v1::TimelinePart> + Send {
    use v1::timeline_part::Part;
    let Timeline { head, segments } = timeline;
    let parts = segments.len().div_ceil(PART_SEGMENTS);
    let segments = (0..parts).map(move |part| {
        let from = part * PART_SEGMENTS;
        let to = segments.len().min(from + PART_SEGMENTS);
        Part::Segments(segments[from..to].into())
    });
    iter::once(Part::Head(head.into())).chain(segments).map(|part| v1::TimelinePart { part: Some(part) })
}

fn stopping() -> Status {
    Status::unavailable("the coordinator stops")
}

impl<Out> fmt::Debug for Reader<Out> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Reader").field(&self.link).finish()
    }
}
