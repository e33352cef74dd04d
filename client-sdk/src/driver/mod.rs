//! The task that owns the application's ledger: it turns what the coordinator, the nodes and the runs say into events,
//! and carries the ledger's effects out. It decides nothing about jobs, and never calls the application's code.

mod coordinator;
mod links;
mod runs;

use std::{
    collections::{HashMap, VecDeque},
    ops::Range,
    sync::mpsc as std_mpsc,
    time::Duration,
};

use bytes::Bytes;
use farm_core::{
    device::Requirements,
    id::{AppId, JobAttempt, JobIndex, NodeId, TaskId},
    ledger::{Effect, Event, Ledger, SubmittedJob},
    message::{AppHello, AppToCoordinator, CoordinatorToApp, NodeToApp},
    time,
};
use proto::{
    control::{Session, SessionError},
    link::{ContentSource, LinkSender},
};
use tokio::{
    sync::{mpsc, oneshot, watch},
    task::JoinSet,
    time::Instant,
};

use self::{
    coordinator::{Coordinator, GaveUp},
    links::{LinkKey, Links, Received},
    runs::Runs,
};
use crate::{
    error::FarmError,
    options::FarmOptions,
    progress::{CoordinatorLink, Progress},
    run::{Arrival, Payload, RunEnd, RunEvent},
};

/// Inputs that wait for the owner task, at most; further senders wait.
const QUEUED_INPUTS: usize = 1_024;
/// Inputs taken in before effects are carried out.
const INPUTS_PER_TURN: usize = 128;
/// How long `close` waits for the coordinator to end the session after the goodbye.
const GOODBYE_TIMEOUT: Duration = Duration::from_secs(1);

/// An application's session with its coordinator.
pub(crate) type AppSession = Session<AppToCoordinator, CoordinatorToApp>;
/// A job inside this application: stays the same when a restarted coordinator gives the application another id.
type JobKey = (TaskId, JobIndex);

/// What the owner task hears.
pub(crate) enum Input {
    /// A run wants to hear of its tasks.
    RunStarted { tasks: Range<u32>, events: std_mpsc::Sender<RunEvent>, acknowledge: Acknowledge },
    /// A run goes on for an earlier application.
    Supersedes(AppId),
    /// Results of a run are in its journal.
    Kept(Vec<JobKey>),
    /// A batch of a run.
    Submitted(Submission),
    /// A run has ended, in whatever way.
    RunOver { tasks: Range<u32> },
    /// A try to reach the coordinator again is through.
    CoordinatorTried(Result<AppSession, SessionError>),
    /// The coordinator said something in session `serial`.
    CoordinatorSaid { serial: u64, message: CoordinatorToApp },
    /// Session `serial` is over.
    CoordinatorEnded { serial: u64, error: SessionError },
    /// A link to a node stands.
    NodeConnected { key: LinkKey, sender: LinkSender<farm_core::message::AppToNode> },
    /// A node said this, in order; payloads are checked against their headers.
    NodeSaid { key: LinkKey, received: Vec<Received> },
    /// A link to a node could not be made, or is over.
    NodeEnded { key: LinkKey, reason: String },
}

/// When a run's results are acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Acknowledge {
    /// As they come.
    AtOnce,
    /// When they are in the run's journal.
    WhenKept,
}

/// A batch of one task's jobs with their programs, in the same order.
#[derive(Debug)]
pub(crate) struct Submission {
    pub(crate) task: TaskId,
    pub(crate) jobs: Vec<SubmittedJob>,
    pub(crate) programs: Vec<Bytes>,
    pub(crate) needs: Requirements,
}

/// Speaks to the owner task from a run's thread.
#[derive(Clone, Debug)]
pub(crate) struct DriverHandle {
    inputs: mpsc::Sender<Input>,
}

impl DriverHandle {
    pub(crate) fn new() -> (Self, mpsc::Receiver<Input>) {
        let (inputs, receiver) = mpsc::channel(QUEUED_INPUTS);
        (Self { inputs }, receiver)
    }

