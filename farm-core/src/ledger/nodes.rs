//! The ledger's links to nodes: which are wanted, what waits to be said on them, when to try again and when to give up.
//! It never decides whether a result counts.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use super::{Effect, Ledger, jobs::Placement, session::Session};
use crate::{
    holding::Holding,
    id::{Attempt, ContentHash, JobAttempt, JobKey, NodeId, NodeSession, TaskId},
    message::{AppToCoordinator, AppToNode, Contact, JobTicket, NodeToApp, PROTOCOL_VERSION, ResultAck},
    time::Instant,
};

/// Most jobs, acknowledgements or cancellations in one message to a node.
const MAX_MESSAGE_JOBS: usize = 1_024;

/// How long a connection or a node's welcome may take, in milliseconds.
const CONNECT_TIMEOUT_MS: u64 = 5_000;

/// First pause before connecting again, in milliseconds; it doubles with each try.
const BACKOFF_MS: u64 = 50;

/// Most connection tries in a row before the node counts as unreachable from here.
const MAX_CONNECT_TRIES: u32 = 6;

/// Longest time without a first link before the node counts as unreachable from here, in milliseconds.
const MAX_CONNECT_MS: u64 = 10_000;

/// And without a link that stood before. A silent one is lost after 6 s (`proto/src/link/connect.rs`): jobs move off a node that
/// their application cannot reach within the node's own lease of 10 s.
const MAX_RECONNECT_MS: u64 = 3_500;

/// One life of a node: what links are keyed by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct NodeLife {
    pub(super) node: NodeId,
    pub(super) session: NodeSession,
}

/// How a link stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Link {
    /// Asked the driver to connect.
    Connecting,
    /// Connected, hello said, no welcome yet.
    Greeting,
    /// Welcome: jobs may be sent.
    Open,
    /// Lost; the next try comes at the node's deadline.
    Backoff,
    /// Given up and reported; a new plan for the node starts afresh.
    Unreachable,
}

/// A node that holds, or shall hold, jobs of ours.
#[derive(Debug)]
pub(super) struct Node {
    pub(super) contact: Contact,
    pub(super) link: Link,
    /// Tries since the link last stood for a while, or brought a result.
    tries: u32,
    /// Until when a link is tried for.
    try_until: Instant,
    /// Attempts there that have no result yet.
    pub(super) outstanding: BTreeMap<Attempt, JobKey>,
    /// Those of them to be sent on the current link, in plan order.
    unsent: VecDeque<Attempt>,
    acks: Vec<ResultAck>,
    cancels: Vec<JobAttempt>,
    /// It is time to say what should be there.
    compare: bool,
    /// The link stood: results may be there whose acknowledgement got lost, and that it repeats on the next one.
    may_keep_results: bool,
}

impl Node {
    /// When a try that begins now, or a greeting, has failed without an answer. One that begins too late, because the timer
    /// did, has its time all the same.
    fn answer_by(&self, now: Instant) -> Instant {
        let timeout = now.after(Duration::from_millis(CONNECT_TIMEOUT_MS));
        if self.try_until > now { timeout.min(self.try_until) } else { timeout }
    }

    /// Whether there is anything to have a link for.
    fn is_wanted(&self) -> bool {
        !self.outstanding.is_empty() || self.may_keep_results
    }
}

impl Ledger {
    /// Sends newly planned attempts, as soon as the node's link is open.
    pub(super) fn send_attempts(
        &mut self,
        now: Instant,
        life: NodeLife,
        contact: Contact,
        attempts: Vec<Attempt>,
    ) {
        let Some(node) = self.nodes.get_mut(&life) else { return };
        node.unsent.extend(attempts);
        let wanted = match node.link {
            Link::Open => {
                self.dirty.insert(life);
                false
            }
            Link::Connecting | Link::Greeting => false,
            Link::Backoff => {
                node.contact = contact.clone();
                false
            }
            Link::Unreachable => true,
        };
        if wanted {
            node.contact = contact;
            node.tries = 0;
            node.try_until = now.after(Duration::from_millis(MAX_CONNECT_MS));
            self.connect(now, life);
            self.close_older_lives(life);
        }
    }

