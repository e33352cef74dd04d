//! The one task that owns the machine: takes commands in bursts, feeds the machine, carries its effects out.
//!
//! It never waits for a peer: a peer whose queue is full does not read, and loses its connection.

use std::{collections::HashMap, sync::Arc, time::Duration};

use farm_core::{
    coordinator::{
        ContentsStatus, CoordinatorMachine, Effect, Event, FarmStatus,
        timeline::{Timeline, TimelineQuery},
    },
    id::{ContentHash, LinkId, NodeId},
    message::{AppToCoordinator, CoordinatorToApp, CoordinatorToNode, JobFailure, NodeToCoordinator},
    project::Quota,
    time::Instant,
};
use proto::trust::{Capability, Member, Scope};
use tokio::{
    sync::{mpsc, oneshot},
    time,
};
use tonic::Status;

use crate::{
    identities::Identities,
    keeper::Keeper,
    lead::Standbys,
    plugins::{Answered, Plugins},
    security::Gate,
};

/// Commands that wait for the owner; a full queue holds the peers' messages back in their connections.
pub(crate) const QUEUED_COMMANDS: usize = 1_024;
/// Messages that wait to be sent to one peer; a peer that lets this many gather is closed.
pub(crate) const QUEUED_MESSAGES: usize = 1_024;
/// Contents listed at once; further ones are counted.
const MAX_LISTED_CONTENTS: usize = 4_096;
/// Commands taken at once.
const BURST_COMMANDS: usize = 256;

/// What the owner is asked to do.
pub(crate) enum Command {
    /// A connection of an application was opened.
    AppOpened(LinkId, Peer<CoordinatorToApp>),
    /// A connection of a node was opened.
    NodeOpened(LinkId, Peer<CoordinatorToNode>),
    /// An application said something.
    FromApp(LinkId, AppToCoordinator),
    /// A node said something.
    FromNode(LinkId, NodeToCoordinator),
    /// A connection is gone.
    Closed(LinkId),
    /// Asks how the farm stands.
    Status(oneshot::Sender<FarmStatus>),
    /// Asks a node to leave; answered with whether there is such a node.
    Drain(NodeId, oneshot::Sender<bool>),
    /// Asks what large contents nodes hold.
    Contents(oneshot::Sender<ContentsStatus>),
    /// Asks nodes to drop contents; answered with whether there is such a node.
    Evict(Option<NodeId>, Vec<ContentHash>, oneshot::Sender<bool>),
    /// Asks what ran when and where.
    Timeline(TimelineQuery, oneshot::Sender<Timeline>),
    /// What a project may have.
    QuotaSet(String, Quota),
    /// A project is none any more.
    ProjectRemoved(String),
    /// Somebody is no member any more, or under another key: its sessions end.
    MembersChanged,
}

/// The owner's end of one connection. Dropping it ends the session after what is queued.
pub(crate) struct Peer<M> {
    /// To the peer.
    outbound: mpsc::Sender<Result<M, Status>>,
    /// Tells the session's reader to stop; dropped with the peer.
    _alive: oneshot::Sender<()>,
    /// Who it is, in a secured farm.
    member: Option<Member>,
    /// What an application that comes back has shown.
    shown: Option<Capability>,
    /// The project of who it is.
    project: String,
    /// The last quota that it was refused something for, as it was told.
    refused: Option<String>,
}

impl<M> Peer<M> {
    pub(crate) const fn new(
        outbound: mpsc::Sender<Result<M, Status>>,
        alive: oneshot::Sender<()>,
        member: Option<Member>,
        shown: Option<Capability>,
        project: String,
    ) -> Self {
        Self { outbound, _alive: alive, member, shown, project, refused: None }
    }

    /// False if the peer does not read or is gone.
    fn tell(&self, message: M) -> bool {
        self.outbound.try_send(Ok(message)).is_ok()
    }
}

/// Owns the machine until every handle of the command queue is dropped.
pub(crate) struct Owner {
    machine: CoordinatorMachine,
    plugins: Plugins,
    keeper: Keeper,
    /// The machine's time zero.
    origin: time::Instant,
    apps: HashMap<LinkId, Peer<CoordinatorToApp>>,
    nodes: HashMap<LinkId, Peer<CoordinatorToNode>>,
    identities: Identities,
}

impl Owner {
    pub(crate) fn new(machine: CoordinatorMachine, plugins: Plugins, keeper: Keeper, gate: Gate) -> Self {
        Self {
            machine,
            plugins,
            keeper,
            origin: time::Instant::now(),
            apps: HashMap::new(),
            nodes: HashMap::new(),
            identities: Identities::new(gate),
        }
    }

