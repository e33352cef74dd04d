//! A worker's process and its executors.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use farm_core::{
    device::{DeviceInfo, DeviceKind, Features, Limits},
    id::{AppId, Attempt, ContentHash, DeviceIndex, JobAttempt, JobId, LinkId, NodeSession},
    message::{AppToNode, Contact, CoordinatorToNode, JobFailure, LatencyClass, NodeToApp},
    time::Instant,
    worker::{Effect, Event, Provider, Share, WorkerConfig, WorkerMachine},
};
use rand::Rng;

use crate::sim::{
    auditor::worker_at,
    clock::Clock,
    faults::Fault,
    network::{Message, Proc},
    work::{JOB_LIMIT, cost_ns, digest, result_sections},
    world::{Happening, Setup, World},
};

/// Pause of whoever starts workers again after a crash.
const RESTART: Duration = Duration::from_secs(1);

/// A worker's process: gone and started again it has another session and an empty memory.
#[derive(Debug)]
pub struct WorkerHost {
    index: usize,
    /// What each device's speed is when it is well.
    speeds: Vec<f64>,
    /// What each announced score is times the true one.
    score_errors: Vec<f64>,
    max_jobs: usize,
    spool_quota_bytes: u64,
    pub(in crate::sim) life: u32,
    pub(in crate::sim) session: NodeSession,
    clock: Clock,
    machine: Option<WorkerMachine>,
    pub(in crate::sim) control: Option<LinkId>,
    leaves: bool,
    /// Programs by attempt, as they came with the tickets.
    programs: BTreeSet<JobAttempt>,
    /// Payloads by attempt: their digests.
    payloads: BTreeMap<JobAttempt, ContentHash>,
    cache: BTreeSet<ContentHash>,
    devices: Vec<Executor>,
    newest: BTreeMap<JobId, Attempt>,
    next_run: u64,
}

/// A device with its running and its staged jobs.
#[derive(Debug)]
struct Executor {
    lost: bool,
    /// How many times slower than when it is well.
    slowness: f64,
    running: Option<Run>,
    /// A batch job that made way, with what it has left.
    interrupted: Option<Run>,
    /// One of each class at most, interactive ones first.
    staged: VecDeque<(JobAttempt, LatencyClass)>,
    /// Since when it has nothing.
    idle_since: Option<Instant>,
}

/// A job on its device.
#[derive(Clone, Copy, Debug)]
struct Run {
    job: JobAttempt,
    class: LatencyClass,
    number: u64,
    started_at: Instant,
    /// What it needs from there.
    left: Duration,
    /// What it had before an interruption.
    ran_before: Duration,
}

impl Executor {
    const fn new(now: Instant) -> Self {
        Self {
            lost: false,
            slowness: 1.0,
            running: None,
            interrupted: None,
            staged: VecDeque::new(),
            idle_since: Some(now),
        }
    }

    fn holds(&self, job: JobAttempt) -> bool {
        self.held().any(|held| held == job)
    }

    fn held(&self) -> impl Iterator<Item = JobAttempt> {
        let begun = self.running.iter().chain(&self.interrupted).map(|run| run.job);
        begun.chain(self.staged.iter().map(|(job, _)| *job))
    }
}

impl WorkerHost {
    pub(in crate::sim) fn new(index: usize, speeds: &[f64], score_errors: Vec<f64>, setup: &Setup) -> Self {
        Self {
            index,
            speeds: speeds.to_vec(),
            score_errors,
            max_jobs: setup.max_jobs,
            spool_quota_bytes: setup.spool_quota_bytes,
            life: 0,
            session: NodeSession(0),
            clock: Clock::TRUE,
            machine: None,
            control: None,
            leaves: false,
            programs: BTreeSet::new(),
            payloads: BTreeMap::new(),
            cache: BTreeSet::new(),
            devices: Vec::new(),
            newest: BTreeMap::new(),
            next_run: 0,
        }
    }

