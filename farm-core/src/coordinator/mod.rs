//! The coordinator's state machine: registration, FCFS placement over scored devices, leases, completions.
//!
//! It owns plans, load and fairness; it never owns job payloads, sockets or clocks. A driver feeds events by connection
//! ([`LinkId`]) and carries the effects out.
//!
//! Split by event family: `registry` (who is there), `placement` (where jobs go, by a `policy`; `consult` asks plug-ins, `reserve`
//! holds a learning policy's jobs back, `neighbours` says what they will cost), `inventory` (what nodes hold),
//! `report` (what ended), `replan` (what was lost), `steal` (what moves between nodes), `speculate` (what runs twice at the tail),
//! `breaker` (which application is stopped), `lease` (who is silent), `contents` (who has and brings which data), `durable` (what
//! outlives it), `project` (what belongs together, and may have how much), `status` (what operators see), `timeline` (what ran when
//! and where). `model` holds the state they share, `rates` what devices are worth.

mod breaker;
mod consult;
mod contents;
pub mod durable;
mod invariants;
mod inventory;
mod lease;
mod model;
mod neighbours;
mod placement;
pub mod policy;
mod project;
mod rates;
mod recovery;
mod registry;
mod replan;
mod report;
mod reserve;
mod speculate;
mod status;
mod steal;
pub mod timeline;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use serde::{Deserialize, Serialize};

use self::{
    consult::{Asked, PluginFaults},
    contents::Spreads,
    durable::{Durable, Keep, Restored},
    model::{App, Node, Peer, Pending, Placement},
    policy::{Choice, History, Question, QuestionId},
    project::Projects,
    rates::Modules,
    recovery::Recovery,
    steal::{Steal, StealLatency},
    timeline::Record,
};
use crate::{
    device::DeviceKind,
    id::{AppId, Attempt, BatchId, ContentHash, DeviceIndex, Epoch, JobId, JobKey, LinkId, NodeId, StealId},
    message::{
        AppToCoordinator, CacheFigures, CoordinatorToApp, CoordinatorToNode, Liveness, NodeToCoordinator,
    },
    program::Content,
    project::Quota,
    time::Instant,
};

/// Settings of a coordinator.
#[derive(Clone, Debug)]
pub struct CoordinatorConfig {
    /// This life; larger than every earlier one.
    pub epoch: Epoch,
    /// Timings told to nodes and applications, and judged by.
    pub liveness: Liveness,
    /// How long a vanished application keeps its jobs.
    pub app_lease_ms: u64,
    /// Attempts that may end with their device or node before the job counts as poison.
    pub max_crashes: u32,
    /// Names of the plug-in policies that can be asked.
    pub plugins: BTreeSet<String>,
    /// Seed of the machine's one generator.
    pub seed: u64,
    /// What earlier lives kept.
    pub restored: Restored,
    /// What projects may have, by name.
    pub quotas: BTreeMap<String, Quota>,
}

impl CoordinatorConfig {
    /// The design's values (20-delivery.md).
    #[must_use]
    pub fn new(epoch: Epoch, seed: u64) -> Self {
        Self {
            epoch,
            liveness: Liveness::default(),
            app_lease_ms: 30_000,
            max_crashes: 3,
            plugins: BTreeSet::new(),
            seed,
            restored: Restored::default(),
            quotas: BTreeMap::new(),
        }
    }
}