    /// Runs until `stop` is told or dropped.
    pub(crate) async fn run(
        mut self,
        mut commands: mpsc::Receiver<Command>,
        mut stop: oneshot::Receiver<()>,
    ) {
        let mut burst = Vec::with_capacity(BURST_COMMANDS);
        loop {
            let mut answered = None;
            let wake = self.machine.poll_timeout().map(|at| self.origin + Duration::from_nanos(at.0));
            tokio::select! {
                taken = commands.recv_many(&mut burst, BURST_COMMANDS) => {
                    if taken == 0 {
                        return;
                    }
                }
                answer = self.plugins.answered() => answered = Some(answer),
                () = time::sleep_until(wake.unwrap_or(self.origin)), if wake.is_some() => {}
                _ = &mut stop => return,
            }
            let now = Instant::ZERO.after(self.origin.elapsed());
            if let Some(Answered { question, answer }) = answered {
                self.machine.handle(now, Event::PolicyAnswered { question, answer });
            }
            for command in burst.drain(..) {
                self.take(now, command);
            }
            if self.machine.poll_timeout().is_some_and(|at| at <= now) {
                self.machine.handle_timeout(now);
            }
            self.carry_out(now);
        }
    }

    fn take(&mut self, now: Instant, command: Command) {
        match command {
            Command::AppOpened(link, peer) => {
                self.apps.insert(link, peer);
            }
            Command::NodeOpened(link, peer) => {
                self.nodes.insert(link, peer);
            }
            // What a peer said before its connection was closed here has no one to answer to.
            Command::FromApp(link, message) => {
                let Some(peer) = self.apps.get(&link) else { return };
                match self.identities.check_app(peer.member.as_ref(), peer.shown.as_ref(), &message) {
                    Ok(()) => {
                        if let AppToCoordinator::Supersede(app) = message
                            && !self.identities.may_supersede(peer.member.as_ref(), app)
                        {
                            return;
                        }
                        if matches!(message, AppToCoordinator::Hello(_)) {
                            let project = peer.project.clone();
                            self.machine.handle(now, Event::AppIntroduced { link, project });
                        }
                        let message = in_scope(peer, message);
                        self.machine.handle(now, Event::FromApp { link, message });
                    }
                    Err(reason) => self.refuse(now, link, reason),
                }
            }
            Command::FromNode(link, message) => {
                let Some(peer) = self.nodes.get(&link) else { return };
                match self.identities.check_node(peer.member.as_ref(), &message) {
                    Ok(()) => self.machine.handle(now, Event::FromNode { link, message }),
                    Err(reason) => self.refuse(now, link, reason),
                }
            }
            Command::Closed(link) => {
                if self.forget(link) {
                    self.machine.handle(now, Event::LinkClosed { link });
                }
            }
            Command::QuotaSet(project, quota) => {
                self.machine.handle(now, Event::QuotaSet { project, quota });
            }
            Command::ProjectRemoved(project) => self.machine.handle(now, Event::ProjectRemoved { project }),
            Command::MembersChanged => {
                let apps = self.apps.iter().map(|(&link, peer)| (link, peer.member.as_ref()));
                let nodes = self.nodes.iter().map(|(&link, peer)| (link, peer.member.as_ref()));
                let out: Vec<LinkId> = apps
                    .chain(nodes)
                    .filter(|(_, member)| self.identities.is_out(*member))
                    .map(|(link, _)| link)
                    .collect();
                for link in out {
                    self.refuse(now, link, "this membership is over".to_owned());
                }
            }
            // An asker that went away needs no answer.
            Command::Status(answer) => drop(answer.send(self.machine.status())),
            Command::Timeline(query, answer) => drop(answer.send(self.machine.timeline(query))),
            Command::Contents(answer) => drop(answer.send(self.machine.contents(MAX_LISTED_CONTENTS))),
            Command::Drain(node, answer) => {
                let known = self.knows(node);
                if known {
                    self.machine.handle(now, Event::DrainRequested { node });
                }
                let _ = answer.send(known);
            }
            Command::Evict(node, contents, answer) => {
                let known = node.is_none_or(|node| self.knows(node));
                if known {
                    self.machine.handle(now, Event::EvictRequested { node, contents });
                }
                let _ = answer.send(known);
            }
        }
    }

    fn knows(&self, node: NodeId) -> bool {
        self.machine.status().nodes.iter().any(|known| known.node == node)
    }