    /// An attempt's place is now this node.
    pub(super) fn enters_node(&mut self, life: NodeLife, attempt: Attempt, key: JobKey) {
        let node = self.nodes.entry(life).or_insert_with(|| Node {
            contact: Contact { addresses: Vec::new(), certificate_der: Vec::new() },
            link: Link::Unreachable,
            tries: 0,
            try_until: Instant::ZERO,
            outstanding: BTreeMap::new(),
            unsent: VecDeque::new(),
            acks: Vec::new(),
            cancels: Vec::new(),
            compare: false,
            may_keep_results: false,
        });
        node.outstanding.insert(attempt, key);
    }

    /// An attempt's place is this node no more.
    pub(super) fn leaves_node(&mut self, place: Placement) {
        let Some(node) = self.nodes.get_mut(&place.life) else { return };
        node.outstanding.remove(&place.attempt);
        if !node.is_wanted() && matches!(node.link, Link::Backoff | Link::Unreachable) {
            self.nodes.remove(&place.life);
            self.deadlines.remove(&place.life);
        }
    }

    pub(super) fn node_connected(&mut self, now: Instant, life: NodeLife) {
        let (Some(identity), Some(node)) = (self.identity, self.nodes.get_mut(&life)) else {
            self.push(Effect::Disconnect { node: life.node, session: life.session });
            return;
        };
        node.link = Link::Greeting;
        self.deadlines.insert(life, node.answer_by(now));
        let hello = AppToNode::Hello {
            protocol: PROTOCOL_VERSION,
            app: identity.app,
            incarnation: identity.incarnation,
        };
        self.tell_node(life, hello);
    }

    pub(super) fn node_lost(&mut self, now: Instant, life: NodeLife) {
        let Some(node) = self.nodes.get_mut(&life) else { return };
        // Unsaid acknowledgements are not missed: the node repeats its results on the next link.
        node.acks.clear();
        node.cancels.clear();
        self.dirty.remove(&life);
        match node.link {
            Link::Open => node.try_until = now.after(Duration::from_millis(MAX_RECONNECT_MS)),
            Link::Connecting | Link::Greeting => {}
            Link::Backoff | Link::Unreachable => return,
        }
        let gives_up = node.tries >= MAX_CONNECT_TRIES || node.try_until <= now;
        if gives_up {
            node.link = Link::Unreachable;
            node.may_keep_results = false;
            node.unsent.clear();
            self.deadlines.remove(&life);
        }
        if !node.is_wanted() {
            self.nodes.remove(&life);
            self.deadlines.remove(&life);
            return;
        }
        if gives_up {
            self.say_unreachable(life);
            return;
        }
        node.link = Link::Backoff;
        let pause_ms = BACKOFF_MS << node.tries;
        self.deadlines.insert(life, now.after(Duration::from_millis(pause_ms)));
    }

    pub(super) fn node_said(&mut self, now: Instant, life: NodeLife, message: NodeToApp) {
        match message {
            NodeToApp::Welcome { node, session } => {
                if life == (NodeLife { node, session }) {
                    self.node_welcomed(now, life);
                } else {
                    // Another process answers at the address: the life we look for is over.
                    self.drop_link(now, life);
                }
            }
            NodeToApp::Refused { reason } => {
                tracing::warn!(node = %life.node, reason, "node refused the link");
                self.drop_link(now, life);
            }
            NodeToApp::Result(header) => {
                self.nodes.entry(life).and_modify(|node| node.tries = 0);
                self.result(life, header);
            }
            NodeToApp::Inventory(held) => self.node_holds(life, &held),
        }
    }