    /// A process starts; `seed` is its session and its machine's seed.
    pub(in crate::sim) fn start(&mut self, now: Instant, seed: u64, clock: Clock) {
        self.session = NodeSession(seed);
        self.clock = clock;
        self.leaves = false;
        self.devices = self.speeds.iter().map(|_| Executor::new(now)).collect();
        let devices = self
            .speeds
            .iter()
            .zip(&self.score_errors)
            .map(|(speed, error)| DeviceInfo {
                name: format!("sim {speed}"),
                kind: DeviceKind::Simulated,
                score: speed * error * 1_000.0,
                features: Features::default(),
                limits: Limits::UNBOUNDED,
            })
            .collect();
        self.machine = Some(WorkerMachine::new(WorkerConfig {
            name: format!("worker-{}", self.index),
            session: self.session,
            devices,
            contact: Contact {
                addresses: vec![format!("worker-{}", self.index)],
                certificate_der: Vec::new(),
            },
            max_jobs: self.max_jobs,
            spool_quota_bytes: self.spool_quota_bytes,
            share: Share::DEFAULT,
            local_stealing: true,
            cached: Vec::new(),
            seed,
        }));
    }

    fn stop(&mut self) {
        self.life += 1;
        self.machine = None;
        self.control = None;
        self.programs.clear();
        self.payloads.clear();
        self.cache.clear();
        self.devices.clear();
        self.newest.clear();
    }

    /// Whether there is a process.
    #[must_use]
    pub const fn is_up(&self) -> bool {
        self.machine.is_some()
    }

    pub(in crate::sim) fn runs(&self, life: u32) -> bool {
        self.is_up() && self.life == life
    }

    pub(in crate::sim) const fn machine(&self) -> Option<&WorkerMachine> {
        self.machine.as_ref()
    }

    pub(in crate::sim) fn timeout(&self) -> Option<Instant> {
        self.machine.as_ref().and_then(WorkerMachine::poll_timeout).map(|due| self.clock.reaches(due))
    }

    /// Devices that are there and well, with their speeds and since when they have nothing.
    pub(in crate::sim) fn well_devices(&self) -> impl Iterator<Item = (usize, f64, Option<Instant>)> {
        self.devices
            .iter()
            .zip(&self.speeds)
            .enumerate()
            .filter(|(_, (device, _))| !device.lost && device.slowness <= 1.0)
            .map(|(index, (device, &speed))| (index, speed, device.idle_since))
    }

    /// Whether every device that is there is well: of a slow one nobody knows how long its queue takes.
    pub(in crate::sim) fn is_well(&self) -> bool {
        self.devices.iter().all(|device| device.lost || device.slowness <= 1.0)
    }

    /// Whether it was asked to end: what it has queued is going away, and it gets nothing new.
    pub(in crate::sim) const fn leaves(&self) -> bool {
        self.leaves
    }

    /// The jobs that it holds and no device has or had.
    pub(in crate::sim) fn queued(&self) -> impl Iterator<Item = JobAttempt> {
        self.programs.iter().copied().filter(|job| {
            !self.payloads.contains_key(job) && !self.devices.iter().any(|device| device.holds(*job))
        })
    }

    pub(in crate::sim) fn kept(&self) -> usize {
        let on_devices = self.devices.iter().map(|device| device.held().count()).sum::<usize>();
        self.programs.len() + self.payloads.len() + on_devices
    }

    /// Bytes of an application's results that wait here.
    #[must_use]
    pub fn spooled_bytes(&self, app: AppId) -> u64 {
        let of_app = self.payloads.keys().filter(|job| job.job.app == app);
        of_app.flat_map(|job| result_sections(job.job.index)).sum()
    }

    /// I8: at quiescence nothing is kept.
    ///
    /// # Panics
    /// Something is.
    pub fn assert_empty(&self) {
        assert_eq!(self.kept(), 0, "I8: worker {} keeps {:?}", self.index, self.programs.first());
        let held = self.machine.as_ref().map_or(0, WorkerMachine::held_jobs);
        assert_eq!(held, 0, "I8: the machine of worker {} keeps jobs", self.index);
    }
}

impl World {
    pub(in crate::sim) fn worker_hears_app(&mut self, index: usize, link: LinkId, message: AppToNode) {
        // What was on its way to a process that ended reaches nobody.
        if !self.workers[index].is_up() {
            return;
        }
        if let AppToNode::Jobs(tickets) = &message {
            self.workers[index].programs.extend(tickets.iter().map(|ticket| ticket.job));
        }
        self.worker_event(index, Event::FromApp { link, message });
    }

    pub(in crate::sim) fn worker_event(&mut self, index: usize, event: Event) {
        let host = &mut self.workers[index];
        let Some(machine) = &mut host.machine else { return };
        host.leaves |=
            matches!(event, Event::DrainRequested | Event::FromCoordinator(CoordinatorToNode::Drain));
        machine.handle(host.clock.shows(self.now), event);
        self.worker_settles(index);
    }

