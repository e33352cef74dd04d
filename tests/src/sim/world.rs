//! Virtual time and the event loop: what happens when, to which process.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use farm_core::{
    coordinator::{
        self, CoordinatorConfig, CoordinatorMachine,
        policy::{Choice, QuestionId},
    },
    id::{DeviceIndex, Epoch, LinkId, NodeId, NodeSession},
    ledger, message,
    time::Instant,
    worker,
};
use rand::{Rng, SeedableRng, rngs::SmallRng};

use super::{
    auditor::Auditor,
    clock::Clock,
    diary::Diary,
    faults::Fault,
    hosts::{AppHost, Store, WorkerHost},
    log::Log,
    lookout::Lookout,
    network::{Distances, Duplicates, Link, Message, Proc},
    work::Work,
};

/// Timers that fire this often at one instant do not get anywhere.
const MAX_TIMER_ROUNDS: u32 = 1_000;

/// Most that a clock is too fast or too slow, in parts per million: 10 %.
const MAX_SKEW_PPM: u32 = 100_000;

const TRUE_RATE_PPM: u32 = 1_000_000;

/// Longest virtual time from the last fault to the last result (I12): unreachable pairs are believed for 60 s.
pub const RECOVERY: Duration = Duration::from_secs(120);

/// Longest virtual time from the last goodbye until nothing is kept (I8): a node that heard no goodbye waits 30 s for
/// an announcement.
pub const QUIET: Duration = Duration::from_secs(40);

/// How long a vanished application keeps its jobs in a run of seconds, in milliseconds: three times what a silent node
/// gets, as in the design.
const SHORT_APP_LEASE_MS: u64 = 3_000;

/// Virtual time of a millisecond, in nanoseconds.
pub const MILLISECOND: u64 = 1_000_000;

/// What happens at an instant.
#[derive(Clone, Debug)]
pub enum Happening {
    /// A message arrives at one end.
    Arrives {
        /// On which connection.
        link: LinkId,
        /// At whom.
        to: Proc,
        /// What.
        message: Message,
    },
    /// The dialler learns that its connection stands.
    Opened {
        /// Which.
        link: LinkId,
    },
    /// The last word of an end that closed has arrived.
    HungUp {
        /// On which connection.
        link: LinkId,
    },
    /// One end learns that the connection is gone.
    Closed {
        /// Which.
        link: LinkId,
        /// Who learns it.
        to: Proc,
        /// In which life.
        life: u32,
    },
    /// An application learns that it has no connection to a node.
    NotOpened {
        /// The application.
        app: usize,
        /// In which life.
        life: u32,
        /// The node.
        node: NodeId,
        /// In which life.
        session: NodeSession,
    },
    /// An application's call of a node is repeated if it has not been answered.
    CallAgain {
        /// The application.
        app: usize,
        /// In which life.
        life: u32,
        /// The node.
        node: NodeId,
        /// In which life.
        session: NodeSession,
        /// The worker that it is.
        worker: usize,
    },
    /// A process dials the coordinator.
    Dial {
        /// Who.
        proc: Proc,
        /// In which life.
        life: u32,
    },
    /// Something inside a worker's process.
    Worker {
        /// Which.
        worker: usize,
        /// In which life.
        life: u32,
        /// What.
        event: worker::Event,
    },
    /// A device's running job is done.
    JobDone {
        /// Whose device.
        worker: usize,
        /// In which life.
        life: u32,
        /// Which device.
        device: DeviceIndex,
        /// Which of the worker's runs.
        run: u64,
    },
    /// An application submits, cancels.
    App {
        /// Which.
        app: usize,
        /// What.
        event: ledger::Event,
    },
    /// A plug-in answers the coordinator.
    PluginAnswers {
        /// Epoch of the coordinator that asked.
        epoch: u32,
        /// What it asked.
        question: QuestionId,
        /// The choices, or why there are none.
        answer: Result<Vec<Choice>, String>,
    },
    /// Something goes wrong.
    Fault(Fault),
}

impl Happening {
    /// Whether somebody is about to learn something from somebody else.
    const fn is_news(&self) -> bool {
        match self {
            Self::Arrives { .. }
            | Self::Opened { .. }
            | Self::HungUp { .. }
            | Self::Closed { .. }
            | Self::NotOpened { .. }
            | Self::Dial { .. } => true,
            Self::CallAgain { .. }
            | Self::Worker { .. }
            | Self::JobDone { .. }
            | Self::App { .. }
            | Self::PluginAnswers { .. }
            | Self::Fault(_) => false,
        }
    }
}

