//! A worker node's state machine: per-application queues, the feedback lottery, device queues of one running and
//! one staged job, local stealing, the result spool's book-keeping.
//!
//! It never sees payloads: its driver keeps programs, contents and results by [`JobAttempt`] and [`ContentHash`].
//!
//! Split by event family: `session` (coordinator), `app` (applications and their links), `intake` (jobs that arrive or
//! leave early), `retract` (jobs that another node takes over), `content`, `device` (completion, loss), `staging` (who
//! is next on which device, stealing between them) with `rate`, `share` (with its rules `lottery` and `stride`), `spool`
//! (results until acknowledged), `report`, `drain`, `standing` (what auditors see). `job` holds the records they share.

mod app;
mod content;
mod device;
mod drain;
mod intake;
mod invariants;
mod inventory;
mod job;
mod lottery;
mod rate;
mod report;
mod retract;
mod session;
mod share;
mod spool;
mod staging;
mod standing;
mod stride;

use std::collections::{BTreeMap, VecDeque};

use rand::{SeedableRng, rngs::SmallRng};

pub use self::share::Share;
pub use self::standing::Standing;
use self::{
    app::{App, Project},
    content::{Holding, large},
    device::Device,
    drain::Drain,
    job::{HeldJob, Tombstones},
    report::Reports,
    session::Session,
    share::{FairShare, Lags},
};
use crate::{
    device::DeviceInfo,
    id::{AppId, ContentHash, DeviceIndex, JobAttempt, JobId, LinkId, NodeId, NodeSession},
    message::{
        AppToNode, CacheFigures, Contact, CoordinatorToNode, JobFailure, LatencyClass, NodeToApp,
        NodeToCoordinator,
    },
    program::Content,
    time::Instant,
};

/// Settings of a worker.
#[derive(Clone, Debug)]
pub struct WorkerConfig {
    /// For people, and the node's identity over restarts.
    pub name: String,
    /// This life of the process.
    pub session: NodeSession,
    /// The devices, by [`DeviceIndex`].
    pub devices: Vec<DeviceInfo>,
    /// The data plane.
    pub contact: Contact,
    /// Most jobs held, executed and unacknowledged ones too; further ones are given back (`JobFailure::Returned`).
    pub max_jobs: usize,
    /// An application that has left this many bytes of results unacknowledged gets no further job staged until it takes some:
    /// the jobs on devices then end, and nothing more is made for it here.
    pub spool_quota_bytes: u64,
    /// Whether an idle device takes jobs of its siblings. On, but where its gain is measured.
    pub local_stealing: bool,
    /// How devices are shared between applications.
    pub share: Share,
    /// Contents that the cache holds from the start.
    pub cached: Vec<Content>,
    /// Seed of the machine's one generator.
    pub seed: u64,
}

/// What happens to a worker.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The driver has a connection to the coordinator: say hello on it.
    CoordinatorConnected,
    /// The coordinator said something.
    FromCoordinator(CoordinatorToNode),
    /// The connection to the coordinator is gone; the driver will try again.
    CoordinatorLost,
    /// An application said something.
    FromApp {
        /// On which connection.
        link: LinkId,
        /// What.
        message: AppToNode,
    },
    /// An application's connection is gone.
    AppLinkClosed {
        /// Which.
        link: LinkId,
    },
    /// A content asked for by [`Effect::Fetch`] is in the node's cache (and stays while a queued job names it).
    ContentReady(ContentHash),
    /// The cache does not have these contents any more.
    ContentsEvicted(Vec<ContentHash>),
    /// The cache's figures changed.
    CacheCounted(CacheFigures),
    /// A content could not be had.
    ContentFailed {
        /// Which.
        content: ContentHash,
        /// Why, for people.
        reason: String,
    },
    /// The staged job began to run.
    Started {
        /// Which.
        job: JobAttempt,
        /// Where.
        device: DeviceIndex,
    },
    /// The running job was interrupted at a launch boundary, for one of a higher class; it keeps its device state.
    Yielded {
        /// Which.
        job: JobAttempt,
        /// Where.
        device: DeviceIndex,
    },
    /// An interrupted job goes on.
    Resumed {
        /// Which.
        job: JobAttempt,
        /// Where.
        device: DeviceIndex,
    },
    /// An executor is done with a job. The driver holds the payload until [`Effect::Discard`].
    Executed {
        /// Which.
        job: JobAttempt,
        /// Where.
        device: DeviceIndex,
        /// Measured device time in nanoseconds.
        device_time_ns: u64,
        /// `Ok`: lengths of the payload's sections and the payload's digest.
        outcome: Result<(Vec<u64>, ContentHash), JobFailure>,
    },
    /// The driver has no room for further results, or has again: while it has none, an application gets a further job only
    /// if it has left no result unacknowledged.
    SpoolFull(bool),
    /// The driver has lost the payload of an attempt that was executed.
    ResultLost(JobAttempt),
    /// A device is gone for good.
    DeviceLost {
        /// Which.
        device: DeviceIndex,
        /// Why, for people.
        reason: String,
    },
    /// The process was asked to end (SIGTERM): drain.
    DrainRequested,
}