    /// From an async task: announces a run.
    pub(crate) async fn start_run(
        &self,
        tasks: Range<u32>,
        events: std_mpsc::Sender<RunEvent>,
        acknowledge: Acknowledge,
    ) -> Result<(), FarmError> {
        let started = Input::RunStarted { tasks, events, acknowledge };
        self.inputs.send(started).await.map_err(|_| FarmError::Closed)
    }

    /// From an async task: takes the announcement back.
    pub(crate) async fn abandon_run(&self, tasks: Range<u32>) {
        // Without a driver there is nothing left to tell.
        let _ = self.inputs.send(Input::RunOver { tasks }).await;
    }

    /// From a thread: submits a batch.
    pub(crate) fn submit(&self, submission: Submission) -> Result<(), FarmError> {
        self.inputs.blocking_send(Input::Submitted(submission)).map_err(|_| FarmError::Closed)
    }

    /// From a thread: says which application a run goes on for. Jobs are submitted after it.
    pub(crate) fn supersedes(&self, predecessor: AppId) -> Result<(), FarmError> {
        self.inputs.blocking_send(Input::Supersedes(predecessor)).map_err(|_| FarmError::Closed)
    }

    /// From a thread: says that results are safe.
    pub(crate) fn kept(&self, jobs: Vec<JobKey>) {
        // Without a driver there is nobody to acknowledge them to.
        let _ = self.inputs.blocking_send(Input::Kept(jobs));
    }

    /// From a thread: says that nobody listens for these tasks any more.
    pub(crate) fn run_over(&self, tasks: Range<u32>) {
        // Without a driver there is nothing left to tell.
        let _ = self.inputs.blocking_send(Input::RunOver { tasks });
    }
}

/// What a driver is made of.
pub(crate) struct DriverSetup {
    pub(crate) options: FarmOptions,
    pub(crate) handle: DriverHandle,
    pub(crate) inputs: mpsc::Receiver<Input>,
    pub(crate) session: AppSession,
    /// Hears whether the coordinator takes the application.
    pub(crate) registered: oneshot::Sender<Result<AppId, FarmError>>,
    pub(crate) contents: ContentSource,
    pub(crate) progress: watch::Sender<Progress>,
    pub(crate) stop: watch::Receiver<bool>,
    /// Resolves when the farm is closed or dropped.
    pub(crate) closing: oneshot::Receiver<()>,
}

/// The owner of the ledger.
struct Driver {
    ledger: Ledger,
    /// Origin of the ledger's time.
    origin: Instant,
    options: FarmOptions,
    coordinator: Coordinator,
    links: Links,
    runs: Runs,
    /// Encoded programs of jobs that may have to be sent (again).
    programs: HashMap<JobKey, Bytes>,
    /// Payloads of the results handed to the ledger in this turn, in that order: it answers each with `Deliver` or
    /// `DropPayload`.
    payloads: VecDeque<(JobAttempt, Payload)>,
    registered: Option<oneshot::Sender<Result<AppId, FarmError>>>,
    /// Why nothing further will work.
    over: Option<Over>,
    progress: watch::Sender<Progress>,
    closing_links: JoinSet<()>,
}

/// Why a connection cannot go on.
enum Over {
    Refused { reason: String },
    Lost(GaveUp),
}

