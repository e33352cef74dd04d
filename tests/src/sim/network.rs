//! The in-memory network: messages keep their order on a connection and lose it between connections; connections break
//! loudly (both ends are told), fall silent first, or hold everything back for a while.

use std::time::Duration;

use farm_core::{
    coordinator,
    id::{LinkId, NodeId, NodeSession},
    ledger,
    message::{
        AppToCoordinator, AppToNode, CoordinatorToApp, CoordinatorToNode, NodeToApp, NodeToCoordinator,
    },
    time::Instant,
    worker,
};
use rand::Rng;

use super::{
    faults::keepalive,
    world::{Happening, World},
};

/// Pause of a driver before it dials the coordinator again.
const REDIAL: Duration = Duration::from_millis(50);

/// How long a driver waits for an answer to its call before it dials again.
const DIAL_PATIENCE: Duration = Duration::from_millis(1_000);

/// Pause between two packets that begin a connection of QUIC (RFC 9002, 6.2: it grows; this is a later one).
const CALL_AGAIN: Duration = Duration::from_millis(500);

/// Latency of a message in a LAN whose hosts are busy, in microseconds.
const LAN_US: (u64, u64) = (50, 5_000);

/// Latencies of connections that are near, in another building, on another continent.
const MIXED_US: [(u64, u64); 3] = [(20, 500), LAN_US, (40_000, 60_000)];

/// A process of the farm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Proc {
    /// The one coordinator.
    Coordinator,
    /// By index in [`World::workers`].
    Worker(usize),
    /// By index in [`World::apps`].
    App(usize),
}

/// What a connection carries.
#[derive(Clone, Debug)]
pub enum Message {
    /// On an application's session.
    AppToCoordinator(AppToCoordinator),
    /// On an application's session.
    CoordinatorToApp(CoordinatorToApp),
    /// On a node's session.
    NodeToCoordinator(NodeToCoordinator),
    /// On a node's session.
    CoordinatorToNode(CoordinatorToNode),
    /// On a data link.
    AppToNode(AppToNode),
    /// On a data link.
    NodeToApp(NodeToApp),
}

/// The first shows it, two more are waited for, and the answer comes late at worst.
const COMPARISONS_UNTIL_MADE_UP_FOR: u32 = 4;

/// Whether comparisons of what is held make up for the loss of a message on a connection that stands. There are no such losses;
/// what looks like one would be a mistake of ours.
const fn can_be_made_up_for(message: &Message) -> bool {
    match message {
        Message::AppToNode(message) => {
            matches!(message, AppToNode::Jobs(_) | AppToNode::Acks(_) | AppToNode::Cancel(_))
        }
        Message::NodeToCoordinator(message) => {
            matches!(message, NodeToCoordinator::Report { .. } | NodeToCoordinator::Retracted { .. })
        }
        Message::CoordinatorToNode(message) => {
            matches!(message, CoordinatorToNode::Cancel { .. } | CoordinatorToNode::Retract { .. })
        }
        Message::CoordinatorToApp(message) => matches!(message, CoordinatorToApp::Plan(_)),
        Message::AppToCoordinator(_) | Message::NodeToApp(_) => false,
    }
}

/// Which messages may arrive twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Duplicates {
    /// None.
    Never,
    /// One in this many of those that carry jobs and results.
    Data(u32),
    /// One in this many of all but greetings and goodbyes, which a connection has once.
    Any(u32),
}

impl Duplicates {
    fn one_in(self, message: &Message) -> Option<u32> {
        match self {
            Self::Never => None,
            Self::Data(one_in) => {
                let data = matches!(
                    message,
                    Message::AppToNode(AppToNode::Jobs(_)) | Message::NodeToApp(NodeToApp::Result(_))
                );
                data.then_some(one_in)
            }
            Self::Any(one_in) => (!is_greeting(message)).then_some(one_in),
        }
    }
}

/// How far apart processes are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Distances {
    /// All in one LAN.
    Lan,
    /// Each connection near, middling or far.
    Mixed,
}

/// A connection.
#[derive(Debug)]
pub(super) struct Link {
    pub(super) dialler: Proc,
    pub(super) listener: Proc,
    /// What the dialler calls it: `None` for the coordinator.
    life: Option<(NodeId, NodeSession)>,
    /// The dialler knows that it stands.
    opened: bool,
    /// Messages vanish.
    silent: bool,
    /// This end's process is gone; what it said is still on its way.
    gone: Option<Proc>,
    /// Last arrival at the dialler and at the listener.
    last_arrival: [Instant; 2],
    latency_us: (u64, u64),
}

impl Link {
    pub(super) const fn is_silent(&self) -> bool {
        self.silent
    }

    const fn ends(&self) -> [Proc; 2] {
        [self.dialler, self.listener]
    }

