//! The drivers of the three machines, as thin as they can be: they keep what machines do not (programs, payloads), carry
//! effects out, and object to effects that a real driver could not carry out.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use farm_core::{
    coordinator::{self, Effect as CoordinatorEffect},
    device::{DeviceInfo, DeviceKind, Features, Limits},
    id::{
        Attempt, ContentHash, DeviceIndex, JobAttempt, JobId, JobIndex, LinkId, NodeId, NodeSession, TaskId,
    },
    ledger::{self, Effect as LedgerEffect, Ledger},
    message::{AppHello, AppToNode, Contact, JobFailure, NodeToApp, PROTOCOL_VERSION},
    time::Instant,
    worker::{self, Effect as WorkerEffect, WorkerConfig, WorkerMachine},
};
use rand::Rng;

use crate::world::{Happening, Message, Proc, World};

/// What jobs do when they run, and what became of them.
#[derive(Debug, Default)]
pub(crate) struct Work {
    /// Tasks whose jobs crash whatever runs them.
    pub(crate) poison: BTreeSet<TaskId>,
    /// Tasks whose jobs are wrong.
    pub(crate) invalid: BTreeSet<TaskId>,
    /// One in this many runs ends with a retryable failure; 0 for none.
    pub(crate) crash_one_in: u32,
    /// One in this many fetches fails; 0 for none.
    pub(crate) fetch_fails_one_in: u32,
    /// Runs begun, by job.
    pub(crate) runs: BTreeMap<JobId, u32>,
}

/// A worker's process: gone and started again it has another session and an empty memory.
pub(crate) struct WorkerHost {
    index: usize,
    speeds: Vec<f64>,
    /// What each announced score is times the true one.
    score_errors: Vec<f64>,
    max_jobs: usize,
    pub(crate) life: u32,
    pub(crate) session: NodeSession,
    machine: Option<WorkerMachine>,
    pub(crate) control: Option<LinkId>,
    /// Programs by attempt, as they came with the tickets.
    programs: BTreeSet<JobAttempt>,
    /// Payloads by attempt: their digests.
    payloads: BTreeMap<JobAttempt, ContentHash>,
    cache: BTreeSet<ContentHash>,
    devices: Vec<Executor>,
    newest: BTreeMap<JobId, Attempt>,
    next_run: u64,
}

#[derive(Debug, Default)]
struct Executor {
    lost: bool,
    running: Option<(JobAttempt, u64, Duration)>,
    staged: VecDeque<JobAttempt>,
}

impl WorkerHost {
    pub(crate) fn new(
        index: usize,
        speeds: &[f64],
        score_errors: Vec<f64>,
        max_jobs: usize,
        seed: u64,
    ) -> Self {
        let mut host = Self {
            index,
            speeds: speeds.to_vec(),
            score_errors,
            max_jobs,
            life: 0,
            session: NodeSession(0),
            machine: None,
            control: None,
            programs: BTreeSet::new(),
            payloads: BTreeMap::new(),
            cache: BTreeSet::new(),
            devices: Vec::new(),
            newest: BTreeMap::new(),
            next_run: 0,
        };
        host.start(seed);
        host
    }

    pub(crate) fn start(&mut self, seed: u64) {
        self.session = NodeSession(seed);
        self.devices = self.speeds.iter().map(|_| Executor::default()).collect();
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
            local_stealing: true,
            share: worker::Share::DEFAULT,
            seed,
        }));
    }

    pub(crate) fn stop(&mut self) {
        self.life += 1;
        self.machine = None;
        self.control = None;
        self.programs.clear();
        self.payloads.clear();
        self.cache.clear();
        self.devices.clear();
        self.newest.clear();
    }

    pub(crate) const fn is_up(&self) -> bool {
        self.machine.is_some()
    }

    pub(crate) fn runs(&self, life: u32) -> bool {
        self.is_up() && self.life == life
    }

    pub(crate) fn machine_mut(&mut self) -> &mut WorkerMachine {
        self.machine.as_mut().expect("the process is up")
    }

    pub(crate) fn timeout(&self) -> Option<Instant> {
        self.machine.as_ref().and_then(WorkerMachine::poll_timeout)
    }

    /// I8: at quiescence nothing is kept.
    pub(crate) fn assert_empty(&self) {
        let idle = self.devices.iter().all(|device| device.running.is_none() && device.staged.is_empty());
        let kept = (self.programs.len(), self.payloads.len(), idle);
        assert_eq!(kept, (0, 0, true), "I8: worker {} keeps {:?}", self.index, self.programs.first());
    }
}

/// How a job ended, as its application saw it.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Ending {
    Delivered(NodeId),
    Failed(JobFailure),
}