/// How a farm is built.
#[derive(Clone, Debug)]
pub struct Setup {
    /// Of everything that is drawn.
    pub seed: u64,
    /// Devices of each worker: speeds.
    pub workers: Vec<Vec<f64>>,
    /// Applications; the weight of each is its index plus one.
    pub apps: usize,
    /// Attempts that may end with their device or node before the job is poison.
    pub max_crashes: u32,
    /// Most jobs on one worker.
    pub max_jobs: usize,
    /// Most bytes of one application's results that wait on one worker, before it gets no device there.
    pub spool_quota_bytes: u64,
    /// Who is silent for how long is what.
    pub liveness: message::Liveness,
    /// How long a vanished application keeps its jobs, in milliseconds.
    pub app_lease_ms: u64,
    /// The applications allow it.
    pub global_stealing: bool,
    /// Every other application's jobs are interactive.
    pub interactive: bool,
    /// Applications belong to projects, whose quotas keep devices idle.
    pub projects: bool,
    /// What the applications choose; a plug-in answers well, wrongly, late or never.
    pub policy: &'static str,
    /// Announced scores are wrong by up to this factor, either way.
    pub score_error: f64,
    /// Each process has a clock of its own.
    pub skewed_clocks: bool,
    /// How far apart processes are.
    pub distances: Distances,
}

impl Setup {
    /// A farm without trouble.
    #[must_use]
    pub fn calm(seed: u64, workers: Vec<Vec<f64>>, apps: usize) -> Self {
        Self {
            seed,
            workers,
            apps,
            max_crashes: 3,
            max_jobs: 10_000,
            spool_quota_bytes: 1 << 30,
            liveness: short_liveness(),
            app_lease_ms: SHORT_APP_LEASE_MS,
            global_stealing: false,
            interactive: false,
            projects: false,
            policy: "",
            score_error: 1.0,
            skewed_clocks: false,
            distances: Distances::Lan,
        }
    }

    /// A farm without trouble that waits as long as the design says.
    #[must_use]
    pub fn designed(seed: u64, workers: Vec<Vec<f64>>, apps: usize) -> Self {
        let design = CoordinatorConfig::new(Epoch(1), seed);
        Self {
            liveness: design.liveness,
            app_lease_ms: design.app_lease_ms,
            ..Self::calm(seed, workers, apps)
        }
    }
}

/// The farm.
#[derive(Debug)]
pub struct World {
    /// The world's time.
    pub now: Instant,
    /// Of everything that is drawn while the farm runs.
    pub rng: SmallRng,
    /// The coordinator's machine; while the process is down, that of its last life.
    pub coordinator: CoordinatorMachine,
    /// The workers' processes.
    pub workers: Vec<WorkerHost>,
    /// The applications' processes.
    pub apps: Vec<AppHost>,
    /// What jobs do.
    pub work: Work,
    /// Judges everything.
    pub audit: Auditor,
    /// What happened when.
    pub diary: Diary,
    pub(super) lookout: Lookout,
    /// Everything that any machine wanted.
    pub log: Log,
    /// Application and worker that cannot reach each other, and are told so.
    pub(super) cuts: BTreeSet<(usize, usize)>,
    /// From whom to whom nothing gets through, and nobody is told.
    pub(super) blocked: BTreeSet<(Proc, Proc)>,
    pub(super) duplicates: Duplicates,
    /// One in this many of the messages that comparisons make up for is lost; none if zero.
    pub(super) lost_one_in: u32,
    pub(super) distances: Distances,
    pub(super) setup: Setup,
    pub(super) store: Store,
    pub(super) coordinator_up: bool,
    pub(super) coordinator_clock: Clock,
    pub(super) links: BTreeMap<LinkId, Link>,
    pub(super) next_link: u64,
    queue: BTreeMap<(Instant, u64), Happening>,
    next_happening: u64,
    /// Queued happenings that are news.
    in_flight: u32,
    /// When each process's machine wants to be woken, in the world's time.
    timers: BTreeSet<(Instant, Proc)>,
    armed: BTreeMap<Proc, Instant>,
    timer_rounds: u32,
}

/// A tenth of what the design has, so that a run of seconds sees each silence.
const fn short_liveness() -> message::Liveness {
    message::Liveness {
        heartbeat_ms: 100,
        suspect_ms: 300,
        dead_ms: 1_000,
        reconnect_ms: 400,
        compare_ms: 500,
    }
}