/// What happens to a coordinator.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// An application said something.
    FromApp {
        /// On which connection.
        link: LinkId,
        /// What.
        message: AppToCoordinator,
    },
    /// A node said something.
    FromNode {
        /// On which connection.
        link: LinkId,
        /// What.
        message: NodeToCoordinator,
    },
    /// A connection of either kind is gone.
    LinkClosed {
        /// Which.
        link: LinkId,
    },
    /// Whose the connection is on which an application says hello next; without, it is of the project `default`.
    AppIntroduced {
        /// Which.
        link: LinkId,
        /// The project's name.
        project: String,
    },
    /// What a project may have from now on; one that is not there is made.
    QuotaSet {
        /// Its name.
        project: String,
        /// What it may have.
        quota: Quota,
    },
    /// A project is none any more; what is registered of it goes on without quotas. `default` stays.
    ProjectRemoved {
        /// Its name.
        project: String,
    },
    /// An operator asks a node to leave.
    DrainRequested {
        /// Which.
        node: NodeId,
    },
    /// An operator wants contents dropped where no job needs them.
    EvictRequested {
        /// Of one node; of all where none is named.
        node: Option<NodeId>,
        /// Which; all where none is named.
        contents: Vec<ContentHash>,
    },
    /// A plug-in answered, or will not.
    PolicyAnswered {
        /// Which question.
        question: QuestionId,
        /// A choice for every job, in the order they should run; or why there is none, for people.
        answer: Result<Vec<Choice>, String>,
    },
}

/// What a coordinator wants done.
#[derive(Clone, Debug, PartialEq)]
pub enum Effect {
    /// Say something to an application.
    ToApp {
        /// On which connection.
        link: LinkId,
        /// What.
        message: CoordinatorToApp,
    },
    /// Say something to a node.
    ToNode {
        /// On which connection.
        link: LinkId,
        /// What.
        message: CoordinatorToNode,
    },
    /// Close a connection after what was said on it.
    Close {
        /// Which.
        link: LinkId,
    },
    /// Ask a plug-in; answer with [`Event::PolicyAnswered`]. An answer that comes too late is ignored.
    AskPolicy {
        /// Which question.
        id: QuestionId,
        /// The plug-in's name, one of [`CoordinatorConfig::plugins`].
        plugin: String,
        /// What is asked.
        question: Question,
    },
    /// Keep something over this process's death: soon is enough, and several at once.
    Keep(Keep),
}

/// How a node stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NodeState {
    /// Heartbeats come.
    Alive,
    /// Silent or disconnected; gets no new work.
    Suspect,
    /// Finishing what it has, takes nothing new.
    Draining,
}

/// A device in [`FarmStatus`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeviceStatus {
    /// Index in its node.
    pub device: DeviceIndex,
    /// For people.
    pub name: String,
    /// How it computes.
    pub kind: DeviceKind,
    /// Announced score, GFLOP/s.
    pub score: f64,
    /// Attempts planned there and not yet executed.
    pub planned_jobs: u64,
    /// Running now, by the last heartbeat.
    pub running_jobs: u32,
    /// Executed so far.
    pub executed_jobs: u64,
    /// Device time of these, nanoseconds.
    pub device_time_ns: u64,
    /// Gone: it gets no jobs until its node starts anew.
    pub lost: bool,
}

/// A node in [`FarmStatus`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeStatus {
    /// The node.
    pub node: NodeId,
    /// For people.
    pub name: String,
    /// How it stands.
    pub state: NodeState,
    /// Its data addresses.
    pub addresses: Vec<String>,
    /// Its devices.
    pub devices: Vec<DeviceStatus>,
    /// Its cache, by the last heartbeat.
    pub cache: CacheFigures,
}

/// A large content (1 MiB and more) in the caches of nodes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ContentStatus {
    /// Which.
    pub content: Content,
    /// Where it is, by id.
    pub nodes: Vec<NodeId>,
}

/// The large contents in the caches of nodes.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ContentsStatus {
    /// The largest ones first.
    pub contents: Vec<ContentStatus>,
    /// How many more there are.
    pub omitted: u64,
}

/// An application in [`FarmStatus`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AppStatus {
    /// The application.
    pub app: AppId,
    /// For people.
    pub name: String,
    /// Its project.
    pub project: String,
    /// Fair-share weight that counts: what it asked for, or what its project's quota leaves of that.
    pub weight: f64,
    /// Whether its connection stands.
    pub connected: bool,
    /// Jobs asked for and not yet placed.
    pub waiting_jobs: u64,
    /// Jobs placed and not yet delivered.
    pub outstanding_jobs: u64,
    /// Jobs delivered.
    pub delivered_jobs: u64,
    /// Device time received, nanoseconds.
    pub device_time_ns: u64,
}

