//! The links to nodes: dialling them, sending frames, checking what comes in (the result server), and answering their
//! fetches (the data server, through `proto`'s content source). It never decides which result counts.

use std::{
    collections::{BTreeMap, HashMap},
    sync::Arc,
};

use bytes::Bytes;
use farm_core::{
    id::{ContentHash, JobAttempt, NodeId, NodeSession},
    message::{AppToNode, Contact, JobTicket, NodeToApp, ResultAck, ResultHeader},
};
use proto::{
    codec::{content_hash, pack_programs},
    link::{ContentSource, Frame, Link, LinkReceiver, LinkSender, TrySendError, connect},
    trust::Identity,
};
use tokio::{
    sync::{OwnedSemaphorePermit, Semaphore, mpsc},
    task::AbortHandle,
};

use super::{Input, JobKey};
use crate::run::Payload;

/// Programs of one frame come to about this many bytes at most (a single program may be larger).
const FRAME_PROGRAM_BYTES: usize = 16 << 20;
/// Tickets of one frame name at most this many contents in all: about 4 MiB of header.
const FRAME_CONTENTS: usize = 100_000;
/// Frames taken from a link in one go.
const FRAMES_PER_WAKE: usize = 256;
/// Payloads above this size are digested on a blocking thread, in bytes: about 0.2 ms of blake3.
const DIGEST_INLINE_BYTES: usize = 256 << 10;
/// Unit of the bound on unretrieved results, in bytes.
const PERMIT_BYTES: usize = 1 << 10;

/// One link to one life of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LinkKey {
    pub(crate) node: NodeId,
    pub(crate) session: NodeSession,
    /// Tells this link from earlier ones to the same life.
    serial: u64,
}

/// A message of a node.
#[derive(Debug)]
pub(crate) struct Received {
    pub(super) message: NodeToApp,
    /// Of a result; empty for every other message.
    pub(super) payload: Payload,
}

pub(super) struct Links {
    links: BTreeMap<(NodeId, NodeSession), NodeLink>,
    next_serial: u64,
    inputs: mpsc::Sender<Input>,
    contents: ContentSource,
    results: ResultRoom,
    identity: Option<Identity>,
    /// What nodes of a secured farm are shown with the hello.
    capability: Bytes,
}

struct NodeLink {
    serial: u64,
    state: State,
    /// Whether the node has let us in.
    welcomed: bool,
}

enum State {
    Connecting(AbortHandle),
    Up(LinkSender<AppToNode>),
}

/// The bound on results received and not yet retrieved: a full one stops reading from nodes, and QUIC's flow control
/// lets the results wait in their spools.
#[derive(Clone, Debug)]
struct ResultRoom {
    permits: Arc<Semaphore>,
    all: u32,
}

impl Links {
    pub(super) fn new(
        inputs: mpsc::Sender<Input>,
        contents: ContentSource,
        result_bytes: usize,
        identity: Option<Identity>,
    ) -> Self {
        let most = Semaphore::MAX_PERMITS.min(u32::MAX as usize);
        let all = (result_bytes / PERMIT_BYTES).clamp(1, most);
        let results = ResultRoom {
            permits: Arc::new(Semaphore::new(all)),
            all: u32::try_from(all).expect("clamped to what a u32 holds"),
        };
        let links = BTreeMap::new();
        Self { links, next_serial: 0, inputs, contents, results, identity, capability: Bytes::new() }
    }

    /// From now on nodes are shown this.
    pub(super) fn show(&mut self, capability: Bytes) {
        self.capability = capability;
    }

    /// Links that stand.
    pub(super) fn count(&self) -> usize {
        self.links.values().filter(|link| matches!(link.state, State::Up(_))).count()
    }

    /// Whether a node has let us in.
    pub(super) fn reach_any(&self) -> bool {
        self.links.values().any(|link| link.welcomed)
    }

    pub(super) fn welcomed(&mut self, key: LinkKey) {
        if let Some(link) = self.links.get_mut(&(key.node, key.session)) {
            link.welcomed = true;
        }
    }

    pub(super) fn is_current(&self, key: LinkKey) -> bool {
        self.links.get(&(key.node, key.session)).is_some_and(|link| link.serial == key.serial)
    }

