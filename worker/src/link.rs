//! Links: accepting those of applications and of nodes that fetch, reading from them, writing to them without ever waiting in
//! the owner task; fetching from other nodes.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, PoisonError},
};

use farm_core::{
    id::{AppId, ContentHash, JobAttempt, LinkId},
    message::{AppToNode, Contact, NodeToApp, ResultHeader},
    program::Content,
};
use proto::{
    link::{
        Arrived, ContentBytes, ContentSource, DataServer, Frame, Link, LinkReceiver, LinkSender, TrySendError,
    },
    trust::{Identity, Principal, Role, Scope},
};
use tokio::sync::mpsc;

use crate::{driver::Input, spool::Spool};

/// Frames taken from a link at once.
const FRAMES_PER_READ: usize = 64;

/// Accepts applications and nodes until the server shuts down.
pub(crate) async fn accept(server: Arc<DataServer>, contents: ContentSource, inputs: mpsc::Sender<Input>) {
    let mut next = 0;
    while let Some(incoming) = server.accept().await {
        let link = LinkId(next);
        next += 1;
        let (inputs, contents) = (inputs.clone(), contents.clone());
        tokio::spawn(async move {
            match incoming.establish(|peer| fetchable(contents, peer)).await {
                Ok((Link { sender, receiver }, peer)) => read(link, sender, receiver, peer, inputs).await,
                Err(error) => tracing::debug!(%link, %error, "a link was not made"),
            }
        });
    }
}

/// What a peer may fetch here: nodes, and in an open farm everyone, what they know the digest of; applications nothing.
fn fetchable(contents: ContentSource, peer: Option<&Principal>) -> ContentSource {
    match peer {
        None | Some(Principal { role: Role::Node, .. }) => contents,
        Some(_) => ContentSource::empty(),
    }
}

/// Where a content is fetched from.
#[derive(Debug)]
pub(crate) enum Source {
    /// An application, on its link; there is none if that is over.
    Application(Option<LinkSender<NodeToApp>>),
    /// Another node, on a link of its own: its handshake is little beside a large content.
    Node(Contact, Option<Identity>),
}

impl Source {
    /// Fetches what is missing of a content, which nodes call `name`.
    ///
    /// # Errors
    /// It could not be had, for people; `arrived` holds what is right of it.
    pub(crate) async fn fetch(
        self,
        name: ContentHash,
        content: Content,
        arrived: &mut Arrived,
    ) -> Result<ContentBytes, String> {
        let fetched = match self {
            Self::Application(sender) => {
                sender.ok_or("its application's link is over")?.fetch(content, arrived).await
            }
            Self::Node(Contact { addresses, certificate_der }, identity) => {
                let nothing = ContentSource::empty();
                let link: Link<AppToNode, NodeToApp> =
                    proto::link::connect(&addresses, &certificate_der, identity.as_ref(), nothing)
                        .await
                        .map_err(|error| error.to_string())?;
                link.sender.fetch_named(name, content, arrived).await
            }
        };
        fetched.map_err(|error| error.to_string())
    }
}

async fn read(
    link: LinkId,
    sender: LinkSender<NodeToApp>,
    mut receiver: LinkReceiver<AppToNode>,
    peer: Option<Principal>,
    inputs: mpsc::Sender<Input>,
) {
    if inputs.send(Input::LinkOpened { link, sender, peer }).await.is_err() {
        return;
    }
    loop {
        let mut frames: Vec<Frame<AppToNode>> = Vec::new();
        let read = receiver.recv_many(&mut frames, FRAMES_PER_READ).await;
        if let Err(error) = read {
            tracing::debug!(%link, %error, "a link is over");
            // Without a driver the worker has ended.
            let _ = inputs.send(Input::LinkEnded { link }).await;
            return;
        }
        if inputs.send(Input::AppSaid { link, frames }).await.is_err() {
            return;
        }
    }
}

/// Frames that wait, in order; `None` while none does and nobody forwards.
type Backlog = Mutex<Option<VecDeque<NodeToApp>>>;