/// A project in [`FarmStatus`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProjectStatus {
    /// Its name.
    pub project: String,
    /// What it may have.
    pub quota: Quota,
    /// Its registered applications.
    pub apps: u64,
    /// Devices that its jobs are on.
    pub devices: u64,
    /// Its jobs that are planned and not delivered.
    pub queued_jobs: u64,
    /// Its jobs that wait at the coordinator.
    pub waiting_jobs: u64,
    /// Bytes of contents that count for it.
    pub bytes: u64,
    /// What its applications' weights come to.
    pub weight: f64,
}

/// Where a job is, as far as a coordinator knows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Whereabouts {
    /// Never asked for here, or over.
    Unknown,
    /// In line for a place.
    Waiting,
    /// Planned, or executed and not yet acknowledged.
    At {
        /// The node that answers for it.
        node: NodeId,
        /// The attempt there.
        attempt: Attempt,
    },
}

/// The farm as an operator sees it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FarmStatus {
    /// The coordinator's life.
    pub epoch: Epoch,
    /// Nodes by id.
    pub nodes: Vec<NodeStatus>,
    /// Applications by id.
    pub apps: Vec<AppStatus>,
    /// Projects by name.
    pub projects: Vec<ProjectStatus>,
    /// Jobs delivered since this start.
    pub delivered_jobs: u64,
    /// New attempts after a loss since this start.
    pub replanned_jobs: u64,
    /// Jobs moved between nodes by stealing since this start.
    pub stolen_jobs: u64,
    /// Second attempts beside running ones since this start.
    pub speculations: u64,
    /// Batches placed first come, first served since this start because a plug-in failed.
    pub policy_fallbacks: u64,
    /// Coordinators that would take over, in words. The driver knows them.
    pub standbys: Vec<String>,
}

/// The coordinator.
#[derive(Debug)]
pub struct CoordinatorMachine {
    config: CoordinatorConfig,
    /// Who is at the other end of a connection that said hello.
    links: BTreeMap<LinkId, Peer>,
    apps: BTreeMap<AppId, App>,
    nodes: BTreeMap<NodeId, Node>,
    /// A node's id goes with its name, over restarts too.
    names: BTreeMap<String, NodeId>,
    next_app: u32,
    next_node: u32,
    next_attempt: u64,
    modules: Modules,
    history: History,
    /// Jobs to be placed before the current event is done with, first come, first served.
    fresh: VecDeque<Pending>,
    /// Jobs that no device can take now, first come, first served; tried again when that may have changed.
    stuck: VecDeque<Pending>,
    /// With the jobs that wait because theirs has as much as it may.
    projects: Projects,
    /// Jobs that are held back until those before them have nearly ended: of the policy `neighbours`.
    reserved: BTreeMap<(AppId, BatchId), Pending>,
    /// Batches that a plug-in was asked about.
    questions: BTreeMap<QuestionId, Asked>,
    next_question: u64,
    plugin_faults: BTreeMap<String, PluginFaults>,
    /// Jobs that lost their place during the current event.
    lost: BTreeMap<(AppId, BatchId), Vec<JobKey>>,
    recovery: Recovery,
    /// What outlives this coordinator, beside its epoch.
    durable: Durable,
    /// Who has large contents, and who brings them where.
    spreads: Spreads,
    /// Retract orders without an answer; at most one for each thief.
    steals: BTreeMap<StealId, Steal>,
    next_steal: u64,
    steal_latency: StealLatency,
    /// Most nodes fell silent at once: until then none is given up for it.
    guarded_until: Option<Instant>,
    /// No later than the earliest deadline.
    wake: Option<Instant>,
    delivered_jobs: u64,
    replanned_jobs: u64,
    stolen_jobs: u64,
    policy_fallbacks: u64,
    /// Attempts beside those that the jobs' states name.
    backups: BTreeMap<JobId, Placement>,
    speculations: u64,
    timeline: Record,
    effects: VecDeque<Effect>,
}