    pub(super) fn node_timeouts(&mut self, now: Instant) {
        let due: Vec<NodeLife> =
            self.deadlines.iter().filter(|(_, deadline)| **deadline <= now).map(|(&life, _)| life).collect();
        for life in due {
            self.deadlines.remove(&life);
            let Some(node) = self.nodes.get_mut(&life) else { continue };
            match node.link {
                Link::Backoff => self.connect(now, life),
                Link::Connecting | Link::Greeting => self.drop_link(now, life),
                Link::Open => {
                    node.tries = 0;
                    node.compare = true;
                    self.dirty.insert(life);
                    self.deadlines.insert(life, now.after(self.compare_every));
                }
                Link::Unreachable => {}
            }
        }
    }

    /// Puts tickets, acknowledgements and cancellations into messages.
    pub(super) fn flush_nodes(&mut self) {
        while let Some(life) = self.dirty.pop_first() {
            let Some(node) = self.nodes.get_mut(&life) else { continue };
            if node.link != Link::Open {
                continue;
            }
            let acks = std::mem::take(&mut node.acks);
            let cancels = std::mem::take(&mut node.cancels);
            let unsent = std::mem::take(&mut node.unsent);
            for chunk in acks.chunks(MAX_MESSAGE_JOBS) {
                self.tell_node(life, AppToNode::Acks(chunk.to_vec()));
            }
            for chunk in cancels.chunks(MAX_MESSAGE_JOBS) {
                self.tell_node(life, AppToNode::Cancel(chunk.to_vec()));
            }
            self.send_tickets(life, &unsent);
            self.say_holding(life);
        }
    }

    pub(super) fn acknowledge(&mut self, life: NodeLife, job: JobAttempt, digest: ContentHash) {
        let Some(node) = self.nodes.get_mut(&life) else { return };
        node.acks.push(ResultAck { job, digest });
        self.dirty.insert(life);
    }

    pub(super) fn cancel_on_node(&mut self, life: NodeLife, job: JobAttempt) {
        let Some(node) = self.nodes.get_mut(&life) else { return };
        if node.link == Link::Open {
            node.cancels.push(job);
            self.dirty.insert(life);
        }
    }

    pub(super) fn cancel_at_coordinator(&mut self, task: TaskId) {
        if matches!(self.session, Session::Registered(_)) {
            self.tell_coordinator(AppToCoordinator::Cancel(task));
        }
    }

    /// After a reconnect the coordinator may have missed our word.
    pub(super) fn say_unreachable_again(&mut self) {
        let lives: Vec<NodeLife> = self
            .nodes
            .iter()
            .filter(|(_, node)| node.link == Link::Unreachable)
            .map(|(&life, _)| life)
            .collect();
        lives.into_iter().for_each(|life| self.say_unreachable(life));
    }

    pub(super) fn close_all_nodes(&mut self) {
        self.deadlines.clear();
        self.dirty.clear();
        for life in std::mem::take(&mut self.nodes).into_keys() {
            self.push(Effect::Disconnect { node: life.node, session: life.session });
        }
    }

    fn connect(&mut self, now: Instant, life: NodeLife) {
        let Some(node) = self.nodes.get_mut(&life) else { return };
        node.link = Link::Connecting;
        node.tries += 1;
        let contact = node.contact.clone();
        self.deadlines.insert(life, node.answer_by(now));
        self.push(Effect::Connect { node: life.node, session: life.session, contact });
    }

    fn node_welcomed(&mut self, now: Instant, life: NodeLife) {
        let Some(node) = self.nodes.get_mut(&life) else { return };
        if node.link != Link::Greeting {
            return;
        }
        node.link = Link::Open;
        node.may_keep_results = true;
        node.compare = false;
        // Everything without a result goes (again): the node ignores what it has.
        node.unsent = node.outstanding.keys().copied().collect();
        self.deadlines.insert(life, now.after(self.compare_every));
        self.dirty.insert(life);
    }