impl World {
    /// A farm that is about to start.
    #[must_use]
    pub fn new(setup: Setup) -> Self {
        let store = Store::new();
        let mut world = Self {
            now: Instant::ZERO,
            rng: SmallRng::seed_from_u64(setup.seed),
            coordinator: store.coordinator(Instant::ZERO, setup.seed, &setup),
            workers: Vec::new(),
            apps: Vec::new(),
            work: Work::default(),
            audit: Auditor::default(),
            diary: Diary::default(),
            lookout: Lookout::default(),
            log: Log::new(),
            cuts: BTreeSet::new(),
            blocked: BTreeSet::new(),
            duplicates: Duplicates::Never,
            lost_one_in: 0,
            distances: setup.distances,
            store,
            coordinator_up: true,
            coordinator_clock: Clock::TRUE,
            links: BTreeMap::new(),
            next_link: 1,
            queue: BTreeMap::new(),
            next_happening: 0,
            in_flight: 0,
            timers: BTreeSet::new(),
            armed: BTreeMap::new(),
            timer_rounds: 0,
            setup,
        };
        world.coordinator_clock = world.new_clock();
        for speeds in world.setup.workers.clone() {
            world.add_worker(&speeds);
        }
        for _ in 0..world.setup.apps {
            world.add_app();
        }
        world
    }

    /// One more application starts. Gives its index.
    pub fn add_app(&mut self) -> usize {
        let app = self.apps.len();
        let clock = self.new_clock();
        self.apps.push(AppHost::new(app, &self.setup, clock));
        self.after(Duration::ZERO, Happening::Dial { proc: Proc::App(app), life: 0 });
        app
    }

    /// One more worker starts.
    pub fn add_worker(&mut self, speeds: &[f64]) {
        let index = self.workers.len();
        let seed = self.rng.random();
        let bound = self.setup.score_error;
        let errors = if bound > 1.0 {
            speeds.iter().map(|_| bound.powf(self.rng.random_range(-1.0..=1.0))).collect()
        } else {
            vec![1.0; speeds.len()]
        };
        let clock = self.new_clock();
        let mut host = WorkerHost::new(index, speeds, errors, &self.setup);
        host.start(self.now, seed, clock);
        self.workers.push(host);
        self.after(Duration::ZERO, Happening::Dial { proc: Proc::Worker(index), life: 0 });
    }

    /// Lets something happen after a while.
    pub fn after(&mut self, delay: Duration, happening: Happening) {
        self.at(self.now.after(delay), happening);
    }

    /// Lets something happen at a time, or now if that is over.
    pub fn at(&mut self, at: Instant, happening: Happening) {
        self.in_flight += u32::from(happening.is_news());
        self.queue.insert((at.max(self.now), self.next_happening), happening);
        self.next_happening += 1;
    }

    /// Lets things happen until `done` says so.
    ///
    /// # Panics
    /// It has not by `deadline` (I12), or an invariant is broken.
    pub fn run_until(&mut self, deadline: Instant, done: impl Fn(&Self) -> bool) {
        while !done(self) {
            assert!(self.now <= deadline, "I12: not done by {deadline}: {}", self.describe());
            self.step();
        }
    }

    /// Lets things happen for a while.
    ///
    /// # Panics
    /// An invariant is broken.
    pub fn run_for(&mut self, duration: Duration) {
        let end = self.now.after(duration);
        while self.next_instant().is_some_and(|next| next <= end) {
            self.step();
        }
        self.advance(end);
    }

    /// The liveness mode: no fault follows, every application gets to its end and says goodbye, and nothing is kept.
    ///
    /// # Panics
    /// A job does not end (I12), something is kept (I8), or another invariant is broken.
    pub fn finish(&mut self) {
        let deadline = self.now.after(RECOVERY);
        self.run_until(deadline, |world| world.apps.iter().all(AppHost::is_done));
        for app in 0..self.apps.len() {
            if self.apps[app].is_up() {
                self.app_event(app, ledger::Event::Finished);
            }
        }
        let quiet = self.now.after(QUIET);
        while !self.is_empty() && self.next_instant().is_some_and(|next| next <= quiet) {
            self.step();
        }
        self.assert_empty();
    }

    /// Whether any message is on its way, or anybody about to learn of a connection.
    #[must_use]
    pub const fn is_quiet(&self) -> bool {
        self.in_flight == 0
    }

    fn is_empty(&self) -> bool {
        self.coordinator.status().apps.is_empty()
            && self.workers.iter().filter(|host| host.is_up()).all(|host| host.kept() == 0)
            && self.apps.iter().all(|host| host.kept() == 0)
    }

    /// I8: at quiescence nothing is kept.
    fn assert_empty(&self) {
        let apps = self.coordinator.status().apps;
        assert!(apps.is_empty(), "I8: applications are kept: {}", self.describe());
        self.workers.iter().filter(|host| host.is_up()).for_each(WorkerHost::assert_empty);
        self.apps.iter().for_each(AppHost::assert_empty);
    }

