//! Virtual time, the in-memory network, and the event loop. Messages keep their order on a connection and lose it
//! between connections; connections break loudly (both ends are told) or fall silent first.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Debug,
    time::Duration,
};

use farm_core::{
    coordinator::{self, CoordinatorConfig, CoordinatorMachine},
    id::{Epoch, LinkId, NodeId, NodeSession},
    ledger, message,
    message::{
        AppToCoordinator, AppToNode, CoordinatorToApp, CoordinatorToNode, NodeToApp, NodeToCoordinator,
    },
    time::Instant,
    worker,
};
use rand::{Rng, SeedableRng, rngs::SmallRng};

use crate::{
    faults::Fault,
    hosts::{AppHost, Work, WorkerHost},
};

/// Timers that fire this often at one instant do not get anywhere.
const MAX_TIMER_ROUNDS: u32 = 1_000;

/// Pause of a driver before it dials the coordinator again.
const REDIAL: Duration = Duration::from_millis(50);

/// A process of the farm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Proc {
    Coordinator,
    Worker(usize),
    App(usize),
}

/// What a connection carries.
#[derive(Clone, Debug)]
pub(crate) enum Message {
    AppToCoordinator(AppToCoordinator),
    CoordinatorToApp(CoordinatorToApp),
    NodeToCoordinator(NodeToCoordinator),
    CoordinatorToNode(CoordinatorToNode),
    AppToNode(AppToNode),
    NodeToApp(NodeToApp),
}

/// What happens at an instant.
#[derive(Clone, Debug)]
pub(crate) enum Happening {
    /// A message arrives at one end.
    Arrives { link: LinkId, to: Proc, message: Message },
    /// The dialler learns that its connection stands.
    Opened { link: LinkId },
    /// One end learns that the connection is gone.
    Closed { link: LinkId, to: Proc, life: u32 },
    /// An application learns that a node could not be dialled.
    NotOpened { app: usize, node: NodeId, session: NodeSession },
    /// A process dials the coordinator.
    Dial { proc: Proc, life: u32 },
    /// Something inside a worker's process.
    Worker { worker: usize, life: u32, event: worker::Event },
    /// A device's running job is done.
    JobDone { worker: usize, life: u32, device: usize, run: u64 },
    /// An application submits, cancels.
    App { app: usize, event: ledger::Event },
    /// Something goes wrong.
    Fault(Fault),
}

/// A connection.
#[derive(Debug)]
struct Link {
    dialler: Proc,
    listener: Proc,
    /// What the dialler calls it: `None` for the coordinator.
    life: Option<(NodeId, NodeSession)>,
    /// Messages vanish.
    silent: bool,
    /// Last arrival at the dialler and at the listener.
    last_arrival: [Instant; 2],
}

/// How a farm is built.
#[derive(Clone, Debug)]
pub(crate) struct Setup {
    pub(crate) seed: u64,
    /// Devices of each worker: speeds.
    pub(crate) workers: Vec<Vec<f64>>,
    pub(crate) apps: usize,
    pub(crate) max_crashes: u32,
    /// Most jobs on one worker.
    pub(crate) max_jobs: usize,
    /// The applications allow it.
    pub(crate) global_stealing: bool,
    /// Announced scores are wrong by up to this factor, either way.
    pub(crate) score_error: f64,
}

/// The farm.
pub(crate) struct World {
    pub(crate) now: Instant,
    pub(crate) rng: SmallRng,
    pub(crate) coordinator: CoordinatorMachine,
    pub(crate) workers: Vec<WorkerHost>,
    pub(crate) apps: Vec<AppHost>,
    pub(crate) work: Work,
    /// Application and worker that cannot reach each other.
    pub(crate) cuts: BTreeSet<(usize, usize)>,
    /// One in this many data messages arrives twice; 0 for none.
    pub(crate) duplicate_one_in: u32,
    max_crashes: u32,
    max_jobs: usize,
    score_error: f64,
    epoch: u32,
    links: BTreeMap<LinkId, Link>,
    next_link: u64,
    queue: BTreeMap<(Instant, u64), Happening>,
    next_happening: u64,
    timer_rounds: u32,
    /// FNV-1a over everything that any machine ever wanted.
    pub(crate) log_hash: u64,
    pub(crate) log_entries: u64,
}