/// Runs the owner task until the farm is closed.
pub(crate) async fn drive(setup: DriverSetup) {
    let DriverSetup {
        options,
        handle,
        mut inputs,
        session,
        registered,
        contents,
        progress,
        mut stop,
        mut closing,
    } = setup;
    let hello = AppHello {
        protocol: farm_core::message::PROTOCOL_VERSION,
        name: options.name.clone(),
        weight: options.weight,
        global_stealing: options.global_stealing,
        policy: options.policy.clone(),
        resume: None,
    };
    let links =
        Links::new(handle.inputs.clone(), contents, options.window.result_bytes, options.identity.clone());
    let coordinator = Coordinator::new(
        options.coordinator.clone(),
        options.identity.clone(),
        options.reconnect_timeout,
        handle.inputs,
    );
    let mut driver = Driver {
        ledger: Ledger::new(hello),
        origin: Instant::now(),
        runs: Runs::new(options.patience),
        options,
        coordinator,
        links,
        programs: HashMap::new(),
        payloads: VecDeque::new(),
        registered: Some(registered),
        over: None,
        progress,
        closing_links: JoinSet::new(),
    };
    driver.coordinator_connected(session);
    driver.carry_out();
    let mut taken = Vec::with_capacity(INPUTS_PER_TURN);
    loop {
        let wake = driver.next_wake();
        tokio::select! {
            biased;
            _ = &mut closing => return driver.shut_down(inputs).await,
            Ok(()) = stop.changed() => driver.runs.stop(),
            _ = inputs.recv_many(&mut taken, INPUTS_PER_TURN) => {}
            () = sleep_until(wake), if wake.is_some() => {}
        }
        for input in taken.drain(..) {
            driver.take(input);
        }
        driver.act_on_timers();
        driver.carry_out();
        driver.publish();
    }
}

async fn sleep_until(wake: Option<Instant>) {
    if let Some(wake) = wake {
        tokio::time::sleep_until(wake).await;
    }
}

impl Driver {
    fn now(&self) -> time::Instant {
        time::Instant::ZERO.after(self.origin.elapsed())
    }

    fn tell_ledger(&mut self, event: Event) {
        self.ledger.handle(self.now(), event);
    }

    fn next_wake(&self) -> Option<Instant> {
        let ledger = self.ledger.poll_timeout().map(|at| self.origin + at.since(time::Instant::ZERO));
        [ledger, self.coordinator.next_wake(), self.runs.next_wake()].into_iter().flatten().min()
    }

    fn take(&mut self, input: Input) {
        match input {
            Input::RunStarted { tasks, events, acknowledge } => {
                if acknowledge == Acknowledge::WhenKept {
                    tasks.clone().for_each(|task| self.tell_ledger(Event::Journalled(TaskId(task))));
                }
                let refused = self.over.as_ref().map(|over| RunEnd::Farm(over.error(&self.options)));
                self.runs.start(tasks, events, refused);
            }
            Input::Supersedes(predecessor) => self.tell_ledger(Event::Supersedes(predecessor)),
            Input::Kept(jobs) => {
                for (task, index) in jobs {
                    self.tell_ledger(Event::Kept { task, index });
                }
            }
            Input::Submitted(submission) => self.submitted(submission),
            Input::RunOver { tasks } => self.run_over(tasks),
            Input::CoordinatorTried(outcome) => match outcome {
                _ if !self.coordinator.is_trying() => {}
                Ok(session) => self.coordinator_connected(session),
                Err(error) => self.coordinator.lost(&error, Instant::now()),
            },
            Input::CoordinatorSaid { serial, message } => {
                if self.coordinator.is_current(serial) {
                    self.coordinator_said(message);
                }
            }
            Input::CoordinatorEnded { serial, error } => {
                // What was said before the end comes first: a refusal is the reason of the end.
                self.carry_out();
                if self.coordinator.is_current(serial) {
                    self.coordinator_lost(error);
                }
            }
            Input::NodeConnected { key, sender } => {
                if self.links.connected(key, sender) {
                    self.tell_ledger(Event::NodeConnected { node: key.node, session: key.session });
                }
            }
            Input::NodeSaid { key, received } => self.node_said(key, received),
            Input::NodeEnded { key, reason } => {
                if self.links.ended(key) {
                    tracing::info!(node = %key.node, reason, "link to a node ended");
                    self.not_reached(key.node, &reason);
                    self.tell_ledger(Event::NodeLost { node: key.node, session: key.session });
                }
            }
        }
    }

    fn submitted(&mut self, submission: Submission) {
        let Submission { task, jobs, programs, needs } = submission;
        if !self.runs.is_running(task) || self.over.is_some() {
            return;
        }
        self.programs.extend(jobs.iter().map(|job| (task, job.index)).zip(programs));
        self.tell_ledger(Event::Submitted { task, jobs, needs });
    }