/// An application's process.
pub(crate) struct AppHost {
    pub(crate) ledger: Ledger,
    pub(crate) control: Option<LinkId>,
    pub(crate) nodes: BTreeMap<(NodeId, NodeSession), LinkId>,
    pub(crate) programs: BTreeSet<(TaskId, JobIndex)>,
    payloads: BTreeMap<(JobAttempt, ContentHash), u32>,
    pub(crate) endings: BTreeMap<(TaskId, JobIndex), Ending>,
    /// Jobs that it submits, now or later.
    pub(crate) expected: usize,
    pub(crate) waits: usize,
    pub(crate) finished: bool,
}

impl AppHost {
    pub(crate) fn new(index: usize, global_stealing: bool) -> Self {
        let hello = AppHello {
            protocol: PROTOCOL_VERSION,
            name: format!("app-{index}"),
            weight: 1.0 + f64::from(u32::try_from(index).expect("few applications")),
            global_stealing,
            policy: String::new(),
            resume: None,
        };
        Self {
            ledger: Ledger::new(hello),
            control: None,
            nodes: BTreeMap::new(),
            programs: BTreeSet::new(),
            payloads: BTreeMap::new(),
            endings: BTreeMap::new(),
            expected: 0,
            waits: 0,
            finished: false,
        }
    }

    pub(crate) fn is_done(&self) -> bool {
        self.endings.len() == self.expected
    }

    pub(crate) fn assert_empty(&self) {
        assert!(self.programs.is_empty(), "I8: a program is kept: {:?}", self.programs.first());
        assert!(self.payloads.is_empty(), "I8: a payload is kept: {:?}", self.payloads.first_key_value());
    }
}

/// I3: the payload is a function of the job alone.
fn digest(job: JobId) -> ContentHash {
    let mut hash = [7; 32];
    hash[..4].copy_from_slice(&job.index.0.to_le_bytes());
    hash[4..8].copy_from_slice(&job.task.0.to_le_bytes());
    hash[8..16].copy_from_slice(&job.app.0.to_le_bytes());
    ContentHash(hash)
}

/// Device time at speed 1.0: 0.1 to 20 ms, by a hash of the index.
pub(crate) fn cost_ns(index: JobIndex) -> u64 {
    100_000 + u64::from(index.0.wrapping_mul(2_654_435_761) % 19_900) * 1_000
}

impl World {
    pub(crate) fn coordinator_event(&mut self, event: coordinator::Event) {
        self.coordinator.handle(self.now, event);
        self.coordinator_settles();
    }

    pub(crate) fn coordinator_settles(&mut self) {
        self.coordinator.check_invariants();
        while let Some(effect) = self.coordinator.poll_effect() {
            self.log(Proc::Coordinator, &effect);
            match effect {
                CoordinatorEffect::ToApp { link, message } => {
                    self.send(Proc::Coordinator, link, Message::CoordinatorToApp(message));
                }
                CoordinatorEffect::ToNode { link, message } => {
                    self.send(Proc::Coordinator, link, Message::CoordinatorToNode(message));
                }
                CoordinatorEffect::Close { link } => self.hang_up(Proc::Coordinator, link),
                CoordinatorEffect::AskPolicy { plugin, .. } => panic!("nobody chose {plugin}"),
            }
        }
    }

    // ------------------------------------------------------------------ workers

    pub(crate) fn worker_hears_app(&mut self, index: usize, link: LinkId, message: AppToNode) {
        if let AppToNode::Jobs(tickets) = &message {
            self.workers[index].programs.extend(tickets.iter().map(|ticket| ticket.job));
        }
        self.worker_event(index, worker::Event::FromApp { link, message });
    }

    pub(crate) fn worker_event(&mut self, index: usize, event: worker::Event) {
        let now = self.now;
        if !self.workers[index].is_up() {
            return;
        }
        self.workers[index].machine_mut().handle(now, event);
        self.worker_settles(index);
    }

    pub(crate) fn worker_settles(&mut self, index: usize) {
        self.workers[index].machine_mut().check_invariants();
        let machine = self.workers[index].machine_mut();
        let effects: Vec<WorkerEffect> = std::iter::from_fn(|| machine.poll_effect()).collect();
        for effect in effects {
            self.log(Proc::Worker(index), &effect);
            self.worker_effect(index, effect);
        }
    }