pub(crate) const fn liveness() -> message::Liveness {
    message::Liveness { heartbeat_ms: 100, suspect_ms: 300, dead_ms: 1_000, reconnect_ms: 400 }
}

fn coordinator(epoch: u32, seed: u64, max_crashes: u32) -> CoordinatorMachine {
    let config = CoordinatorConfig::new(Epoch(epoch), seed);
    CoordinatorMachine::new(CoordinatorConfig {
        liveness: liveness(),
        app_lease_ms: 3_000,
        max_crashes,
        ..config
    })
}

impl World {
    pub(crate) fn new(setup: &Setup) -> Self {
        let mut world = Self {
            now: Instant::ZERO,
            rng: SmallRng::seed_from_u64(setup.seed),
            coordinator: coordinator(1, setup.seed, setup.max_crashes),
            workers: Vec::new(),
            apps: Vec::new(),
            work: Work::default(),
            cuts: BTreeSet::new(),
            duplicate_one_in: 0,
            max_crashes: setup.max_crashes,
            max_jobs: setup.max_jobs,
            score_error: setup.score_error,
            epoch: 1,
            links: BTreeMap::new(),
            next_link: 1,
            queue: BTreeMap::new(),
            next_happening: 0,
            timer_rounds: 0,
            log_hash: 0xcbf2_9ce4_8422_2325,
            log_entries: 0,
        };
        for speeds in &setup.workers {
            world.add_worker(speeds);
        }
        for app in 0..setup.apps {
            world.apps.push(AppHost::new(app, setup.global_stealing));
            world.after(Duration::ZERO, Happening::Dial { proc: Proc::App(app), life: 0 });
        }
        world
    }

    pub(crate) fn add_worker(&mut self, speeds: &[f64]) {
        let index = self.workers.len();
        let seed = self.rng.random();
        let bound = self.score_error;
        let errors = if bound > 1.0 {
            speeds.iter().map(|_| bound.powf(self.rng.random_range(-1.0..=1.0))).collect()
        } else {
            vec![1.0; speeds.len()]
        };
        self.workers.push(WorkerHost::new(index, speeds, errors, self.max_jobs, seed));
        self.after(Duration::ZERO, Happening::Dial { proc: Proc::Worker(index), life: 0 });
    }

    pub(crate) fn after(&mut self, delay: Duration, happening: Happening) {
        self.at(self.now.after(delay), happening);
    }

    pub(crate) fn at(&mut self, at: Instant, happening: Happening) {
        self.queue.insert((at.max(self.now), self.next_happening), happening);
        self.next_happening += 1;
    }

    /// Lets things happen until `done` says so. Panics if they have not by `deadline`.
    pub(crate) fn run_until(&mut self, deadline: Instant, done: impl Fn(&Self) -> bool) {
        while !done(self) {
            assert!(self.now <= deadline, "not done by {deadline}: {}", self.describe());
            self.step();
        }
    }

    pub(crate) fn run_for(&mut self, duration: Duration) {
        let end = self.now.after(duration);
        while self.next_instant().is_some_and(|next| next <= end) {
            self.step();
        }
        self.now = end;
    }