    /// Says what should be at the node, after everything else that is to be said.
    fn say_holding(&mut self, life: NodeLife) {
        let (Some(app), Some(node)) = (self.app(), self.nodes.get(&life)) else { return };
        if !node.compare {
            return;
        }
        let outstanding = node.outstanding.iter();
        let outstanding = outstanding.map(|(&attempt, key)| JobAttempt { job: key.in_app(app), attempt });
        let holding: Holding = outstanding.chain(self.unkept_on(life)).collect();
        self.nodes.entry(life).and_modify(|node| node.compare = false);
        self.tell_node(life, AppToNode::Holding(holding));
    }

    /// What a node holds, where it is not what should be there: tickets that got lost are sent again (those of jobs that ended
    /// badly there, and that the coordinator plans anew, do no harm), and what nobody waits for goes.
    fn node_holds(&mut self, life: NodeLife, held: &[JobAttempt]) {
        let kept: BTreeSet<JobAttempt> = self.unkept_on(life).collect();
        let Some(node) = self.nodes.get_mut(&life).filter(|node| node.link == Link::Open) else { return };
        let there: BTreeSet<Attempt> = held.iter().map(|job| job.attempt).collect();
        node.unsent.extend(node.outstanding.keys().filter(|attempt| !there.contains(attempt)));
        let unwanted =
            |job: &&JobAttempt| !node.outstanding.contains_key(&job.attempt) && !kept.contains(job);
        node.cancels.extend(held.iter().filter(unwanted));
        self.dirty.insert(life);
    }

    fn drop_link(&mut self, now: Instant, life: NodeLife) {
        self.push(Effect::Disconnect { node: life.node, session: life.session });
        self.node_lost(now, life);
    }

    /// A node's name has one life at a time: links to earlier ones are of no use.
    fn close_older_lives(&mut self, life: NodeLife) {
        let first = NodeLife { node: life.node, session: NodeSession(0) };
        let last = NodeLife { node: life.node, session: NodeSession(u64::MAX) };
        let idle: Vec<NodeLife> = self
            .nodes
            .range(first..=last)
            .filter(|(other, node)| **other != life && node.outstanding.is_empty())
            .map(|(&other, _)| other)
            .collect();
        for other in idle {
            self.nodes.remove(&other);
            self.deadlines.remove(&other);
            self.dirty.remove(&other);
            self.push(Effect::Disconnect { node: other.node, session: other.session });
        }
    }

    fn say_unreachable(&mut self, life: NodeLife) {
        if matches!(self.session, Session::Registered(_)) {
            self.tell_coordinator(AppToCoordinator::Unreachable { node: life.node, session: life.session });
        }
    }

    fn send_tickets(&mut self, life: NodeLife, unsent: &VecDeque<Attempt>) {
        let Some(app) = self.app() else { return };
        let Some(node) = self.nodes.get(&life) else { return };
        let mut messages = Vec::new();
        let mut tickets = Vec::with_capacity(unsent.len().min(MAX_MESSAGE_JOBS));
        for attempt in unsent {
            // Moved, delivered or cancelled meanwhile: nothing to send.
            let Some(key) = node.outstanding.get(attempt) else { continue };
            let Some(job) = self.jobs.get(key) else { continue };
            let Some(place) = job.placements().find(|place| place.attempt == *attempt) else { continue };
            tickets.push(JobTicket {
                job: JobAttempt { job: key.in_app(app), attempt: *attempt },
                device: place.device,
                class: job.class,
                priority: job.priority,
                cost: job.cost,
                contents: job.contents.clone(),
            });
            if tickets.len() == MAX_MESSAGE_JOBS {
                messages.push(AppToNode::Jobs(std::mem::take(&mut tickets)));
            }
        }
        if !tickets.is_empty() {
            messages.push(AppToNode::Jobs(tickets));
        }
        for message in messages {
            self.tell_node(life, message);
        }
    }

    fn tell_node(&mut self, life: NodeLife, message: AppToNode) {
        self.push(Effect::ToNode { node: life.node, session: life.session, message });
    }
}