/// What a worker wants done.
#[derive(Clone, Debug, PartialEq)]
pub enum Effect {
    /// Say something to the coordinator.
    ToCoordinator(NodeToCoordinator),
    /// Say something to an application. A result's payload is the driver's, by the header's job.
    ToApp {
        /// On which connection.
        link: LinkId,
        /// What.
        message: NodeToApp,
    },
    /// Close an application's connection after what was said on it.
    CloseApp {
        /// Which.
        link: LinkId,
    },
    /// Bring a content into the node's cache; answer with `ContentReady` (at once if it is there) or `ContentFailed`.
    Fetch {
        /// Which.
        content: Content,
        /// Who has it.
        from: Provider,
    },
    /// Hand a job to a device's executor, which holds at most one running and one staged job, and an interactive one
    /// in addition: that takes the device at the running one's next launch boundary.
    Execute {
        /// Which.
        job: JobAttempt,
        /// Where.
        device: DeviceIndex,
        /// When it may take the device.
        class: LatencyClass,
    },
    /// Take a staged or running job back: it need not finish, and `Executed` with `Cancelled` may follow. Its place
    /// counts as free at once, so the next `Execute` may come while the executor still winds the aborted job up.
    Abort {
        /// Which.
        job: JobAttempt,
        /// Where.
        device: DeviceIndex,
    },
    /// Forget the program and the payload of an attempt.
    Discard(JobAttempt),
    /// No queued job names this content any more; the cache may evict it.
    Release(ContentHash),
    /// Drop these contents from the cache where they are not pinned, all such if none is named; answer with
    /// `ContentsEvicted`.
    Evict(Vec<ContentHash>),
    /// Drained, goodbye said: the process may end.
    Exit,
}

/// Who has a content.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Provider {
    /// The application at the other end of this connection.
    Application(LinkId),
    /// Another node.
    Node(Contact),
}

/// A worker node.
#[derive(Debug)]
pub struct WorkerMachine {
    config: WorkerConfig,
    session: Session,
    node: Option<NodeId>,
    heartbeat_sequence: u64,
    /// With the first heartbeat from then on the coordinator is told what is held.
    compare_at: Instant,
    drain: Drain,
    apps: BTreeMap<AppId, App>,
    /// Projects of the announced ones, by name.
    projects: BTreeMap<String, Project>,
    links: BTreeMap<LinkId, AppId>,
    /// One attempt of each job at most: a larger one replaces a smaller one.
    jobs: BTreeMap<JobId, HeldJob>,
    tombstones: Tombstones,
    /// Order of arrival, for first come, first served.
    next_arrival: u64,
    contents: BTreeMap<ContentHash, Holding>,
    /// When contents that failed to come are asked for again.
    refetch_at: Option<Instant>,
    /// When the first of the contents whose whereabouts were asked for is fetched from its application without an answer.
    located_by: Option<Instant>,
    /// Large contents in the cache, with their sizes in bytes.
    cached: BTreeMap<ContentHash, u64>,
    /// As the driver counted last.
    cache: CacheFigures,
    devices: Vec<Device>,
    lags: Lags,
    share: Box<dyn FairShare>,
    rng: SmallRng,
    reports: Reports,
    /// Results executed and not acknowledged, in bytes.
    spool_bytes: u64,
    /// The driver has no room for more of them.
    spool_full: bool,
    effects: VecDeque<Effect>,
}