impl CoordinatorMachine {
    /// A coordinator that knows nobody yet.
    #[must_use]
    pub fn new(mut config: CoordinatorConfig) -> Self {
        Self {
            projects: Projects::new(std::mem::take(&mut config.quotas)),
            config,
            links: BTreeMap::new(),
            apps: BTreeMap::new(),
            nodes: BTreeMap::new(),
            names: BTreeMap::new(),
            next_app: 1,
            next_node: 1,
            next_attempt: 1,
            modules: Modules::default(),
            history: History::default(),
            fresh: VecDeque::new(),
            stuck: VecDeque::new(),
            reserved: BTreeMap::new(),
            questions: BTreeMap::new(),
            next_question: 1,
            plugin_faults: BTreeMap::new(),
            lost: BTreeMap::new(),
            recovery: Recovery::default(),
            durable: Durable::default(),
            spreads: Spreads::default(),
            steals: BTreeMap::new(),
            next_steal: 1,
            steal_latency: StealLatency::default(),
            guarded_until: None,
            wake: None,
            delivered_jobs: 0,
            replanned_jobs: 0,
            stolen_jobs: 0,
            policy_fallbacks: 0,
            backups: BTreeMap::new(),
            speculations: 0,
            timeline: Record::default(),
            effects: VecDeque::new(),
        }
    }

    /// Takes one event in.
    pub fn handle(&mut self, now: Instant, event: Event) {
        self.begin_recovery(now);
        self.restore(now);
        let speaker = match event {
            Event::FromApp { link, message } => {
                self.app_said(now, link, message);
                None
            }
            Event::FromNode { link, message } => {
                self.node_said(now, link, message);
                self.links.get(&link).copied()
            }
            Event::LinkClosed { link } => {
                self.link_closed(now, link);
                None
            }
            Event::AppIntroduced { link, project } => {
                self.projects.introduce(link, project);
                None
            }
            Event::QuotaSet { project, quota } => {
                self.set_quota(&project, quota);
                None
            }
            Event::ProjectRemoved { project } => {
                self.remove_project(&project);
                None
            }
            Event::EvictRequested { node, contents } => {
                self.evict(node, &contents);
                None
            }
            Event::DrainRequested { node } => {
                self.drain(node);
                None
            }
            Event::PolicyAnswered { question, answer } => {
                self.policy_answered(now, question, answer);
                None
            }
        };
        self.place_pending(now);
        match speaker {
            Some(Peer::Node(node)) => self.consider_stealing(now, node),
            Some(Peer::App(_)) | None => {}
        }
    }

    /// Acts on the timers that are due.
    pub fn handle_timeout(&mut self, now: Instant) {
        if self.wake.is_none_or(|wake| wake > now) {
            return;
        }
        self.expire(now);
        self.place_pending(now);
        self.rearm();
    }

    /// Whether an application is registered.
    #[must_use]
    pub fn knows_app(&self, app: AppId) -> bool {
        self.apps.contains_key(&app)
    }

    /// When [`Self::handle_timeout`] wants to be called next.
    #[must_use]
    pub const fn poll_timeout(&self) -> Option<Instant> {
        self.wake
    }

    /// The next thing to do; call until `None` after every `handle` and `handle_timeout`.
    pub fn poll_effect(&mut self) -> Option<Effect> {
        self.effects.pop_front()
    }