    /// Dials a node; the outcome comes as an input.
    pub(super) fn connect(&mut self, node: NodeId, session: NodeSession, contact: Contact) {
        // A link that the ledger has given up is closed by `Disconnect`, which comes first.
        let serial = self.next_serial;
        self.next_serial += 1;
        let key = LinkKey { node, session, serial };
        let link = NewLink { key, contact, identity: self.identity.clone(), contents: self.contents.clone() };
        let task = run_link(link, self.results.clone(), self.inputs.clone());
        let state = State::Connecting(tokio::spawn(task).abort_handle());
        self.links.insert((node, session), NodeLink { serial, state, welcomed: false });
    }

    /// A link stands. Gives whether it is still wanted.
    pub(super) fn connected(&mut self, key: LinkKey, sender: LinkSender<AppToNode>) -> bool {
        match self.links.get_mut(&(key.node, key.session)) {
            Some(link) if link.serial == key.serial => {
                link.state = State::Up(sender);
                true
            }
            _ => {
                sender.close("no longer needed");
                false
            }
        }
    }

    /// A link is over. Gives whether it was still wanted.
    pub(super) fn ended(&mut self, key: LinkKey) -> bool {
        let current = self.is_current(key);
        if current {
            self.links.remove(&(key.node, key.session));
        }
        current
    }

    pub(super) fn is_connecting(&self, node: NodeId, session: NodeSession) -> bool {
        let link = self.links.get(&(node, session));
        link.is_some_and(|link| matches!(link.state, State::Connecting(_)))
    }

    /// Forgets a link; what stands of it is to be closed.
    pub(super) fn disconnect(&mut self, node: NodeId, session: NodeSession) -> Option<LinkSender<AppToNode>> {
        match self.links.remove(&(node, session))?.state {
            State::Connecting(task) => {
                task.abort();
                None
            }
            State::Up(sender) => Some(sender),
        }
    }

    /// Sends a message on a link that stands; jobs with their programs.
    pub(super) fn send(
        &self,
        node: NodeId,
        session: NodeSession,
        message: AppToNode,
        programs: &HashMap<JobKey, Bytes>,
    ) {
        let Some(NodeLink { state: State::Up(sender), .. }) = self.links.get(&(node, session)) else {
            return;
        };
        match message {
            AppToNode::Jobs(tickets) => send_jobs(sender, tickets, programs),
            AppToNode::Hello { .. } => send_frame(sender, message, vec![self.capability.clone()]),
            AppToNode::Acks(_) | AppToNode::Cancel(_) | AppToNode::Holding(_) => {
                send_frame(sender, message, Vec::new())
            }
        }
    }
}

/// Sends jobs in frames of bounded size.
fn send_jobs(sender: &LinkSender<AppToNode>, tickets: Vec<JobTicket>, programs: &HashMap<JobKey, Bytes>) {
    let mut frame: Vec<JobTicket> = Vec::with_capacity(tickets.len());
    let mut payload: Vec<&Bytes> = Vec::with_capacity(tickets.len());
    let (mut program_bytes, mut contents) = (0, 0);
    for ticket in tickets {
        let job = ticket.job.job;
        let program = programs
            .get(&(job.task, job.index))
            .expect("the ledger sends only jobs whose programs it has not told to forget");
        let full = program_bytes + program.len() > FRAME_PROGRAM_BYTES
            || contents + ticket.contents.len() > FRAME_CONTENTS;
        if full && !frame.is_empty() {
            send_frame(sender, AppToNode::Jobs(std::mem::take(&mut frame)), pack_programs(payload.drain(..)));
            (program_bytes, contents) = (0, 0);
        }
        program_bytes += program.len();
        contents += ticket.contents.len();
        payload.push(program);
        frame.push(ticket);
    }
    if !frame.is_empty() {
        send_frame(sender, AppToNode::Jobs(frame), pack_programs(payload));
    }
}

fn send_frame(sender: &LinkSender<AppToNode>, header: AppToNode, payload: Vec<Bytes>) {
    match sender.try_send(header, payload) {
        Ok(()) => {}
        // A node that does not read thousands of frames is stuck: the link ends, and the ledger decides what follows.
        Err(TrySendError::Full(..)) => sender.close("the node does not read"),
        // A link that is over is reported by its reader; a frame over its cap cannot come from bounded batches, and
        // ending the link makes it a visible loss instead of a silent one.
        Err(TrySendError::Link(error)) => sender.close(&error.to_string()),
    }
}