impl WorkerMachine {
    /// A worker that is not registered yet.
    #[must_use]
    pub fn new(config: WorkerConfig) -> Self {
        let devices = config.devices.iter().cloned().map(Device::new).collect();
        let share = config.share.rule();
        let rng = SmallRng::seed_from_u64(config.seed);
        let cached = large(&config.cached);
        Self {
            config,
            session: Session::Offline,
            node: None,
            heartbeat_sequence: 0,
            compare_at: Instant::ZERO,
            drain: Drain::No,
            apps: BTreeMap::new(),
            projects: BTreeMap::new(),
            links: BTreeMap::new(),
            jobs: BTreeMap::new(),
            tombstones: Tombstones::default(),
            next_arrival: 0,
            contents: BTreeMap::new(),
            refetch_at: None,
            located_by: None,
            cached,
            cache: CacheFigures::default(),
            devices,
            lags: Lags::default(),
            share,
            rng,
            reports: Reports::default(),
            spool_bytes: 0,
            spool_full: false,
            effects: VecDeque::new(),
        }
    }

    /// Takes one event in.
    pub fn handle(&mut self, now: Instant, event: Event) {
        if self.drain == Drain::Gone {
            return;
        }
        match event {
            Event::CoordinatorConnected => self.coordinator_connected(),
            Event::FromCoordinator(message) => self.coordinator_said(now, message),
            Event::CoordinatorLost => self.coordinator_lost(),
            Event::FromApp { link, message } => self.app_said(now, link, message),
            Event::AppLinkClosed { link } => self.app_link_closed(now, link),
            Event::ContentReady(content) => self.content_ready(content),
            Event::ContentsEvicted(contents) => self.contents_evicted(contents),
            Event::CacheCounted(figures) => self.cache = figures,
            Event::ContentFailed { content, reason } => self.content_failed(now, content, &reason),
            Event::Started { job, device } | Event::Resumed { job, device } => self.started(now, job, device),
            Event::Yielded { job, device } => self.yielded(now, job, device),
            Event::Executed { job, device, device_time_ns, outcome } => {
                self.executed(now, job, device, device_time_ns, outcome);
            }
            Event::SpoolFull(full) => self.spool_filled(full),
            Event::ResultLost(job) => self.result_lost(now, job),
            Event::DeviceLost { device, reason } => self.device_lost(now, device, &reason),
            Event::DrainRequested => self.start_drain(now),
        }
        self.settle(now);
    }

    /// Acts on the timers that are due.
    pub fn handle_timeout(&mut self, now: Instant) {
        if self.drain == Drain::Gone {
            return;
        }
        self.session_timeout(now);
        self.app_timeout(now);
        self.content_timeout(now);
        self.settle(now);
    }

    /// When [`Self::handle_timeout`] wants to be called next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        if self.drain == Drain::Gone {
            return None;
        }
        let registered = self.session.next_heartbeat();
        let reports = registered.and_then(|_| self.reports.due());
        let apps = self.apps.values().filter_map(|app| app.drop_at).min();
        let contents = [self.refetch_at, self.located_by];
        [registered, reports, self.drain.deadline(), apps].into_iter().chain(contents).flatten().min()
    }

    /// The next thing to do; call until `None` after every `handle` and `handle_timeout`.
    pub fn poll_effect(&mut self) -> Option<Effect> {
        self.effects.pop_front()
    }

    /// The node's id, once registered.
    #[must_use]
    pub const fn node(&self) -> Option<NodeId> {
        self.node
    }

    /// What follows from any event: devices get work, reports leave, a drained node goes.
    fn settle(&mut self, now: Instant) {
        self.fill_devices(now);
        self.flush_reports(now);
        self.advance_drain(now);
    }

    fn push(&mut self, effect: Effect) {
        self.effects.push_back(effect);
    }

    fn tell_coordinator(&mut self, message: NodeToCoordinator) {
        self.push(Effect::ToCoordinator(message));
    }
}