    fn side(&self, to: Proc) -> usize {
        usize::from(self.listener == to)
    }
}

impl World {
    // ------------------------------------------------------------------ dialling

    pub(super) fn dial_coordinator(&mut self, proc: Proc, life: u32) {
        if self.life(proc) != life || !self.wants_coordinator(proc) {
            return;
        }
        if !self.coordinator_up {
            self.after(REDIAL, Happening::Dial { proc, life });
            return;
        }
        if self.is_blocked(proc, Proc::Coordinator) {
            self.after(DIAL_PATIENCE, Happening::Dial { proc, life });
            return;
        }
        let link = self.add_link(proc, Proc::Coordinator, None);
        self.after_latency(Happening::Opened { link });
    }

    /// An application dials a node, which is worker `index`.
    pub(super) fn dial_node(&mut self, app: usize, node: NodeId, session: NodeSession, index: usize) {
        let host = &self.workers[index];
        let reachable = host.session == session && host.is_up();
        if !reachable || self.cuts.contains(&(app, index)) {
            let life = self.apps[app].life;
            self.after_latency(Happening::NotOpened { app, life, node, session });
            return;
        }
        // Nobody answers: the driver repeats its call, until the ledger's patience ends.
        if self.is_blocked(Proc::App(app), Proc::Worker(index)) {
            let life = self.apps[app].life;
            self.after(CALL_AGAIN, Happening::CallAgain { app, life, node, session, worker: index });
            return;
        }
        let link = self.add_link(Proc::App(app), Proc::Worker(index), Some((node, session)));
        self.after_latency(Happening::Opened { link });
    }

    pub(super) fn call_again(
        &mut self,
        app: usize,
        life: u32,
        node: NodeId,
        session: NodeSession,
        worker: usize,
    ) {
        if self.apps[app].life == life && self.apps[app].dialling.contains(&(node, session)) {
            self.dial_node(app, node, session, worker);
        }
    }

    fn add_link(&mut self, dialler: Proc, listener: Proc, life: Option<(NodeId, NodeSession)>) -> LinkId {
        let id = LinkId(self.next_link);
        self.next_link += 1;
        let latency_us = match self.distances {
            Distances::Lan => LAN_US,
            Distances::Mixed => MIXED_US[self.rng.random_range(0..MIXED_US.len())],
        };
        let last_arrival = [self.now; 2];
        let link = Link {
            dialler,
            listener,
            life,
            opened: false,
            silent: false,
            gone: None,
            last_arrival,
            latency_us,
        };
        self.links.insert(id, link);
        id
    }

    pub(super) fn opened(&mut self, id: LinkId) {
        let Some(link) = self.links.get_mut(&id) else { return };
        link.opened = true;
        match (link.dialler, link.life) {
            (Proc::Worker(index), _) => {
                self.workers[index].control = Some(id);
                self.worker_event(index, worker::Event::CoordinatorConnected);
            }
            (Proc::App(index), None) => {
                self.apps[index].control = Some(id);
                self.app_event(index, ledger::Event::CoordinatorConnected);
            }
            (Proc::App(index), Some((node, session))) => {
                self.apps[index].dialling.remove(&(node, session));
                self.apps[index].nodes.insert((node, session), id);
                self.app_event(index, ledger::Event::NodeConnected { node, session });
            }
            (Proc::Coordinator, _) => panic!("the coordinator dials nobody"),
        }
    }

    // ------------------------------------------------------------------ messages

    pub(super) fn send(&mut self, from: Proc, id: LinkId, message: Message) {
        self.audit_said(&message);
        self.excuse(&message);
        if self.lost_one_in > 0 && can_be_made_up_for(&message) && self.rng.random_ratio(1, self.lost_one_in)
        {
            return self.lose(id);
        }
        let doubled = self.duplicates.one_in(&message).is_some_and(|one_in| self.rng.random_ratio(1, one_in));
        if !doubled || self.send_once(from, id, message.clone()) {
            self.send_once(from, id, message);
        }
    }

    /// A message is lost, until a comparison shows it, and a second look that it was not merely late.
    fn lose(&mut self, id: LinkId) {
        let Some([one, other]) = self.links.get(&id).map(Link::ends) else { return };
        let noticed = self.now.after(self.setup.liveness.compare_every() * COMPARISONS_UNTIL_MADE_UP_FOR);
        self.audit.disturbed(noticed, one, other);
    }