/// The writing side of a link: straight into its queue while that has room, else over a backlog that a task of its own
/// works off in order. A result's bytes stay in the spool until its turn.
#[derive(Debug)]
pub(crate) struct Outbox {
    sender: LinkSender<NodeToApp>,
    /// Who is at the other end, in a secured farm.
    peer: Option<Principal>,
    /// Which application it is, and whose contents its jobs name; `None` before a hello that was let in.
    app: Option<(AppId, Scope)>,
    /// `Some` while frames wait. A lock, not messages: the forwarder must end and the owner must see that it ended in
    /// one step, or a frame could be left behind. Held for a push or a pop. At most one result of each job held
    /// waits here (`MAX_JOBS`).
    backlog: Arc<Backlog>,
    spool: Spool,
    /// Hears of results that cannot be read.
    inputs: mpsc::Sender<Input>,
}

impl Outbox {
    pub(crate) fn new(
        sender: LinkSender<NodeToApp>,
        peer: Option<Principal>,
        spool: Spool,
        inputs: mpsc::Sender<Input>,
    ) -> Self {
        Self { sender, peer, app: None, backlog: Arc::new(Mutex::new(None)), spool, inputs }
    }

    /// Who is at the other end, in a secured farm.
    pub(crate) const fn peer(&self) -> Option<&Principal> {
        self.peer.as_ref()
    }

    /// Which application it is, and whose contents its jobs name; `None` before a hello that was let in.
    pub(crate) const fn app(&self) -> Option<(AppId, Scope)> {
        self.app
    }

    /// Its hello is let in.
    pub(crate) const fn introduce(&mut self, app: AppId, scope: Scope) {
        self.app = Some((app, scope));
    }

    /// The link, for fetching.
    pub(crate) const fn sender(&self) -> &LinkSender<NodeToApp> {
        &self.sender
    }

    /// Sends a frame, now or later. A link that is over drops it: what counts is sent again on the next link.
    pub(crate) fn send(&self, header: NodeToApp) {
        let mut backlog = self.backlog.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(waiting) = backlog.as_mut() {
            waiting.push_back(header);
            return;
        }
        let at_hand = match result_of(&header) {
            Some(job) => self.spool.at_hand(job),
            None => Some(Vec::new()),
        };
        let waits = match at_hand {
            Some(payload) => match self.sender.try_send(header, payload) {
                Ok(()) => return,
                Err(TrySendError::Full(header, _)) => header,
                Err(TrySendError::Link(error)) => {
                    return tracing::debug!(%error, "a frame was dropped with its link");
                }
            },
            None => header,
        };
        *backlog = Some(VecDeque::from([waits]));
        let (sender, backlog) = (self.sender.clone(), Arc::clone(&self.backlog));
        tokio::spawn(forward(sender, backlog, self.spool.clone(), self.inputs.clone()));
    }

    /// Closes the link once everything is sent.
    pub(crate) fn close(self, reason: &'static str) {
        tokio::spawn(async move { self.sender.close_after_sent(reason).await });
    }
}

/// The job whose result goes with this header.
fn result_of(header: &NodeToApp) -> Option<JobAttempt> {
    match header {
        NodeToApp::Result(ResultHeader { job, outcome: Ok(_), .. }) => Some(*job),
        NodeToApp::Result(ResultHeader { outcome: Err(_), .. })
        | NodeToApp::Welcome { .. }
        | NodeToApp::Refused { .. }
        | NodeToApp::Inventory(_) => None,
    }
}

async fn forward(
    sender: LinkSender<NodeToApp>,
    backlog: Arc<Backlog>,
    spool: Spool,
    inputs: mpsc::Sender<Input>,
) {
    loop {
        let next = {
            let mut backlog = backlog.lock().unwrap_or_else(PoisonError::into_inner);
            let next = backlog.as_mut().and_then(VecDeque::pop_front);
            if next.is_none() {
                *backlog = None;
            }
            next
        };
        let Some(header) = next else { return };
        let payload = match result_of(&header) {
            None => Ok(Some(Vec::new())),
            Some(job) => spool.read(job).await.map_err(|error| (job, error)),
        };
        let payload = match payload {
            Ok(Some(payload)) => payload,
            // It was acknowledged or cancelled while it waited.
            Ok(None) => continue,
            Err((job, error)) => {
                tracing::error!(?job, %error, "a result cannot be read back from disk");
                // Without a driver the worker has ended.
                let _ = inputs.send(Input::ResultLost { job }).await;
                continue;
            }
        };
        if let Err(error) = sender.send(header, payload).await {
            tracing::debug!(%error, "frames were dropped with their link");
            backlog.lock().unwrap_or_else(PoisonError::into_inner).take();
            return;
        }
    }
}