    pub(in crate::sim) fn worker_timeout(&mut self, index: usize) {
        let host = &mut self.workers[index];
        let Some(machine) = &mut host.machine else { return };
        machine.handle_timeout(host.clock.shows(self.now));
        self.worker_settles(index);
    }

    fn worker_settles(&mut self, index: usize) {
        let due = self.audit.is_due();
        let Some(machine) = &mut self.workers[index].machine else { return };
        if due {
            machine.check_invariants();
            self.audit.shares(index, machine, self.setup.interactive);
        }
        let effects: Vec<Effect> = std::iter::from_fn(|| machine.poll_effect()).collect();
        for effect in effects {
            self.log.enter(self.now, Proc::Worker(index), &effect);
            self.worker_effect(index, effect);
        }
        // Executors take orders in as they come, and begin when there is no further one.
        for device in 0..self.workers[index].devices.len() {
            let device = DeviceIndex(u16::try_from(device).expect("few devices"));
            self.make_way(index, device);
            self.run_next(index, device);
        }
        self.rearm(Proc::Worker(index));
    }

    fn worker_effect(&mut self, index: usize, effect: Effect) {
        let proc = Proc::Worker(index);
        match effect {
            Effect::ToCoordinator(message) => {
                if let Some(link) = self.workers[index].control {
                    self.send(proc, link, Message::NodeToCoordinator(message));
                }
            }
            Effect::ToApp { link, message } => {
                if let NodeToApp::Result(header) = &message
                    && header.outcome.is_ok()
                {
                    let payload = self.workers[index].payloads.get(&header.job);
                    let job = header.job;
                    assert_eq!(payload, Some(&header.digest), "I3: {job} is sent without its payload");
                }
                self.send(proc, link, Message::NodeToApp(message));
            }
            Effect::CloseApp { link } => self.hang_up(proc, link),
            Effect::Fetch { content, from } => self.fetch(index, content.hash, &from),
            Effect::Execute { job, device, class } => self.execute(index, job, device, class),
            Effect::Abort { job, device } => self.abort(index, job, device),
            Effect::Discard(job) => {
                self.workers[index].programs.remove(&job);
                self.workers[index].payloads.remove(&job);
            }
            // Now and then somebody else needs the room.
            Effect::Release(content) => {
                if self.rng.random_ratio(1, 2) && self.workers[index].cache.remove(&content) {
                    let life = self.workers[index].life;
                    let event = Event::ContentsEvicted(vec![content]);
                    self.after(Duration::ZERO, Happening::Worker { worker: index, life, event });
                }
            }
            Effect::Evict(_) => unreachable!("no operator asks for it here"),
            Effect::Exit => self.exit_worker(index),
        }
    }

    /// The process ends by itself.
    fn exit_worker(&mut self, index: usize) {
        // What was said before still arrives; then everybody learns that the process is gone.
        for link in self.links_of(Proc::Worker(index)) {
            self.hang_up(Proc::Worker(index), link);
        }
        self.workers[index].stop();
        self.diary.cut_off(self.now, index, None);
    }

    /// The process is killed.
    pub(in crate::sim) fn kill_worker(&mut self, index: usize) {
        if !self.workers[index].is_up() {
            return;
        }
        self.audit.disturbed(self.now, Proc::Worker(index), Proc::Worker(index));
        for link in self.links_of(Proc::Worker(index)) {
            self.drop_link(link);
        }
        self.end_process(index);
    }

    /// The process is gone, with words of its on their way.
    pub(in crate::sim) fn abandon_worker(&mut self, index: usize) {
        if !self.workers[index].is_up() {
            return;
        }
        self.audit.disturbed(self.now, Proc::Worker(index), Proc::Worker(index));
        for link in self.links_of(Proc::Worker(index)) {
            self.abandon(Proc::Worker(index), link);
        }
        self.end_process(index);
    }

    /// The process is gone, its connections silent. Gives them, and when their keepalives notice.
    pub(in crate::sim) fn power_off(&mut self, index: usize) -> Vec<(LinkId, Duration)> {
        if !self.workers[index].is_up() {
            return Vec::new();
        }
        self.audit.disturbed(self.now, Proc::Worker(index), Proc::Worker(index));
        let links = self.links_of(Proc::Worker(index));
        links.iter().for_each(|&link| self.silence_link(link));
        self.end_process(index);
        links.into_iter().map(|link| (link, self.keepalive_of(link))).collect()
    }