    fn run_over(&mut self, tasks: Range<u32>) {
        self.runs.over(&tasks);
        // A task without open jobs is nothing to the ledger.
        for task in tasks {
            self.tell_ledger(Event::Cancelled(TaskId(task)));
        }
    }

    fn coordinator_connected(&mut self, session: AppSession) {
        self.coordinator.connected(session);
        self.tell_ledger(Event::CoordinatorConnected);
    }

    fn coordinator_said(&mut self, message: CoordinatorToApp) {
        if let CoordinatorToApp::Capability(bytes) = message {
            let bytes = Bytes::from(bytes);
            self.coordinator.keep(bytes.clone());
            self.links.show(bytes);
            return;
        }
        match &message {
            CoordinatorToApp::Welcome { app, .. } => {
                tracing::debug!(%app, "registered");
                self.coordinator.welcomed();
                self.answer_registration(Ok(*app));
            }
            CoordinatorToApp::Plan(plan) => self.runs.planned(plan),
            CoordinatorToApp::Refused { .. }
            | CoordinatorToApp::Waiting { .. }
            | CoordinatorToApp::JobFailed { .. }
            | CoordinatorToApp::Stopped { .. }
            | CoordinatorToApp::HeartbeatAck { .. }
            | CoordinatorToApp::Capability(_) => {}
        }
        self.tell_ledger(Event::FromCoordinator(message));
    }

    fn coordinator_lost(&mut self, error: SessionError) {
        tracing::warn!(%error, "the coordinator is lost, trying again");
        let address = self.options.coordinator.clone();
        let failure = || match &error {
            SessionError::Denied { reason } => {
                FarmError::Denied { address: address.clone(), reason: reason.clone() }
            }
            error => FarmError::Unreachable { address: address.clone(), reason: error.to_string() },
        };
        self.answer_registration(Err(failure()));
        if matches!(error, SessionError::Denied { .. }) {
            // It is there, and will say the same again.
            self.runs.end_all(|| RunEnd::Farm(failure()));
        }
        self.coordinator.lost(&error, Instant::now());
        self.tell_ledger(Event::CoordinatorLost);
    }

    fn answer_registration(&mut self, answer: Result<AppId, FarmError>) {
        if let Some(registered) = self.registered.take() {
            // Whoever asked may have given up; the farm is dropped then, and this task ends.
            let _ = registered.send(answer);
        }
    }

    fn node_said(&mut self, key: LinkKey, received: Vec<Received>) {
        if !self.links.is_current(key) {
            return;
        }
        let now = self.now();
        for Received { message, payload } in received {
            match &message {
                NodeToApp::Result(header) => self.payloads.push_back((header.job, payload)),
                NodeToApp::Welcome { .. } => {
                    self.links.welcomed(key);
                    self.runs.reached();
                }
                NodeToApp::Refused { reason } => self.not_reached(key.node, reason),
                NodeToApp::Inventory(_) => {}
            }
            self.ledger.handle(now, Event::FromNode { node: key.node, session: key.session, message });
        }
    }

    fn act_on_timers(&mut self) {
        let now = self.now();
        if self.ledger.poll_timeout().is_some_and(|at| at <= now) {
            self.ledger.handle_timeout(now);
        }
        let wall = Instant::now();
        if let Some(gave_up) = self.coordinator.act_on_timers(wall) {
            self.end(Over::Lost(gave_up));
        }
        self.runs.act_on_timers(wall);
    }