/// What a link is made of.
struct NewLink {
    key: LinkKey,
    contact: Contact,
    identity: Option<Identity>,
    contents: ContentSource,
}

/// Dials, then passes on what the node says until the link is over.
async fn run_link(link: NewLink, room: ResultRoom, inputs: mpsc::Sender<Input>) {
    let NewLink { key, contact: Contact { addresses, certificate_der }, identity, contents } = link;
    let reason = match connect(&addresses, &certificate_der, identity.as_ref(), contents).await {
        Ok(Link { sender, receiver }) => {
            if inputs.send(Input::NodeConnected { key, sender: sender.clone() }).await.is_err() {
                return;
            }
            let reason = listen(key, receiver, &sender, &room, &inputs).await;
            sender.close(&reason);
            reason
        }
        Err(error) => error.to_string(),
    };
    // Without an owner task nobody wants to know.
    let _ = inputs.send(Input::NodeEnded { key, reason }).await;
}

/// Passes frames on in bursts; gives the reason why the link is over.
async fn listen(
    key: LinkKey,
    mut receiver: LinkReceiver<NodeToApp>,
    sender: &LinkSender<AppToNode>,
    room: &ResultRoom,
    inputs: &mpsc::Sender<Input>,
) -> String {
    let mut frames = Vec::with_capacity(FRAMES_PER_WAKE);
    loop {
        if let Err(error) = receiver.recv_many(&mut frames, FRAMES_PER_WAKE).await {
            return error.to_string();
        }
        let mut received = Vec::with_capacity(frames.len());
        for Frame { header, payload } in frames.drain(..) {
            let digest = match check(&header, &payload).await {
                Ok(Checked::Good) => match &header {
                    NodeToApp::Result(result) => result.digest,
                    NodeToApp::Welcome { .. } | NodeToApp::Refused { .. } | NodeToApp::Inventory(_) => {
                        ContentHash::EMPTY
                    }
                },
                Ok(Checked::Broken { job, found }) => {
                    tracing::warn!(%job, "a result does not have its digest");
                    // The node sends it again; if what it has is broken, it has the job made again.
                    let acks = vec![ResultAck { job, digest: found }];
                    send_frame(sender, AppToNode::Acks(acks), Vec::new());
                    continue;
                }
                Err(reason) => return reason,
            };
            let permit = match room.try_take(payload.len()) {
                Some(permit) => permit,
                None => {
                    // What is held back here may be what the room waits for: it goes on first.
                    let ready = std::mem::take(&mut received);
                    if inputs.send(Input::NodeSaid { key, received: ready }).await.is_err() {
                        return CLOSED.to_owned();
                    }
                    room.take(payload.len()).await
                }
            };
            received.push(Received { message: header, payload: Payload { bytes: payload, digest, permit } });
        }
        if inputs.send(Input::NodeSaid { key, received }).await.is_err() {
            return CLOSED.to_owned();
        }
    }
}

const CLOSED: &str = "the application has closed";

/// What is found of a payload.
#[derive(Debug, PartialEq, Eq)]
enum Checked {
    /// It is what its header says.
    Good,
    /// It has another digest than its header says.
    Broken { job: JobAttempt, found: ContentHash },
}

/// Whether a result's payload is what its header says. An error is a breach of the protocol; its text is for the node and the log.
async fn check(message: &NodeToApp, payload: &Bytes) -> Result<Checked, String> {
    let NodeToApp::Result(ResultHeader { job, outcome: Ok(sections), digest, .. }) = message else {
        return if payload.is_empty() {
            Ok(Checked::Good)
        } else {
            Err("a payload came with a message that has none".to_owned())
        };
    };
    let claimed = sections.iter().try_fold(0_u64, |sum, length| sum.checked_add(*length));
    if claimed != Some(payload.len() as u64) {
        return Err(format!(
            "the result of {job} has {} B, its sections come to {claimed:?} B",
            payload.len()
        ));
    }
    let found = if payload.len() <= DIGEST_INLINE_BYTES {
        content_hash(payload)
    } else {
        let payload = payload.clone();
        let digest = tokio::task::spawn_blocking(move || content_hash(&payload)).await;
        digest.map_err(|error| format!("the result of {job} could not be digested: {error}"))?
    };
    Ok(if found == *digest { Checked::Good } else { Checked::Broken { job: *job, found } })
}