    /// Puts a message on its way. False if the connection carries none.
    fn send_once(&mut self, from: Proc, id: LinkId, message: Message) -> bool {
        let (least_us, most_us) = self.links.get(&id).map_or(LAN_US, |link| link.latency_us);
        let latency = Duration::from_micros(self.rng.random_range(least_us..most_us));
        let Some(link) = self.links.get_mut(&id) else { return false };
        let to = if link.dialler == from { link.listener } else { link.dialler };
        let side = link.side(to);
        if link.silent || self.blocked.contains(&(from, to)) {
            return false;
        }
        let read_at = match (from, to) {
            (Proc::Worker(_), Proc::App(app)) => self.apps[app].deaf_until,
            _ => Instant::ZERO,
        };
        let arrival = self.now.after(latency).max(link.last_arrival[side]).max(read_at);
        link.last_arrival[side] = arrival;
        self.at(arrival, Happening::Arrives { link: id, to, message });
        true
    }

    pub(super) fn arrives(&mut self, id: LinkId, to: Proc, message: Message) {
        let heard = |link: &&Link| !link.silent && link.gone != Some(to);
        let Some(link) = self.links.get(&id).filter(heard) else { return };
        let life = link.life;
        match (to, message) {
            (Proc::Coordinator, Message::AppToCoordinator(message)) => {
                self.coordinator_event(coordinator::Event::FromApp { link: id, message });
            }
            (Proc::Coordinator, Message::NodeToCoordinator(message)) => {
                self.coordinator_event(coordinator::Event::FromNode { link: id, message });
            }
            (Proc::Worker(index), Message::CoordinatorToNode(message)) => {
                self.worker_event(index, worker::Event::FromCoordinator(message));
            }
            (Proc::Worker(index), Message::AppToNode(message)) => self.worker_hears_app(index, id, message),
            (Proc::App(index), Message::CoordinatorToApp(message)) => {
                self.app_hears_coordinator(index, message);
            }
            (Proc::App(index), Message::NodeToApp(message)) => {
                let (node, session) = life.expect("nodes speak on data links");
                self.app_hears_node(index, node, session, message);
            }
            (to, message) => panic!("{to:?} cannot hear {message:?}"),
        }
    }

    // ------------------------------------------------------------------ what goes wrong

    /// A connection breaks: what is on its way is lost, both ends learn of it, each in its time.
    pub fn break_link(&mut self, id: LinkId) {
        let Some(link) = self.links.get(&id) else { return };
        let [dialler, listener] = link.ends();
        self.audit.disturbed(self.now, dialler, listener);
        self.drop_link(id);
    }

    /// One end closes: what it said before still arrives.
    pub(super) fn hang_up(&mut self, from: Proc, id: LinkId) {
        let Some(link) = self.links.get(&id) else { return };
        let said_last = link.last_arrival[1 - link.side(from)];
        self.at(said_last, Happening::HungUp { link: id });
    }

    pub(super) fn drop_link(&mut self, id: LinkId) {
        let Some(link) = self.links.remove(&id) else { return };
        for to in link.ends() {
            if let (Proc::App(index), Some(node_life)) = (to, link.life) {
                let host = &mut self.apps[index];
                let dialled = !link.opened && host.dialling.contains(&node_life);
                if dialled || host.nodes.get(&node_life) == Some(&id) {
                    host.nodes.remove(&node_life);
                    let (node, session) = node_life;
                    let life = self.apps[index].life;
                    self.after_latency(Happening::NotOpened { app: index, life, node, session });
                }
                continue;
            }
            let life = self.life(to);
            self.after_latency(Happening::Closed { link: id, to, life });
        }
    }

    pub(super) fn told_closed(&mut self, id: LinkId, to: Proc, life: u32) {
        if self.life(to) != life {
            return;
        }
        match to {
            Proc::Coordinator => self.coordinator_event(coordinator::Event::LinkClosed { link: id }),
            Proc::Worker(index) if self.workers[index].control == Some(id) => {
                self.workers[index].control = None;
                self.worker_event(index, worker::Event::CoordinatorLost);
                self.after(REDIAL, Happening::Dial { proc: to, life });
            }
            // Dialled, and broken before it opened.
            Proc::Worker(index) if self.workers[index].control.is_none() => {
                self.after(REDIAL, Happening::Dial { proc: to, life });
                self.worker_event(index, worker::Event::AppLinkClosed { link: id });
            }
            Proc::Worker(index) => self.worker_event(index, worker::Event::AppLinkClosed { link: id }),
            Proc::App(index) => {
                self.apps[index].control = None;
                self.app_event(index, ledger::Event::CoordinatorLost);
                self.after(REDIAL, Happening::Dial { proc: to, life });
            }
        }
    }

    /// The connections between two processes break.
    pub(super) fn break_links(&mut self, one: Proc, other: Proc) {
        for link in self.links_between(one, other).into_iter().chain(self.links_between(other, one)) {
            self.break_link(link);
        }
    }

    /// One end's process is gone; what it said still arrives, then the other end learns of it.
    pub(super) fn abandon(&mut self, from: Proc, id: LinkId) {
        let Some(link) = self.links.get_mut(&id) else { return };
        link.gone = Some(from);
        self.hang_up(from, id);
    }