    fn worker_effect(&mut self, index: usize, effect: WorkerEffect) {
        let proc = Proc::Worker(index);
        match effect {
            WorkerEffect::ToCoordinator(message) => {
                if let Some(link) = self.workers[index].control {
                    self.send(proc, link, Message::NodeToCoordinator(message));
                }
            }
            WorkerEffect::ToApp { link, message } => {
                if let NodeToApp::Result(header) = &message
                    && header.outcome.is_ok()
                {
                    let payload = self.workers[index].payloads.get(&header.job);
                    assert_eq!(payload, Some(&header.digest), "{} is sent without its payload", header.job);
                }
                self.send(proc, link, Message::NodeToApp(message));
            }
            WorkerEffect::CloseApp { link } => self.hang_up(proc, link),
            WorkerEffect::Fetch { content, link } => self.fetch(index, content.hash, link),
            WorkerEffect::Execute { job, device, .. } => self.execute(index, job, device),
            WorkerEffect::Abort { job, device } => self.abort(index, job, device),
            WorkerEffect::Discard(job) => {
                self.workers[index].programs.remove(&job);
                self.workers[index].payloads.remove(&job);
            }
            WorkerEffect::Release(content) => {
                self.workers[index].cache.remove(&content);
            }
            WorkerEffect::Exit => self.stop_worker(index),
        }
    }

    pub(crate) fn stop_worker(&mut self, index: usize) {
        // What was said before still arrives; then everybody learns that the process is gone.
        for link in self.links_of(Proc::Worker(index)) {
            self.hang_up(Proc::Worker(index), link);
        }
        self.workers[index].stop();
    }

    fn fetch(&mut self, index: usize, hash: ContentHash, link: LinkId) {
        let host = &mut self.workers[index];
        let life = host.life;
        let fails =
            self.work.fetch_fails_one_in > 0 && self.rng.random_ratio(1, self.work.fetch_fails_one_in);
        let cached = host.cache.contains(&hash);
        let event = if cached || (self.is_open(link) && !fails) {
            self.workers[index].cache.insert(hash);
            worker::Event::ContentReady(hash)
        } else {
            worker::Event::ContentFailed { content: hash, reason: "simulated".to_owned() }
        };
        let delay = Duration::from_micros(if cached { 0 } else { self.rng.random_range(100..20_000) });
        self.after(delay, Happening::Worker { worker: index, life, event });
    }

    fn execute(&mut self, index: usize, job: JobAttempt, device: DeviceIndex) {
        let host = &mut self.workers[index];
        assert!(host.programs.contains(&job), "{job} is executed without its program");
        let newest = host.newest.entry(job.job).or_insert(job.attempt);
        assert!(*newest <= job.attempt, "I4: {job} is executed after {newest}");
        *newest = job.attempt;
        let executor = &mut host.devices[usize::from(device.0)];
        assert!(!executor.lost, "{job} is given to a lost device");
        assert!(executor.staged.is_empty(), "{device} has a staged job already");
        executor.staged.push_back(job);
        self.run_next(index, usize::from(device.0));
    }