    fn end_process(&mut self, index: usize) {
        self.workers[index].stop();
        self.diary.cut_off(self.now, index, None);
        self.rearm(Proc::Worker(index));
    }

    /// A killed worker is started again.
    pub(in crate::sim) fn start_worker(&mut self, index: usize) {
        if self.workers[index].is_up() {
            return;
        }
        let seed = self.rng.random();
        let clock = self.new_clock();
        let host = &mut self.workers[index];
        host.start(self.now, seed, clock);
        let life = host.life;
        self.after(Duration::ZERO, Happening::Dial { proc: Proc::Worker(index), life });
    }

    fn fetch(&mut self, index: usize, hash: ContentHash, from: &Provider) {
        let host = &mut self.workers[index];
        let life = host.life;
        let fails =
            self.work.fetch_fails_one_in > 0 && self.rng.random_ratio(1, self.work.fetch_fails_one_in);
        let cached = host.cache.contains(&hash);
        let has_it = match from {
            Provider::Application(link) => self.is_open(*link),
            Provider::Node(contact) => {
                let peer = worker_at(&contact.addresses[0]);
                let blocked = self.is_blocked(Proc::Worker(index), Proc::Worker(peer));
                let served = !blocked && self.workers[peer].cache.contains(&hash);
                self.audit.checks.peer_fetches += u64::from(served);
                served
            }
        };
        let event = if cached || (has_it && !fails) {
            self.workers[index].cache.insert(hash);
            Event::ContentReady(hash)
        } else {
            Event::ContentFailed { content: hash, reason: "simulated".to_owned() }
        };
        let delay = Duration::from_micros(if cached { 0 } else { self.rng.random_range(100..20_000) });
        self.after(delay, Happening::Worker { worker: index, life, event });
    }

    fn execute(&mut self, index: usize, job: JobAttempt, device: DeviceIndex, class: LatencyClass) {
        let host = &mut self.workers[index];
        assert!(host.programs.contains(&job), "{job} is executed without its program");
        let newest = host.newest.entry(job.job).or_insert(job.attempt);
        assert!(*newest <= job.attempt, "I4: {job} is executed after {newest}");
        *newest = job.attempt;
        let executor = &mut host.devices[usize::from(device.0)];
        assert!(!executor.lost, "{job} is given to a lost device");
        let same = executor.staged.iter().filter(|(_, staged)| *staged == class).count();
        let begins = usize::from(executor.running.is_none());
        assert!(same <= begins, "{device} has a staged job of this class already");
        let before = executor.staged.iter().filter(|(_, staged)| *staged >= class).count();
        executor.staged.insert(before, (job, class));
    }

    /// A running batch job goes off the device, its state kept, where an interactive one is staged.
    fn make_way(&mut self, index: usize, device: DeviceIndex) {
        let now = self.now;
        let host = &mut self.workers[index];
        let executor = &mut host.devices[usize::from(device.0)];
        let waits = executor.staged.front().is_some_and(|(_, class)| *class == LatencyClass::Interactive);
        let is_batch = |run: &mut Run| run.class == LatencyClass::Batch;
        let Some(run) = executor.running.take_if(|run| waits && is_batch(run)) else { return };
        let ran = now.since(run.started_at);
        let (left, ran_before) = (run.left.saturating_sub(ran), run.ran_before + ran);
        assert!(executor.interrupted.is_none(), "two batch jobs have begun on {device}");
        executor.interrupted = Some(Run { left, ran_before, ..run });
        let (life, job) = (host.life, run.job);
        let event = Event::Yielded { job, device };
        self.audit.checks.yields += 1;
        self.after(Duration::ZERO, Happening::Worker { worker: index, life, event });
    }