    /// Messages on a connection vanish.
    pub(super) fn silence_link(&mut self, id: LinkId) {
        let Some(link) = self.links.get_mut(&id) else { return };
        link.silent = true;
        let [dialler, listener] = link.ends();
        self.audit.disturbed(self.now, dialler, listener);
    }

    /// What is said on a connection from now on arrives only after this time, in order.
    pub(super) fn stall_link(&mut self, id: LinkId, duration: Duration) {
        let until = self.now.after(duration);
        let Some(link) = self.links.get_mut(&id) else { return };
        link.last_arrival = link.last_arrival.map(|last| last.max(until));
        let [dialler, listener] = link.ends();
        self.audit.disturbed(until, dialler, listener);
    }

    /// Nothing gets from one process to another, on any connection.
    pub(super) fn block(&mut self, from: Proc, to: Proc) {
        self.blocked.insert((from, to));
        self.audit.disturbed(self.now, from, to);
    }

    /// Things get through again; connections of the time of the partition have timed out.
    pub(super) fn unblock(&mut self, from: Proc, to: Proc) {
        if self.blocked.remove(&(from, to)) {
            self.break_links(from, to);
        }
    }

    pub(super) fn is_blocked(&self, one: Proc, other: Proc) -> bool {
        self.blocked.contains(&(one, other)) || self.blocked.contains(&(other, one))
    }

    // ------------------------------------------------------------------ what is there

    /// The connections of a process.
    #[must_use]
    pub fn links_of(&self, proc: Proc) -> Vec<LinkId> {
        self.links.iter().filter(|(_, link)| link.ends().contains(&proc)).map(|(&id, _)| id).collect()
    }

    pub(super) fn links_between(&self, dialler: Proc, listener: Proc) -> Vec<LinkId> {
        self.links.iter().filter(|(_, link)| link.ends() == [dialler, listener]).map(|(&id, _)| id).collect()
    }

    /// How long a connection stands that is dead.
    pub(super) fn keepalive_of(&self, id: LinkId) -> Duration {
        self.links.get(&id).map_or(Duration::ZERO, |link| keepalive(link.dialler, link.listener))
    }

    pub(super) fn any_link(&mut self) -> Option<LinkId> {
        if self.links.is_empty() {
            return None;
        }
        let nth = self.rng.random_range(0..self.links.len());
        self.links.keys().nth(nth).copied()
    }

    pub(super) fn is_open(&self, id: LinkId) -> bool {
        self.links.get(&id).is_some_and(|link| {
            let [one, other] = link.ends();
            !link.silent && !self.is_blocked(one, other)
        })
    }

    pub(super) fn latency(&mut self) -> Duration {
        Duration::from_micros(self.rng.random_range(LAN_US.0..LAN_US.1))
    }

    pub(super) fn after_latency(&mut self, happening: Happening) {
        let latency = self.latency();
        self.after(latency, happening);
    }

    pub(super) fn life(&self, proc: Proc) -> u32 {
        match proc {
            Proc::Coordinator => self.store.epoch,
            Proc::Worker(index) => self.workers[index].life,
            Proc::App(index) => self.apps[index].life,
        }
    }

    fn wants_coordinator(&self, proc: Proc) -> bool {
        let control = match proc {
            Proc::Coordinator => return false,
            Proc::Worker(index) if !self.workers[index].is_up() => return false,
            Proc::Worker(index) => self.workers[index].control,
            Proc::App(index) if !self.apps[index].is_active() => return false,
            Proc::App(index) => self.apps[index].control,
        };
        let dials = |link: &Link| link.ends() == [proc, Proc::Coordinator] && link.gone != Some(proc);
        control.is_none() && !self.links.values().any(dials)
    }
}

fn is_greeting(message: &Message) -> bool {
    match message {
        Message::AppToCoordinator(message) => {
            matches!(message, AppToCoordinator::Hello(_) | AppToCoordinator::Goodbye)
        }
        Message::CoordinatorToApp(message) => {
            matches!(message, CoordinatorToApp::Welcome { .. } | CoordinatorToApp::Refused { .. })
        }
        Message::NodeToCoordinator(message) => {
            matches!(message, NodeToCoordinator::Hello(_) | NodeToCoordinator::Goodbye)
        }
        Message::CoordinatorToNode(message) => {
            matches!(message, CoordinatorToNode::Welcome { .. } | CoordinatorToNode::Refused { .. })
        }
        Message::AppToNode(message) => matches!(message, AppToNode::Hello { .. }),
        Message::NodeToApp(message) => {
            matches!(message, NodeToApp::Welcome { .. } | NodeToApp::Refused { .. })
        }
    }
}