    /// The earliest thing happens: a queued one before a timer of the same instant.
    fn step(&mut self) {
        let timer = self.next_timer();
        let queued = self.queue.first_key_value().map(|((at, _), _)| *at);
        match (queued, timer) {
            (None, None) => panic!("nothing will ever happen again: {}", self.describe()),
            (Some(at), timer) if timer.is_none_or(|(due, _)| at <= due) => {
                let Some((_, happening)) = self.queue.pop_first() else { return };
                self.advance(at);
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
        queued.into_iter().chain(self.next_timer().map(|(due, _)| due)).min()
    }

    fn next_timer(&self) -> Option<(Instant, Proc)> {
        let coordinator = self.coordinator.poll_timeout().map(|due| (due, Proc::Coordinator));
        let workers =
            (0..).zip(&self.workers).filter_map(|(index, host)| Some((host.timeout()?, Proc::Worker(index))));
        let apps = (0..)
            .zip(&self.apps)
            .filter_map(|(index, host)| Some((host.ledger.poll_timeout()?, Proc::App(index))));
        coordinator.into_iter().chain(workers).chain(apps).min()
    }

    fn advance(&mut self, to: Instant) {
        if to > self.now {
            self.timer_rounds = 0;
        }
        self.now = to;
    }

    fn fire(&mut self, proc: Proc) {
        let now = self.now;
        match proc {
            Proc::Coordinator => {
                self.coordinator.handle_timeout(now);
                self.coordinator_settles();
            }
            Proc::Worker(index) => {
                self.workers[index].machine_mut().handle_timeout(now);
                self.worker_settles(index);
            }
            Proc::App(index) => {
                self.apps[index].ledger.handle_timeout(now);
                self.app_settles(index);
            }
        }
    }

    fn happen(&mut self, happening: Happening) {
        match happening {
            Happening::Arrives { link, to, message } => self.arrives(link, to, message),
            Happening::Opened { link } => self.opened(link),
            Happening::Closed { link, to, life } => self.told_closed(link, to, life),
            Happening::NotOpened { app, node, session } => {
                self.app_event(app, ledger::Event::NodeLost { node, session });
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
            Happening::Fault(fault) => self.fault(fault),
        }
    }

    // ------------------------------------------------------------------ connections

    fn dial_coordinator(&mut self, proc: Proc, life: u32) {
        if self.life(proc) != life || !self.wants_coordinator(proc) {
            return;
        }
        let link = self.add_link(proc, Proc::Coordinator, None);
        self.after_latency(Happening::Opened { link });
    }

    /// An application dials a node.
    pub(crate) fn dial_node(&mut self, app: usize, node: NodeId, session: NodeSession, address: &str) {
        let index: usize = address.trim_start_matches("worker-").parse().expect("addresses are ours");
        let reachable = self.workers[index].session == session && self.workers[index].is_up();
        if !reachable || self.cuts.contains(&(app, index)) {
            self.after_latency(Happening::NotOpened { app, node, session });
            return;
        }
        let link = self.add_link(Proc::App(app), Proc::Worker(index), Some((node, session)));
        self.after_latency(Happening::Opened { link });
    }

    fn add_link(&mut self, dialler: Proc, listener: Proc, life: Option<(NodeId, NodeSession)>) -> LinkId {
        let id = LinkId(self.next_link);
        self.next_link += 1;
        self.links.insert(id, Link { dialler, listener, life, silent: false, last_arrival: [self.now; 2] });
        id
    }

    fn opened(&mut self, id: LinkId) {
        let Some(link) = self.links.get(&id) else { return };
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
                self.apps[index].nodes.insert((node, session), id);
                self.app_event(index, ledger::Event::NodeConnected { node, session });
            }
            (Proc::Coordinator, _) => panic!("the coordinator dials nobody"),
        }
    }

    pub(crate) fn send(&mut self, from: Proc, id: LinkId, message: Message) {
        let may_double = matches!(
            message,
            Message::AppToNode(AppToNode::Jobs(_)) | Message::NodeToApp(NodeToApp::Result(_))
        );
        let one_in = self.duplicate_one_in;
        let copies = if may_double && one_in > 0 && self.rng.random_ratio(1, one_in) { 2 } else { 1 };
        for _ in 0..copies {
            let latency = self.latency();
            let Some(link) = self.links.get_mut(&id).filter(|link| !link.silent) else { return };
            let (to, side) = if link.dialler == from { (link.listener, 1) } else { (link.dialler, 0) };
            let arrival = self.now.after(latency).max(link.last_arrival[side]);
            link.last_arrival[side] = arrival;
            self.at(arrival, Happening::Arrives { link: id, to, message: message.clone() });
        }
    }

    fn arrives(&mut self, id: LinkId, to: Proc, message: Message) {
        let Some(link) = self.links.get(&id).filter(|link| !link.silent) else { return };
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
                self.app_event(index, ledger::Event::FromCoordinator(message));
            }
            (Proc::App(index), Message::NodeToApp(message)) => {
                let (node, session) = life.expect("nodes speak on data links");
                self.app_hears_node(index, node, session, message);
            }
            (to, message) => panic!("{to:?} cannot hear {message:?}"),
        }
    }

    /// A connection breaks: what is on its way is lost, both ends learn of it, each in its time.
    pub(crate) fn break_link(&mut self, id: LinkId) {
        let Some(link) = self.links.remove(&id) else { return };
        for to in [link.dialler, link.listener] {
            if let (Proc::App(index), Some(life)) = (to, link.life) {
                let current = self.apps[index].nodes.get(&life) == Some(&id);
                if current {
                    self.apps[index].nodes.remove(&life);
                    let (node, session) = life;
                    self.after_latency(Happening::NotOpened { app: index, node, session });
                }
                continue;
            }
            let life = self.life(to);
            self.after_latency(Happening::Closed { link: id, to, life });
        }
    }

    /// One end closes: what it said before still arrives.
    pub(crate) fn hang_up(&mut self, from: Proc, id: LinkId) {
        let Some(link) = self.links.get(&id) else { return };
        let side = usize::from(link.dialler == from);
        let last_word = link.last_arrival[side];
        self.at(last_word, Happening::Fault(Fault::Break(id)));
    }

    fn told_closed(&mut self, id: LinkId, to: Proc, life: u32) {
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

    pub(crate) fn silence_link(&mut self, id: LinkId) {
        if let Some(link) = self.links.get_mut(&id) {
            link.silent = true;
        }
    }

    pub(crate) fn links_of(&self, proc: Proc) -> Vec<LinkId> {
        let ends = |link: &Link| link.dialler == proc || link.listener == proc;
        self.links.iter().filter(|(_, link)| ends(link)).map(|(&id, _)| id).collect()
    }

    pub(crate) fn links_between(&self, one: Proc, other: Proc) -> Vec<LinkId> {
        let between = |link: &Link| (link.dialler, link.listener) == (one, other);
        self.links.iter().filter(|(_, link)| between(link)).map(|(&id, _)| id).collect()
    }

    pub(crate) fn any_link(&mut self) -> Option<LinkId> {
        if self.links.is_empty() {
            return None;
        }
        let nth = self.rng.random_range(0..self.links.len());
        self.links.keys().nth(nth).copied()
    }

    pub(crate) fn is_open(&self, id: LinkId) -> bool {
        self.links.get(&id).is_some_and(|link| !link.silent)
    }

    /// The coordinator's process dies and another one, which knows nothing, takes its address.
    pub(crate) fn restart_coordinator(&mut self) {
        for link in self.links_of(Proc::Coordinator) {
            self.break_link(link);
        }
        self.epoch += 1;
        self.coordinator = coordinator(self.epoch, self.epoch.into(), self.max_crashes);
    }

    // ------------------------------------------------------------------ small things

    fn latency(&mut self) -> Duration {
        Duration::from_micros(self.rng.random_range(50..5_000))
    }

    fn after_latency(&mut self, happening: Happening) {
        let latency = self.latency();
        self.after(latency, happening);
    }

    fn life(&self, proc: Proc) -> u32 {
        match proc {
            Proc::Coordinator => self.epoch,
            Proc::Worker(index) => self.workers[index].life,
            Proc::App(_) => 0,
        }
    }

    fn wants_coordinator(&self, proc: Proc) -> bool {
        let control = match proc {
            Proc::Coordinator => return false,
            Proc::Worker(index) if !self.workers[index].is_up() => return false,
            Proc::Worker(index) => self.workers[index].control,
            Proc::App(index) if self.apps[index].finished => return false,
            Proc::App(index) => self.apps[index].control,
        };
        control.is_none() && self.links_between(proc, Proc::Coordinator).is_empty()
    }

    pub(crate) fn log(&mut self, proc: Proc, effect: &impl Debug) {
        self.log_entries += 1;
        for byte in format!("{} {proc:?} {effect:?}", self.now).bytes() {
            self.log_hash = (self.log_hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }

    pub(crate) fn describe(&self) -> String {
        let ledgers: Vec<_> = self.apps.iter().map(|host| host.ledger.counts()).collect();
        format!("at {}: {ledgers:#?}\n{:#?}", self.now, self.coordinator.status())
    }
}