    /// An interactive job first, then one that made way, then the next.
    fn run_next(&mut self, index: usize, device: DeviceIndex) {
        let host = &mut self.workers[index];
        let executor = &mut host.devices[usize::from(device.0)];
        if executor.running.is_some() {
            return;
        }
        let waits = executor.staged.front().is_some_and(|(_, class)| *class == LatencyClass::Interactive);
        let back = if waits { None } else { executor.interrupted.take() };
        let Some(run) = back.or_else(|| {
            let (job, class) = executor.staged.pop_front()?;
            let speed = host.speeds[usize::from(device.0)] / executor.slowness;
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "milliseconds, far from the limits"
            )]
            let takes = Duration::from_nanos((cost_ns(job.job.index) as f64 / speed) as u64);
            let left = if self.work.hangs.contains(&job.job.task) { JOB_LIMIT } else { takes };
            Some(Run { job, class, number: 0, started_at: self.now, left, ran_before: Duration::ZERO })
        }) else {
            executor.idle_since.get_or_insert(self.now);
            return;
        };
        host.next_run += 1;
        let number = host.next_run;
        executor.running = Some(Run { number, started_at: self.now, ..run });
        executor.idle_since = None;
        let (life, job) = (host.life, run.job);
        let event = match back {
            Some(_) => Event::Resumed { job, device },
            None => {
                self.audit.begins(index, job.job);
                self.diary.begins(self.now, index, device, job);
                Event::Started { job, device }
            }
        };
        self.after(Duration::ZERO, Happening::Worker { worker: index, life, event });
        self.after(run.left, Happening::JobDone { worker: index, life, device, run: number });
    }

    pub(in crate::sim) fn job_done(&mut self, index: usize, device: DeviceIndex, number: u64) {
        let host = &mut self.workers[index];
        let running = &mut host.devices[usize::from(device.0)].running;
        let Some(run) = running.take_if(|run| run.number == number) else { return };
        let took = run.ran_before + host.clock.shows(self.now).since(host.clock.shows(run.started_at));
        let job = run.job;
        self.diary.is_off(self.now, job);
        let crashes = self.work.crash_one_in > 0 && self.rng.random_ratio(1, self.work.crash_one_in);
        if self.work.deadly.contains(&(job.job.task, job.job.index)) {
            return self.fault(Fault::Kill { worker: index, restart: Some(RESTART) });
        }
        let hangs = self.work.hangs.contains(&job.job.task);
        let outcome = if self.work.poison.contains(&job.job.task) || hangs || crashes {
            self.audit.crashed(job.job, self.setup.max_crashes);
            Err(JobFailure::Timeout)
        } else if self.work.invalid.contains(&job.job.task) {
            Err(JobFailure::InvalidProgram("simulated".to_owned()))
        } else {
            self.workers[index].payloads.insert(job, digest(job.job));
            Ok((result_sections(job.job.index), digest(job.job)))
        };
        self.run_next(index, device);
        let device_time_ns = u64::try_from(took.as_nanos()).expect("short");
        self.worker_event(index, Event::Executed { job, device, device_time_ns, outcome });
    }

    fn abort(&mut self, index: usize, job: JobAttempt, device: DeviceIndex) {
        let host = &mut self.workers[index];
        let executor = &mut host.devices[usize::from(device.0)];
        executor.staged.retain(|(staged, _)| *staged != job);
        let is_it = |run: &mut Run| run.job == job;
        let begun = executor.running.take_if(is_it).or_else(|| executor.interrupted.take_if(is_it));
        let Some(run) = begun else { return };
        if run.started_at == self.now && run.ran_before.is_zero() {
            self.audit.did_not_begin(job.job);
        }
        self.diary.is_off(self.now, job);
        let life = host.life;
        let event = Event::Executed { job, device, device_time_ns: 0, outcome: Err(JobFailure::Cancelled) };
        self.after(Duration::from_micros(10), Happening::Worker { worker: index, life, event });
        self.run_next(index, device);
    }

    pub(in crate::sim) fn lose_device(&mut self, index: usize, device: DeviceIndex) {
        let host = &mut self.workers[index];
        let executor = host.devices.get_mut(usize::from(device.0));
        let Some(executor) = executor.filter(|executor| !executor.lost) else { return };
        *executor = Executor { lost: true, ..Executor::new(self.now) };
        self.diary.cut_off(self.now, index, Some(device));
        self.audit.disturbed(self.now, Proc::Worker(index), Proc::Worker(index));
        self.worker_event(index, Event::DeviceLost { device, reason: "simulated".to_owned() });
    }

    /// A device becomes this many times slower than when it is well: jobs that it begins take as much longer.
    pub(in crate::sim) fn slow_device(&mut self, index: usize, device: DeviceIndex, slowness: f64) {
        if let Some(executor) = self.workers[index].devices.get_mut(usize::from(device.0)) {
            executor.slowness = slowness;
        }
    }

    /// Every device that is there is well again.
    pub(in crate::sim) fn heal_devices(&mut self) {
        for device in self.workers.iter_mut().flat_map(|host| &mut host.devices) {
            device.slowness = 1.0;
        }
    }
}