    fn app_said(&mut self, now: Instant, link: LinkId, message: AppToCoordinator) {
        let (app, message) = match (self.links.get(&link), message) {
            (None, AppToCoordinator::Hello(hello)) => return self.app_hello(now, link, hello),
            (Some(Peer::App(app)), message) => (*app, message),
            (None | Some(Peer::Node(_)), _) => return self.protocol_error(now, link),
        };
        if let AppToCoordinator::Heartbeat { unanswered, .. } = message {
            self.app_hears(app, !unanswered);
        }
        self.app_heard(now, app);
        match message {
            AppToCoordinator::Hello(_) => self.protocol_error(now, link),
            AppToCoordinator::Plan(request) => self.plan_requested(now, app, request),
            AppToCoordinator::AlreadyDelivered(jobs) => self.already_delivered(app, &jobs),
            AppToCoordinator::Unreachable { node, session } => self.unreachable(now, app, node, session),
            AppToCoordinator::Cancel(task) => self.cancel_task(app, task),
            AppToCoordinator::Supersede(predecessor) => self.supersede(now, app, predecessor),
            AppToCoordinator::Heartbeat { sequence, unanswered: _ } => {
                self.tell_app(app, CoordinatorToApp::HeartbeatAck { sequence });
            }
            AppToCoordinator::Goodbye => {
                self.close(link);
                self.app_leaves(app);
            }
        }
    }

    fn node_said(&mut self, now: Instant, link: LinkId, message: NodeToCoordinator) {
        let (node, message) = match (self.links.get(&link), message) {
            (None, NodeToCoordinator::Hello(hello)) => return self.node_hello(now, link, hello),
            (Some(Peer::Node(node)), message) => (*node, message),
            (None | Some(Peer::App(_)), _) => return self.protocol_error(now, link),
        };
        if let NodeToCoordinator::Heartbeat { unanswered, .. } = message {
            self.node_hears(node, !unanswered);
        }
        self.node_heard(now, node);
        match message {
            NodeToCoordinator::Hello(_) => self.protocol_error(now, link),
            NodeToCoordinator::Heartbeat { sequence, unanswered: _, devices, spool_bytes: _, cache } => {
                self.loads_reported(node, &devices, cache);
                self.consider_speculating(now, node);
                self.tell_node(node, CoordinatorToNode::HeartbeatAck { sequence });
            }
            NodeToCoordinator::Report { sent_at, executed, delivered } => {
                self.timeline.report_came(now, node, sent_at);
                self.reported(now, node, executed, &delivered)
            }
            NodeToCoordinator::DeviceLost { device, reason } => self.device_lost(now, node, device, &reason),
            NodeToCoordinator::Retracted { steal, retracted, running, unknown } => {
                tracing::debug!(%steal, %node, kept = running.len(), unknown = unknown.len(), "retracted");
                self.retracted(now, node, steal, &retracted);
            }
            NodeToCoordinator::Locate(content) => self.locate(now, node, content),
            NodeToCoordinator::CacheChanged { held, gone } => self.cache_changed(now, node, &held, &gone),
            NodeToCoordinator::Holding(held) => self.holding(node, held),
            NodeToCoordinator::Inventory(held) => self.inventory(now, node, &held),
            NodeToCoordinator::Goodbye => {
                self.close(link);
                self.node_leaves(now, node);
            }
        }
    }

    fn tell_app(&mut self, app: AppId, message: CoordinatorToApp) {
        if let Some(link) = self.apps.get(&app).and_then(|app| app.link) {
            self.effects.push_back(Effect::ToApp { link, message });
        }
    }

    fn tell_node(&mut self, node: NodeId, message: CoordinatorToNode) {
        if let Some(link) = self.nodes.get(&node).and_then(|node| node.link) {
            self.effects.push_back(Effect::ToNode { link, message });
        }
    }

    /// Forgets a connection and closes it; its `LinkClosed` will find nobody.
    fn close(&mut self, link: LinkId) {
        self.links.remove(&link);
        self.effects.push_back(Effect::Close { link });
    }

    /// Makes sure that the timers are looked at no later than `at`.
    fn arm(&mut self, at: Instant) {
        self.wake = Some(self.wake.map_or(at, |wake| wake.min(at)));
    }
}
