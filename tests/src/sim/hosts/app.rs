//! An application's process, and the journal that survives it.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use farm_core::{
    device::Requirements,
    id::{
        AppId, AppIncarnation, ContentHash, JobAttempt, JobId, JobIndex, LinkId, NodeId, NodeSession, TaskId,
    },
    ledger::{Effect, Event, Ledger, SubmittedJob},
    message::{AppHello, AppToNode, CoordinatorToApp, JobFailure, NodeToApp, PROTOCOL_VERSION},
    time::Instant,
};

use crate::sim::{
    auditor::worker_at,
    clock::Clock,
    faults::Fault,
    network::{Message, Proc},
    work::digest,
    world::{Happening, Setup, World},
};

/// How a job ended, as its application saw it.
#[derive(Clone, Debug, PartialEq)]
pub enum Ending {
    /// With a result, computed by this node.
    Delivered(NodeId),
    /// Without one.
    Failed(JobFailure),
}

/// How an application's process stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Up,
    /// It vanished, and comes back.
    Down,
    /// It vanished for good.
    Gone,
    /// It said goodbye.
    Finished,
}

/// An application's process.
#[derive(Debug)]
pub struct AppHost {
    index: usize,
    /// Its machine; while the process is down, that of its last life.
    pub ledger: Ledger,
    /// How its jobs ended; it survives the process.
    pub endings: BTreeMap<(TaskId, JobIndex), Ending>,
    /// Jobs that it submits, now or later.
    pub expected: usize,
    /// How often it was told that a batch waits.
    pub waits: usize,
    /// Tasks that it gave up.
    pub(in crate::sim) cancelled: BTreeSet<TaskId>,
    pub(in crate::sim) life: u32,
    clock: Clock,
    state: State,
    global_stealing: bool,
    policy: &'static str,
    /// It reads no results before.
    pub(in crate::sim) deaf_until: Instant,
    pub(in crate::sim) control: Option<LinkId>,
    pub(in crate::sim) nodes: BTreeMap<(NodeId, NodeSession), LinkId>,
    /// Nodes that it dials.
    pub(in crate::sim) dialling: BTreeSet<(NodeId, NodeSession)>,
    programs: BTreeSet<(TaskId, JobIndex)>,
    payloads: BTreeMap<(JobAttempt, ContentHash), u32>,
    /// Who the coordinator said it is; it survives the process.
    identity: Option<(AppId, AppIncarnation)>,
    /// What was submitted so far; it survives the process.
    submitted: Vec<Submission>,
}

#[derive(Clone, Debug)]
struct Submission {
    task: TaskId,
    jobs: Vec<SubmittedJob>,
    needs: Requirements,
}

impl AppHost {
    pub(in crate::sim) fn new(index: usize, setup: &Setup, clock: Clock) -> Self {
        let (global_stealing, policy) = (setup.global_stealing, setup.policy);
        Self {
            index,
            ledger: Ledger::new(hello(index, global_stealing, policy, None)),
            endings: BTreeMap::new(),
            expected: 0,
            waits: 0,
            cancelled: BTreeSet::new(),
            life: 0,
            clock,
            state: State::Up,
            global_stealing,
            policy,
            deaf_until: Instant::ZERO,
            control: None,
            nodes: BTreeMap::new(),
            dialling: BTreeSet::new(),
            programs: BTreeSet::new(),
            payloads: BTreeMap::new(),
            identity: None,
            submitted: Vec::new(),
        }
    }

    /// Every job ended and it is there to say goodbye, or nobody waits for any.
    #[must_use]
    pub fn is_done(&self) -> bool {
        match self.state {
            State::Up => self.endings.len() == self.expected,
            State::Down => false,
            State::Gone | State::Finished => true,
        }
    }

    /// Whether there is a process.
    #[must_use]
    pub fn is_up(&self) -> bool {
        match self.state {
            State::Up | State::Finished => true,
            State::Down | State::Gone => false,
        }
    }

    /// Whether it is there and wants to be connected to the coordinator.
    pub(in crate::sim) fn is_active(&self) -> bool {
        self.state == State::Up
    }

    pub(in crate::sim) const fn allows_stealing(&self) -> bool {
        self.global_stealing
    }

    pub(in crate::sim) fn timeout(&self) -> Option<Instant> {
        self.is_up().then(|| self.ledger.poll_timeout()).flatten().map(|due| self.clock.reaches(due))
    }

    pub(in crate::sim) fn kept(&self) -> usize {
        self.programs.len() + self.payloads.len()
    }

    /// I8: at quiescence nothing is kept.
    pub(in crate::sim) fn assert_empty(&self) {
        assert!(self.programs.is_empty(), "I8: a program is kept: {:?}", self.programs.first());
        assert!(self.payloads.is_empty(), "I8: a payload is kept: {:?}", self.payloads.first_key_value());
    }
}

fn hello(
    index: usize,
    global_stealing: bool,
    policy: &str,
    resume: Option<(AppId, AppIncarnation)>,
) -> AppHello {
    AppHello {
        protocol: PROTOCOL_VERSION,
        name: format!("app-{index}"),
        weight: 1.0 + f64::from(u32::try_from(index).expect("few applications")),
        global_stealing,
        policy: policy.to_owned(),
        resume,
    }
}

impl World {
    pub(in crate::sim) fn app_hears_coordinator(&mut self, index: usize, message: CoordinatorToApp) {
        if let CoordinatorToApp::Welcome { app, incarnation, .. } = &message {
            self.audit.named(index, *app);
            let identity = Some((*app, *incarnation));
            if std::mem::replace(&mut self.apps[index].identity, identity) != identity {
                self.audit.forgotten(*app);
            }
        }
        if let CoordinatorToApp::Plan(plan) = &message {
            self.diary.told(plan);
        }
        self.app_event(index, Event::FromCoordinator(message));
    }