    fn run_next(&mut self, index: usize, device: usize) {
        let host = &mut self.workers[index];
        let executor = &mut host.devices[device];
        if executor.running.is_some() {
            return;
        }
        let Some(job) = executor.staged.pop_front() else { return };
        host.next_run += 1;
        let run = host.next_run;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "milliseconds, far from the limits"
        )]
        let duration = Duration::from_nanos((cost_ns(job.job.index) as f64 / host.speeds[device]) as u64);
        executor.running = Some((job, run, duration));
        let life = host.life;
        *self.work.runs.entry(job.job).or_default() += 1;
        let device_index = DeviceIndex(u16::try_from(device).expect("few devices"));
        let started = worker::Event::Started { job, device: device_index };
        self.after(Duration::ZERO, Happening::Worker { worker: index, life, event: started });
        self.after(duration, Happening::JobDone { worker: index, life, device, run });
    }

    pub(crate) fn job_done(&mut self, index: usize, device: usize, run: u64) {
        let executor = &mut self.workers[index].devices[device];
        let Some((job, _, duration)) = executor.running.take_if(|(_, current, _)| *current == run) else {
            return;
        };
        let crashes = self.work.crash_one_in > 0 && self.rng.random_ratio(1, self.work.crash_one_in);
        let outcome = if self.work.poison.contains(&job.job.task) || crashes {
            Err(JobFailure::Timeout)
        } else if self.work.invalid.contains(&job.job.task) {
            Err(JobFailure::InvalidProgram("simulated".to_owned()))
        } else {
            self.workers[index].payloads.insert(job, digest(job.job));
            Ok((vec![4, u64::from(job.job.index.0) * 4], digest(job.job)))
        };
        self.run_next(index, device);
        let device = DeviceIndex(u16::try_from(device).expect("few devices"));
        let device_time_ns = u64::try_from(duration.as_nanos()).expect("short");
        self.worker_event(index, worker::Event::Executed { job, device, device_time_ns, outcome });
    }

    fn abort(&mut self, index: usize, job: JobAttempt, device: DeviceIndex) {
        let host = &mut self.workers[index];
        let executor = &mut host.devices[usize::from(device.0)];
        executor.staged.retain(|staged| *staged != job);
        if executor.running.take_if(|(running, _, _)| *running == job).is_none() {
            return;
        }
        let life = host.life;
        let event =
            worker::Event::Executed { job, device, device_time_ns: 0, outcome: Err(JobFailure::Cancelled) };
        self.after(Duration::from_micros(10), Happening::Worker { worker: index, life, event });
        self.run_next(index, usize::from(device.0));
    }

    pub(crate) fn lose_device(&mut self, index: usize, device: usize) {
        let host = &mut self.workers[index];
        let Some(executor) = host.devices.get_mut(device).filter(|executor| !executor.lost) else { return };
        *executor = Executor { lost: true, ..Executor::default() };
        let device = DeviceIndex(u16::try_from(device).expect("few devices"));
        self.worker_event(index, worker::Event::DeviceLost { device, reason: "simulated".to_owned() });
    }

    // ------------------------------------------------------------------ applications

    pub(crate) fn app_hears_node(
        &mut self,
        index: usize,
        node: NodeId,
        session: NodeSession,
        message: NodeToApp,
    ) {
        if let NodeToApp::Result(header) = &message {
            if header.outcome.is_ok() {
                assert_eq!(header.digest, digest(header.job.job), "I3: {} has another payload", header.job);
            }
            *self.apps[index].payloads.entry((header.job, header.digest)).or_default() += 1;
        }
        self.app_event(index, ledger::Event::FromNode { node, session, message });
    }

    pub(crate) fn app_event(&mut self, index: usize, event: ledger::Event) {
        let host = &mut self.apps[index];
        match &event {
            ledger::Event::Submitted { task, jobs, .. } => {
                host.programs.extend(jobs.iter().map(|job| (*task, job.index)));
            }
            ledger::Event::Finished => host.finished = true,
            _ => {}
        }
        host.ledger.handle(self.now, event);
        self.app_settles(index);
    }

    pub(crate) fn app_settles(&mut self, index: usize) {
        self.apps[index].ledger.check_invariants();
        while let Some(effect) = self.apps[index].ledger.poll_effect() {
            self.log(Proc::App(index), &effect);
            self.app_effect(index, effect);
        }
        self.apps[index].ledger.check_invariants();
    }

    fn app_effect(&mut self, index: usize, effect: LedgerEffect) {
        let proc = Proc::App(index);
        let host = &mut self.apps[index];
        match effect {
            LedgerEffect::ToCoordinator(message) => {
                if let Some(link) = host.control {
                    self.send(proc, link, Message::AppToCoordinator(message));
                }
            }
            LedgerEffect::Connect { node, session, contact } => {
                self.dial_node(index, node, session, &contact.addresses[0]);
            }
            LedgerEffect::ToNode { node, session, message } => {
                if let AppToNode::Jobs(tickets) = &message {
                    for ticket in tickets {
                        let key = (ticket.job.job.task, ticket.job.job.index);
                        assert!(host.programs.contains(&key), "{} is sent without its program", ticket.job);
                    }
                }
                if let Some(&link) = host.nodes.get(&(node, session)) {
                    self.send(proc, link, Message::AppToNode(message));
                }
            }
            LedgerEffect::Disconnect { node, session } => {
                if let Some(link) = host.nodes.remove(&(node, session)) {
                    self.hang_up(proc, link);
                }
            }
            LedgerEffect::Deliver { job, node, .. } => {
                self.take_payload(index, job, digest(job.job));
                self.end(index, job.job, Ending::Delivered(node));
            }
            LedgerEffect::Fail { job, failure } => self.end(index, job, Ending::Failed(failure)),
            LedgerEffect::Waiting { .. } => host.waits += 1,
            LedgerEffect::ForgetProgram(job) => {
                assert!(host.programs.remove(&(job.task, job.index)), "{job}'s program is forgotten twice");
            }
            LedgerEffect::DropPayload { job, digest } => self.take_payload(index, job, digest),
            LedgerEffect::Refused { reason } => panic!("application {index} was refused: {reason}"),
        }
    }

    fn take_payload(&mut self, index: usize, job: JobAttempt, digest: ContentHash) {
        let payloads = &mut self.apps[index].payloads;
        let Some(count) = payloads.get_mut(&(job, digest)) else { panic!("{job} has no payload") };
        *count -= 1;
        if *count == 0 {
            payloads.remove(&(job, digest));
        }
    }

    fn end(&mut self, index: usize, job: JobId, ending: Ending) {
        let before = self.apps[index].endings.insert((job.task, job.index), ending.clone());
        assert_eq!(before, None, "I2: {job} ended twice, now {ending:?}");
    }
}