    /// The earliest thing happens: a queued one before a timer of the same instant.
    fn step(&mut self) {
        let timer = self.timers.first().copied();
        let queued = self.queue.first_key_value().map(|((at, _), _)| *at);
        match (queued, timer) {
            (None, None) => panic!("I12: nothing will ever happen again: {}", self.describe()),
            (Some(at), timer) if timer.is_none_or(|(due, _)| at <= due) => {
                let Some((_, happening)) = self.queue.pop_first() else { return };
                // It is still on its way when the world is looked at.
                self.advance(at);
                self.in_flight -= u32::from(happening.is_news());
                self.happen(happening);
            }
            (_, Some((due, proc))) => {
                self.advance(due.max(self.now));
                self.timer_rounds += 1;
                assert!(
                    self.timer_rounds < MAX_TIMER_ROUNDS,
                    "{proc:?} spins on its timer: {}",
                    self.describe()
                );
                self.fire(proc);
            }
            (Some(_), None) => {}
        }
    }

    fn next_instant(&self) -> Option<Instant> {
        let queued = self.queue.first_key_value().map(|((at, _), _)| *at);
        queued.into_iter().chain(self.timers.first().map(|(due, _)| *due)).min()
    }

    fn advance(&mut self, to: Instant) {
        if to > self.now {
            self.timer_rounds = 0;
            self.look_around(to);
        }
        self.now = to;
    }

    /// A machine may want to be woken at another time than before.
    pub(super) fn rearm(&mut self, proc: Proc) {
        let due = match proc {
            Proc::Coordinator if !self.coordinator_up => None,
            Proc::Coordinator => {
                self.coordinator.poll_timeout().map(|due| self.coordinator_clock.reaches(due))
            }
            Proc::Worker(index) => self.workers[index].timeout(),
            Proc::App(index) => self.apps[index].timeout(),
        };
        let before = match due {
            Some(due) => self.armed.insert(proc, due),
            None => self.armed.remove(&proc),
        };
        if before == due {
            return;
        }
        if let Some(before) = before {
            self.timers.remove(&(before, proc));
        }
        if let Some(due) = due {
            self.timers.insert((due, proc));
        }
    }

    fn fire(&mut self, proc: Proc) {
        match proc {
            Proc::Coordinator => {
                self.coordinator.handle_timeout(self.coordinator_clock.shows(self.now));
                self.coordinator_settles();
            }
            Proc::Worker(index) => self.worker_timeout(index),
            Proc::App(index) => self.app_timeout(index),
        }
    }

    fn happen(&mut self, happening: Happening) {
        match happening {
            Happening::Arrives { link, to, message } => self.arrives(link, to, message),
            Happening::Opened { link } => self.opened(link),
            Happening::HungUp { link } => self.drop_link(link),
            Happening::Closed { link, to, life } => self.told_closed(link, to, life),
            Happening::NotOpened { app, life, node, session } => {
                if self.apps[app].life == life {
                    self.apps[app].dialling.remove(&(node, session));
                    self.app_event(app, ledger::Event::NodeLost { node, session });
                }
            }
            Happening::CallAgain { app, life, node, session, worker } => {
                self.call_again(app, life, node, session, worker);
            }
            Happening::Dial { proc, life } => self.dial_coordinator(proc, life),
            Happening::Worker { worker, life, event } => {
                if self.workers[worker].runs(life) {
                    self.worker_event(worker, event);
                }
            }
            Happening::JobDone { worker, life, device, run } => {
                if self.workers[worker].runs(life) {
                    self.job_done(worker, device, run);
                }
            }
            Happening::App { app, event } => self.app_event(app, event),
            Happening::PluginAnswers { epoch, question, answer } => {
                if self.store.epoch == epoch {
                    self.audit.checks.plugin_answers += u64::from(answer.is_ok());
                    self.coordinator_event(coordinator::Event::PolicyAnswered { question, answer });
                }
            }
            Happening::Fault(fault) => self.fault(fault),
        }
    }

    /// A clock for a process that starts now.
    pub(super) fn new_clock(&mut self) -> Clock {
        if !self.setup.skewed_clocks {
            return Clock::TRUE;
        }
        let rate_ppm = self.rng.random_range(TRUE_RATE_PPM - MAX_SKEW_PPM..=TRUE_RATE_PPM + MAX_SKEW_PPM);
        Clock::started(self.now, rate_ppm)
    }

    /// Where everything stands, for people.
    #[must_use]
    pub fn describe(&self) -> String {
        let ledgers: Vec<_> = self.apps.iter().map(|host| host.ledger.counts()).collect();
        format!("at {}: {ledgers:#?}\n{:#?}", self.now, self.coordinator.status())
    }
}