    /// Carries out every effect, those of the connections that broke meanwhile too.
    fn carry_out(&mut self, now: Instant) {
        while let Some(effect) = self.machine.poll_effect() {
            let (link, told) = match effect {
                Effect::ToApp { link, message } => (link, self.tell_app(link, message)),
                Effect::ToNode { link, message } => {
                    (link, self.nodes.get(&link).is_none_or(|peer| peer.tell(message)))
                }
                Effect::AskPolicy { id, plugin, question } => {
                    if let Err(reason) = self.plugins.ask(id, &plugin, question) {
                        self.machine.handle(now, Event::PolicyAnswered { question: id, answer: Err(reason) });
                    }
                    continue;
                }
                Effect::Keep(change) => {
                    self.keeper.keep(change);
                    continue;
                }
                Effect::Close { link } => {
                    // The machine has forgotten it already.
                    self.forget(link);
                    continue;
                }
            };
            if !told && self.forget(link) {
                tracing::warn!(%link, "connection closed: the peer is gone or does not read");
                self.machine.handle(now, Event::LinkClosed { link });
            }
        }
    }

    /// Tells an application something, and before it, where it is due, what to show to nodes. False if it does not read.
    fn tell_app(&mut self, link: LinkId, message: CoordinatorToApp) -> bool {
        let Some(peer) = self.apps.get_mut(&link) else { return true };
        if let CoordinatorToApp::JobFailed { failure: JobFailure::OverQuota(reason), .. } = &message
            && peer.refused.as_ref() != Some(reason)
        {
            // Once for all the jobs of a batch.
            peer.refused = Some(reason.clone());
            self.identities.refused_by_quota(peer.member.as_ref(), reason);
        }
        let machine = &self.machine;
        self.identities.welcomes(peer.member.as_ref(), &message, |app| machine.knows_app(app));
        let capability = peer
            .member
            .as_ref()
            .and_then(|member| self.identities.capability(link, member, &peer.project, &message));
        capability.is_none_or(|bytes| peer.tell(CoordinatorToApp::Capability(bytes))) && peer.tell(message)
    }

    /// Ends the connection of a member who says what it may not.
    fn refuse(&mut self, now: Instant, link: LinkId, reason: String) {
        let status = Status::permission_denied(reason);
        // A peer that does not read its answers does not learn why.
        if let Some(peer) = self.apps.get(&link) {
            let _ = peer.outbound.try_send(Err(status));
        } else if let Some(peer) = self.nodes.get(&link) {
            let _ = peer.outbound.try_send(Err(status));
        }
        if self.forget(link) {
            self.machine.handle(now, Event::LinkClosed { link });
        }
    }

    /// Ends a connection; false if it had ended before.
    fn forget(&mut self, link: LinkId) -> bool {
        self.identities.forget(link);
        self.apps.remove(&link).is_some() || self.nodes.remove(&link).is_some()
    }
}

/// Names the contents of a member's jobs as nodes do.
fn in_scope(peer: &Peer<CoordinatorToApp>, mut message: AppToCoordinator) -> AppToCoordinator {
    if let (Some(_), AppToCoordinator::Plan(request)) = (&peer.member, &mut message) {
        let scope = Scope::of(&peer.project);
        scope.name_all(&mut request.contents);
        request.module = request.module.map(|module| scope.name(module));
    }
    message
}

/// Talks to the owner; cloneable.
#[derive(Clone, Debug)]
pub(crate) struct OwnerHandle {
    commands: mpsc::Sender<Command>,
    standbys: Arc<Standbys>,
}

impl std::fmt::Debug for Command {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Command")
    }
}

impl OwnerHandle {
    /// The handle and the queue for [`Owner::run`].
    pub(crate) fn new(standbys: Arc<Standbys>) -> (Self, mpsc::Receiver<Command>) {
        let (commands, queue) = mpsc::channel(QUEUED_COMMANDS);
        (Self { commands, standbys }, queue)
    }

    /// Waits while the owner is busy; false once it has stopped.
    pub(crate) async fn send(&self, command: Command) -> bool {
        self.commands.send(command).await.is_ok()
    }

    /// `None` once the owner has stopped.
    pub(crate) async fn status(&self) -> Option<FarmStatus> {
        let (answer, status) = oneshot::channel();
        self.commands.send(Command::Status(answer)).await.ok()?;
        let status = status.await.ok()?;
        Some(FarmStatus { standbys: self.standbys.present(), ..status })
    }

    /// Whether there is such a node; `None` once the owner has stopped.
    pub(crate) async fn drain(&self, node: NodeId) -> Option<bool> {
        let (answer, known) = oneshot::channel();
        self.commands.send(Command::Drain(node, answer)).await.ok()?;
        known.await.ok()
    }

    /// `None` once the owner has stopped.
    pub(crate) async fn contents(&self) -> Option<ContentsStatus> {
        let (answer, contents) = oneshot::channel();
        self.commands.send(Command::Contents(answer)).await.ok()?;
        contents.await.ok()
    }