    /// Carries out everything that the ledger wants done.
    fn carry_out(&mut self) {
        while let Some(effect) = self.ledger.poll_effect() {
            match effect {
                Effect::ToCoordinator(message) => {
                    if let AppToCoordinator::Plan(request) = &message {
                        self.runs.asked(request);
                    }
                    if let Err(error) = self.coordinator.send(message) {
                        self.coordinator_lost(error);
                    }
                }
                Effect::Connect { node, session, contact } => self.links.connect(node, session, contact),
                Effect::ToNode { node, session, message } => {
                    self.links.send(node, session, message, &self.programs)
                }
                Effect::Disconnect { node, session } => {
                    if self.links.is_connecting(node, session) {
                        self.not_reached(node, "no answer");
                    }
                    if let Some(sender) = self.links.disconnect(node, session) {
                        self.closing_links
                            .spawn(async move { sender.close_after_sent("no longer needed").await });
                    }
                }
                Effect::Deliver { job, sections, device_time_ns, node } => {
                    let payload = self.take_payload(job).expect("a delivered result came in this turn");
                    let device_time = Duration::from_nanos(device_time_ns);
                    let job = job.job;
                    self.runs.arrived(job, Arrival::Delivered { job, payload, sections, device_time, node });
                }
                Effect::Fail { job, failure } => self.runs.arrived(job, Arrival::Failed { job, failure }),
                Effect::Waiting { batch, task, reason } => {
                    self.runs.waits(batch, task, reason, Instant::now())
                }
                Effect::ForgetProgram(job) => {
                    self.programs.remove(&(job.task, job.index));
                }
                Effect::DropPayload { job, digest: _ } => {
                    let _ = self.take_payload(job);
                }
                Effect::Refused { reason } => self.end(Over::Refused { reason }),
            }
        }
        self.payloads.clear();
        self.runs.flush();
        while self.closing_links.try_join_next().is_some() {}
    }

    fn not_reached(&mut self, node: NodeId, reason: &str) {
        if !self.links.reach_any() {
            self.runs.not_reached(format!("{node}: {reason}"), Instant::now());
        }
    }

    fn take_payload(&mut self, job: JobAttempt) -> Option<Payload> {
        let at = self.payloads.iter().position(|(attempt, _)| *attempt == job)?;
        self.payloads.remove(at).map(|(_, payload)| payload)
    }

    /// Nothing further will work: every run hears why.
    fn end(&mut self, over: Over) {
        self.answer_registration(Err(over.error(&self.options)));
        self.coordinator.give_up();
        self.runs.end_all(|| RunEnd::Farm(over.error(&self.options)));
        self.over = Some(over);
    }

    fn publish(&self) {
        let replanned = self.ledger.counts().replanned_jobs;
        let nodes = self.links.count();
        let (waiting, out_of_reach) = (self.runs.waiting(), self.runs.is_out_of_reach());
        let coordinator =
            if self.coordinator.is_lost() { CoordinatorLink::Reconnecting } else { CoordinatorLink::Up };
        let now = (replanned, nodes, waiting, out_of_reach, coordinator);
        // Called each turn: nothing is copied.
        self.progress.send_if_modified(|shown| {
            let Progress { replanned, nodes, waiting, out_of_reach, coordinator, .. } = *shown;
            if (replanned, nodes, waiting, out_of_reach, coordinator) == now {
                return false;
            }
            (shown.replanned, shown.nodes, shown.waiting, shown.out_of_reach, shown.coordinator) = now;
            true
        });
    }

    /// Says goodbye to everybody and waits, for a bounded time, until it is sent.
    async fn shut_down(mut self, mut inputs: mpsc::Receiver<Input>) {
        self.runs.end_all(|| RunEnd::Farm(FarmError::Closed));
        self.tell_ledger(Event::Finished);
        self.carry_out();
        let serial = self.coordinator.say_no_more();
        let goodbye_said = async {
            let Some(serial) = serial else { return };
            while let Some(input) = inputs.recv().await {
                if matches!(input, Input::CoordinatorEnded { serial: ended, .. } if ended == serial) {
                    return;
                }
            }
        };
        // Time out or not: there is nobody left to tell.
        let _ = tokio::time::timeout(GOODBYE_TIMEOUT, goodbye_said).await;
        while self.closing_links.join_next().await.is_some() {}
    }
}

impl Over {
    fn error(&self, options: &FarmOptions) -> FarmError {
        let address = options.coordinator.clone();
        match self {
            Self::Refused { reason } => FarmError::Refused { address, reason: reason.clone() },
            Self::Lost(GaveUp { waited, reason }) => {
                FarmError::CoordinatorLost { address, waited: *waited, reason: reason.clone() }
            }
        }
    }
}