    pub(in crate::sim) fn app_hears_node(
        &mut self,
        index: usize,
        node: NodeId,
        session: NodeSession,
        message: NodeToApp,
    ) {
        if let NodeToApp::Result(header) = &message {
            self.diary.arrives(self.now, header.job);
            if header.outcome.is_ok() {
                assert_eq!(header.digest, digest(header.job.job), "I3: {} has another payload", header.job);
            }
            *self.apps[index].payloads.entry((header.job, header.digest)).or_default() += 1;
        }
        self.app_event(index, Event::FromNode { node, session, message });
    }

    /// Something happens to an application. While its process is down only its journal hears of it.
    pub fn app_event(&mut self, index: usize, event: Event) {
        let host = &mut self.apps[index];
        if let Event::Submitted { task, jobs, needs } = &event {
            host.submitted.push(Submission { task: *task, jobs: jobs.clone(), needs: *needs });
        }
        if !host.is_up() {
            return;
        }
        match &event {
            Event::Submitted { task, jobs, .. } => {
                host.programs.extend(jobs.iter().map(|job| (*task, job.index)));
            }
            Event::Cancelled(task) => {
                host.cancelled.insert(*task);
            }
            Event::Finished => host.state = State::Finished,
            _ => {}
        }
        host.ledger.handle(host.clock.shows(self.now), event);
        self.app_settles(index);
    }

    pub(in crate::sim) fn app_timeout(&mut self, index: usize) {
        let host = &mut self.apps[index];
        host.ledger.handle_timeout(host.clock.shows(self.now));
        self.app_settles(index);
    }

    fn app_settles(&mut self, index: usize) {
        let due = self.audit.is_due();
        if due {
            self.apps[index].ledger.check_invariants();
        }
        while let Some(effect) = self.apps[index].ledger.poll_effect() {
            self.log.enter(self.now, Proc::App(index), &effect);
            self.app_effect(index, effect);
        }
        // Polling puts messages together.
        if due {
            self.apps[index].ledger.check_invariants();
        }
        self.rearm(Proc::App(index));
    }

    /// It reads no results for a while.
    pub(in crate::sim) fn deafen(&mut self, index: usize, duration: Duration) {
        let until = self.now.after(duration);
        self.apps[index].deaf_until = until;
        self.audit.disturbed(until, Proc::App(index), Proc::App(index));
    }

    /// The process is gone, without a word. It comes back after a while, if at all.
    pub fn vanish_app(&mut self, index: usize, back: Option<Duration>) {
        if !self.apps[index].is_active() {
            return;
        }
        self.audit.disturbed(self.now, Proc::App(index), Proc::App(index));
        for link in self.links_of(Proc::App(index)) {
            self.drop_link(link);
        }
        let host = &mut self.apps[index];
        host.life += 1;
        host.state = if back.is_some() { State::Down } else { State::Gone };
        host.control = None;
        host.nodes.clear();
        host.dialling.clear();
        host.programs.clear();
        host.payloads.clear();
        self.rearm(Proc::App(index));
        if let Some(pause) = back {
            self.after(pause, Happening::Fault(Fault::Return { app: index }));
        }
    }

    /// A vanished application starts again, and submits what its journal says is open.
    pub(in crate::sim) fn return_app(&mut self, index: usize) {
        if self.apps[index].state != State::Down {
            return;
        }
        let clock = self.new_clock();
        let host = &mut self.apps[index];
        host.state = State::Up;
        host.clock = clock;
        let hello = hello(host.index, host.global_stealing, host.policy, host.identity);
        host.ledger = Ledger::resumed(hello, host.ledger.next_batch());
        for Submission { task, mut jobs, needs } in std::mem::take(&mut host.submitted) {
            jobs.retain(|job| !self.apps[index].endings.contains_key(&(task, job.index)));
            self.app_event(index, Event::Submitted { task, jobs, needs });
        }
        let life = self.apps[index].life;
        self.after(Duration::ZERO, Happening::Dial { proc: Proc::App(index), life });
    }

    fn app_effect(&mut self, index: usize, effect: Effect) {
        let proc = Proc::App(index);
        let host = &mut self.apps[index];
        match effect {
            Effect::ToCoordinator(message) => {
                if let Some(link) = host.control {
                    self.send(proc, link, Message::AppToCoordinator(message));
                }
            }
            Effect::Connect { node, session, contact } => {
                host.dialling.insert((node, session));
                self.dial_node(index, node, session, worker_at(&contact.addresses[0]));
            }
            Effect::ToNode { node, session, message } => {
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
            Effect::Disconnect { node, session } => {
                host.dialling.remove(&(node, session));
                if let Some(link) = host.nodes.remove(&(node, session)) {
                    self.hang_up(proc, link);
                }
            }
            Effect::Deliver { job, node, .. } => {
                self.take_payload(index, job, digest(job.job));
                self.diary.counts(job);
                self.end(index, job.job, Ending::Delivered(node));
            }
            Effect::Fail { job, failure } => self.end(index, job, Ending::Failed(failure)),
            Effect::Waiting { .. } => host.waits += 1,
            Effect::ForgetProgram(job) => {
                assert!(host.programs.remove(&(job.task, job.index)), "{job}'s program is forgotten twice");
            }
            Effect::DropPayload { job, digest } => self.take_payload(index, job, digest),
            Effect::Refused { reason } => panic!("application {index} was refused: {reason}"),
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
        self.audit.ends(job, &ending, self.setup.max_crashes);
        self.diary.ends(self.now, job);
        let before = self.apps[index].endings.insert((job.task, job.index), ending.clone());
        assert_eq!(before, None, "I2: {job} ended twice, now {ending:?}");
    }
}