impl ResultRoom {
    /// Permits for `bytes`; one result gets in whatever its size.
    fn permits_for(&self, bytes: usize) -> u32 {
        u32::try_from(bytes.div_ceil(PERMIT_BYTES)).unwrap_or(u32::MAX).min(self.all)
    }

    /// Room for a payload; the outer `None` says that there is none now, the inner that none is needed.
    #[allow(clippy::option_option, reason = "no room and no need for room are different answers")]
    fn try_take(&self, bytes: usize) -> Option<Option<OwnedSemaphorePermit>> {
        match self.permits_for(bytes) {
            0 => Some(None),
            permits => Arc::clone(&self.permits).try_acquire_many_owned(permits).ok().map(Some),
        }
    }

    /// Waits for room.
    async fn take(&self, bytes: usize) -> Option<OwnedSemaphorePermit> {
        // Nobody closes the semaphore.
        Arc::clone(&self.permits).acquire_many_owned(self.permits_for(bytes)).await.ok()
    }
}

#[cfg(test)]
mod tests {
    use farm_core::{
        id::{AppId, Attempt, DeviceIndex, Epoch, JobId, JobIndex, TaskId},
        message::JobFailure,
    };

    use super::*;

    fn result(sections: Vec<u64>, digest: ContentHash) -> NodeToApp {
        let job = JobId { app: AppId(1), task: TaskId(0), index: JobIndex(3) };
        NodeToApp::Result(ResultHeader {
            job: JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence: 1 } },
            device: DeviceIndex(0),
            device_time_ns: 1,
            outcome: Ok(sections),
            digest,
        })
    }

    #[tokio::test]
    async fn payloads_are_held_to_their_headers() {
        for size in [0, 12, DIGEST_INLINE_BYTES + 4] {
            let payload = Bytes::from(vec![5_u8; size]);
            let digest = content_hash(&payload);
            let length = size as u64;
            assert_eq!(check(&result(vec![length], digest), &payload).await, Ok(Checked::Good));
            let broken = check(&result(vec![length], ContentHash([1; 32])), &payload).await;
            assert!(matches!(broken, Ok(Checked::Broken { found, .. }) if found == digest), "got {broken:?}");
            let wrong = check(&result(vec![length, 4], digest), &payload).await.unwrap_err();
            assert!(wrong.contains("1/0/3"), "the job is named: {wrong}");
            assert!(check(&result(vec![u64::MAX, length + 1], digest), &payload).await.is_err());
        }
        let refused = NodeToApp::Refused { reason: String::new() };
        assert!(check(&refused, &Bytes::from_static(b"x")).await.is_err());
    }

    #[tokio::test]
    async fn a_failure_carries_no_payload() {
        let NodeToApp::Result(header) = result(vec![], ContentHash([0; 32])) else {
            panic!("made as a result")
        };
        let failed = NodeToApp::Result(ResultHeader { outcome: Err(JobFailure::Timeout), ..header });
        assert_eq!(check(&failed, &Bytes::new()).await, Ok(Checked::Good));
        assert!(check(&failed, &Bytes::from_static(b"x")).await.is_err());
    }

    #[tokio::test]
    async fn room_is_bounded_and_given_back() {
        let (inputs, _receiver) = mpsc::channel(1);
        let room = Links::new(inputs, ContentSource::empty(), 4 << 10, None).results;
        assert!(matches!(room.try_take(0), Some(None)));
        let first = room.try_take(3 << 10).expect("the room is empty");
        assert!(room.try_take(2 << 10).is_none(), "1 KiB is left");
        drop(first);
        let large = room.take(1 << 30).await.expect("one result gets in whatever its size");
        assert!(room.try_take(1).is_none());
        drop(large);
        assert!(room.try_take(4 << 10).is_some());
    }
}