    /// Whether there is such a node; `None` once the owner has stopped.
    pub(crate) async fn evict(&self, node: Option<NodeId>, contents: Vec<ContentHash>) -> Option<bool> {
        let (answer, known) = oneshot::channel();
        self.commands.send(Command::Evict(node, contents, answer)).await.ok()?;
        known.await.ok()
    }

    /// `None` once the owner has stopped.
    pub(crate) async fn timeline(&self, query: TimelineQuery) -> Option<Timeline> {
        let (answer, timeline) = oneshot::channel();
        self.commands.send(Command::Timeline(query, answer)).await.ok()?;
        timeline.await.ok()
    }

    /// Has a project's quota count.
    pub(crate) async fn quota_set(&self, project: String, quota: Quota) {
        // An owner that has stopped has no projects.
        let _ = self.commands.send(Command::QuotaSet(project, quota)).await;
    }

    /// Forgets a project.
    pub(crate) async fn project_removed(&self, project: String) {
        let _ = self.commands.send(Command::ProjectRemoved(project)).await;
    }

    /// Ends the sessions of those who are no members any more.
    pub(crate) async fn members_changed(&self) {
        // An owner that has stopped has no sessions.
        let _ = self.commands.send(Command::MembersChanged).await;
    }

    /// Waits until the owner has stopped.
    pub(crate) async fn stopped(&self) {
        self.commands.closed().await;
    }
}

#[cfg(test)]
mod tests {
    use farm_core::{
        coordinator::CoordinatorConfig,
        id::Epoch,
        message::{AppHello, PROTOCOL_VERSION},
    };

    use super::*;

    #[tokio::test]
    async fn a_peer_that_does_not_read_is_closed_and_holds_nobody_up() {
        let (owner, commands) = OwnerHandle::new(Arc::default());
        let (_stop, stopped) = oneshot::channel();
        let machine = CoordinatorMachine::new(CoordinatorConfig::new(Epoch(1), 7));
        tokio::spawn(Owner::new(machine, Plugins::none(), Keeper::none(), Gate::Open).run(commands, stopped));
        let open = |link, capacity| {
            let (outbound, outgoing) = mpsc::channel(capacity);
            let (alive, ended) = oneshot::channel();
            let hello = AppHello {
                protocol: PROTOCOL_VERSION,
                name: "app".to_owned(),
                weight: 1.0,
                global_stealing: false,
                policy: String::new(),
                resume: None,
            };
            let said = [
                Command::AppOpened(link, Peer::new(outbound, alive, None, None, String::new())),
                Command::FromApp(link, AppToCoordinator::Hello(hello)),
                Command::FromApp(link, AppToCoordinator::Heartbeat { sequence: 1, unanswered: false }),
            ];
            (said, outgoing, ended)
        };
        // The first has room for its welcome only, the second for both answers.
        let (slow_said, mut slow, slow_ended) = open(LinkId(1), 1);
        let (quick_said, mut quick, mut quick_ended) = open(LinkId(2), 2);
        for command in slow_said.into_iter().chain(quick_said) {
            assert!(owner.send(command).await, "the owner runs");
        }
        // The first question may be of the same burst, whose effects come after it.
        owner.status().await.unwrap();
        let status = owner.status().await.unwrap();
        let connected: Vec<bool> = status.apps.iter().map(|app| app.connected).collect();
        assert_eq!(connected, [false, true], "the slow one lost its connection, the other did not");
        assert!(slow_ended.await.is_err(), "its reader was told to stop");
        assert!(
            matches!(slow.recv().await, Some(Ok(CoordinatorToApp::Welcome { .. }))),
            "what was queued is sent"
        );
        assert!(slow.recv().await.is_none(), "and its stream ends");
        assert!(matches!(quick.recv().await, Some(Ok(CoordinatorToApp::Welcome { .. }))), "the welcome");
        assert!(
            matches!(quick.recv().await, Some(Ok(CoordinatorToApp::HeartbeatAck { sequence: 1 }))),
            "the answer"
        );
        assert!(
            quick_ended.try_recv().is_err_and(|error| error == oneshot::error::TryRecvError::Empty),
            "alive"
        );
    }

    #[tokio::test]
    async fn the_owner_stops_when_told() {
        let (owner, commands) = OwnerHandle::new(Arc::default());
        let (stop, stopped) = oneshot::channel();
        let machine = CoordinatorMachine::new(CoordinatorConfig::new(Epoch(1), 7));
        let task = tokio::spawn(
            Owner::new(machine, Plugins::none(), Keeper::none(), Gate::Open).run(commands, stopped),
        );
        assert_eq!(owner.drain(NodeId(1)).await, Some(false), "no such node");
        drop(stop);
        task.await.unwrap();
        owner.stopped().await;
        assert_eq!(owner.status().await, None);
        assert!(!owner.send(Command::Closed(LinkId(1))).await, "nobody takes commands");
    }
}
