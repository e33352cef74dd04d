//! The application's job ledger: the owner of the truth about an application's jobs (20-delivery.md).
//!
//! It decides which attempt of a job counts, gives each job to the application exactly once, and says what to send
//! where. Programs and results are its driver's, by [`JobId`]. It never chooses a node: plans are the coordinator's.
//!
//! `jobs` owns what is open and what is over, `session` the talk with the coordinator, `nodes` the data links, `kept` the
//! acknowledgements that wait for a journal.

mod invariants;
mod jobs;
mod kept;
mod nodes;
mod session;

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use self::{
    jobs::{Batch, Job},
    kept::Unkept,
    nodes::{Node, NodeLife},
    session::{Identity, Session},
};
use crate::{
    device::Requirements,
    id::{
        AppId, Attempt, BatchId, ContentHash, JobAttempt, JobId, JobIndex, JobKey, NodeId, NodeSession,
        TaskId,
    },
    message::{
        AppHello, AppToCoordinator, AppToNode, Contact, CoordinatorToApp, CostNs, JobFailure, LatencyClass,
        Liveness, NodeToApp, Priority, WaitReason,
    },
    program::Content,
    time::Instant,
};

/// One job as the application submits it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SubmittedJob {
    /// Index inside its task.
    pub index: JobIndex,
    /// Estimated work.
    pub cost: CostNs,
    /// When it may take a device.
    pub class: LatencyClass,
    /// Order inside the application and class.
    pub priority: Priority,
    /// Task allocations and modules its program names.
    pub contents: Vec<Content>,
    /// The module that its program names first.
    pub module: Option<ContentHash>,
}

/// What happens to an application.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The driver has a connection to the coordinator: say hello on it.
    CoordinatorConnected,
    /// Results of this task are acknowledged when [`Event::Kept`] says so, not when they come: their nodes keep them until a crash
    /// of the application cannot lose them. Comes before the task's jobs; ends with [`Event::Cancelled`].
    Journalled(TaskId),
    /// A delivered result of such a task is where a crash of the application does not reach.
    Kept {
        /// The task.
        task: TaskId,
        /// The job.
        index: JobIndex,
    },
    /// This application goes on for that one, whose process is dead: the coordinator is told, now or when it is back.
    Supersedes(AppId),
    /// The coordinator said something.
    FromCoordinator(CoordinatorToApp),
    /// The connection to the coordinator is gone; the driver will try again.
    CoordinatorLost,
    /// A batch of jobs whose programs the driver holds. Allowed before the welcome; planned after it.
    Submitted {
        /// The task of all the jobs.
        task: TaskId,
        /// The jobs.
        jobs: Vec<SubmittedJob>,
        /// What every job needs of a device.
        needs: Requirements,
    },
    /// A connection to a node stands (asked for by [`Effect::Connect`]).
    NodeConnected {
        /// Which.
        node: NodeId,
        /// Which life of it.
        session: NodeSession,
    },
    /// A connection to a node is gone or could not be made; `Connect` is asked again with back-off or the node reported.
    NodeLost {
        /// Which.
        node: NodeId,
        /// Which life of it.
        session: NodeSession,
    },
    /// A node said something.
    FromNode {
        /// Which.
        node: NodeId,
        /// Which life of it.
        session: NodeSession,
        /// What. A result's payload is the driver's, who has checked it against the header's digest.
        message: NodeToApp,
    },
    /// The application gives a task up, or is through with it: each of its open jobs ends with [`Effect::Fail`] of `Cancelled`.
    Cancelled(TaskId),
    /// The application is done: say goodbye. Open jobs are dropped without a further word; later events are ignored.
    Finished,
}

/// What an application's ledger wants done.
#[derive(Clone, Debug, PartialEq)]
pub enum Effect {
    /// Say something to the coordinator.
    ToCoordinator(AppToCoordinator),
    /// Connect to a node; answer with `NodeConnected` or `NodeLost`.
    Connect {
        /// Which.
        node: NodeId,
        /// Which life of it.
        session: NodeSession,
        /// Where.
        contact: Contact,
    },
    /// Say something to a connected node. For `Jobs` the driver adds the programs' bytes.
    ToNode {
        /// Which.
        node: NodeId,
        /// Which life of it.
        session: NodeSession,
        /// What.
        message: AppToNode,
    },
    /// Close the connection to a node.
    Disconnect {
        /// Which.
        node: NodeId,
        /// Which life of it.
        session: NodeSession,
    },
    /// Give this result to the application: exactly once per job. The payload is the one that came with `job`.
    Deliver {
        /// Which attempt won.
        job: JobAttempt,
        /// Lengths of the payload's sections.
        sections: Vec<u64>,
        /// Measured device time in nanoseconds.
        device_time_ns: u64,
        /// Who computed it.
        node: NodeId,
    },
    /// Give this failure to the application: the job is over.
    Fail {
        /// Which.
        job: JobId,
        /// Why.
        failure: JobFailure,
    },
    /// A batch waits; tell the user why.
    Waiting {
        /// The batch.
        batch: BatchId,
        /// Its jobs' task.
        task: TaskId,
        /// Why.
        reason: WaitReason,
    },
    /// The job's program is needed no more.
    ForgetProgram(JobId),
    /// A payload that will not be delivered (late or double).
    DropPayload {
        /// Of which attempt.
        job: JobAttempt,
        /// Its digest.
        digest: ContentHash,
    },
    /// The coordinator refused us: nothing further will work.
    Refused {
        /// Why, for people.
        reason: String,
    },
}

/// How far an application's jobs are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LedgerCounts {
    /// Submitted, not yet planned.
    pub waiting_jobs: u64,
    /// Planned, no result yet.
    pub outstanding_jobs: u64,
    /// Delivered.
    pub delivered_jobs: u64,
    /// Failed for good.
    pub failed_jobs: u64,
    /// New attempts after losses and steals.
    pub replanned_jobs: u64,
}

/// An application's ledger.
#[derive(Debug)]
pub struct Ledger {
    hello: AppHello,
    session: Session,
    identity: Option<Identity>,
    heartbeat_sequence: u64,
    /// Jobs that may still be delivered or fail.
    jobs: BTreeMap<JobKey, Job>,
    /// Jobs that were delivered or failed: nothing more may come of them.
    over: BTreeSet<JobKey>,
    /// Tasks whose results are acknowledged when they are kept.
    journalled: BTreeSet<TaskId>,
    /// Their delivered results that are not.
    unkept: BTreeMap<JobKey, Unkept>,
    /// Batches with open jobs.
    batches: BTreeMap<BatchId, Batch>,
    /// Batches to be asked for, in order of submission.
    to_request: VecDeque<BatchId>,
    /// Open jobs of the batches asked for.
    requested_jobs: u64,
    next_batch: u64,
    nodes: BTreeMap<NodeLife, Node>,
    /// When a node's link wants to be looked at again.
    deadlines: BTreeMap<NodeLife, Instant>,
    /// Time between comparisons of what nodes hold, by the last welcome.
    compare_every: Duration,
    /// Nodes with something to flush.
    dirty: BTreeSet<NodeLife>,
    /// Applications that this one goes on for, to be flushed: no more than runs were begun since the last flush.
    predecessors: BTreeSet<AppId>,
    /// Answers to re-plans that came too late, to be flushed.
    already_delivered: Vec<JobId>,
    counts: LedgerCounts,
    effects: VecDeque<Effect>,
}

impl Ledger {
    /// A ledger of an application that is not registered yet.
    #[must_use]
    pub fn new(hello: AppHello) -> Self {
        let identity = hello.resume.map(|(app, incarnation)| Identity { app, incarnation });
        Self {
            hello,
            session: Session::Offline,
            identity,
            heartbeat_sequence: 0,
            jobs: BTreeMap::new(),
            over: BTreeSet::new(),
            journalled: BTreeSet::new(),
            unkept: BTreeMap::new(),
            batches: BTreeMap::new(),
            to_request: VecDeque::new(),
            requested_jobs: 0,
            next_batch: 0,
            nodes: BTreeMap::new(),
            deadlines: BTreeMap::new(),
            compare_every: Liveness::default().compare_every(),
            dirty: BTreeSet::new(),
            predecessors: BTreeSet::new(),
            already_delivered: Vec::new(),
            counts: LedgerCounts::default(),
            effects: VecDeque::new(),
        }
    }

    /// A ledger of an application that comes back as another process. `first_batch` is larger than any number that an
    /// earlier one gave a batch: the application's journal knows it by [`Self::next_batch`].
    #[must_use]
    pub fn resumed(hello: AppHello, first_batch: BatchId) -> Self {
        Self { next_batch: first_batch.0, ..Self::new(hello) }
    }

    /// The number that the next batch will have.
    #[must_use]
    pub const fn next_batch(&self) -> BatchId {
        BatchId(self.next_batch)
    }

    /// Takes one event in.
    pub fn handle(&mut self, now: Instant, event: Event) {
        if self.session == Session::Finished {
            // A result may have been on its way when we said goodbye.
            if let Event::FromNode { message: NodeToApp::Result(header), .. } = event {
                self.push(Effect::DropPayload { job: header.job, digest: header.digest });
            }
            return;
        }
        match event {
            Event::CoordinatorConnected => self.coordinator_connected(),
            Event::FromCoordinator(message) => self.coordinator_said(now, message),
            Event::CoordinatorLost => self.coordinator_lost(),
            Event::Journalled(task) => self.journalled(task),
            Event::Supersedes(app) => {
                self.predecessors.insert(app);
            }
            Event::Kept { task, index } => self.kept(JobKey { task, index }),
            Event::Submitted { task, jobs, needs } => self.submitted(task, jobs, needs),
            Event::NodeConnected { node, session } => self.node_connected(now, NodeLife { node, session }),
            Event::NodeLost { node, session } => self.node_lost(now, NodeLife { node, session }),
            Event::FromNode { node, session, message } => {
                self.node_said(now, NodeLife { node, session }, message)
            }
            Event::Cancelled(task) => self.cancelled(task),
            Event::Finished => self.finished(),
        }
    }

    /// Acts on the timers that are due.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.session_timeout(now);
        self.node_timeouts(now);
    }

    /// When [`Self::handle_timeout`] wants to be called next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.deadlines.values().copied().chain(self.session.next_heartbeat()).min()
    }

    /// The next thing to do; call until `None` after every `handle` and `handle_timeout`.
    ///
    /// Tickets and acknowledgements of one burst of events leave together: they are put into messages only when
    /// everything else has been polled.
    pub fn poll_effect(&mut self) -> Option<Effect> {
        if self.effects.is_empty() {
            self.flush_session();
            self.flush_nodes();
        }
        self.effects.pop_front()
    }

    /// The cluster-wide id, once registered.
    #[must_use]
    pub fn app(&self) -> Option<AppId> {
        self.identity.map(|identity| identity.app)
    }

    /// How far the jobs are.
    #[must_use]
    pub fn counts(&self) -> LedgerCounts {
        self.counts
    }

    /// The jobs that are not over, each with the node that its current plan names and the attempt there.
    pub fn open_jobs(&self) -> impl Iterator<Item = (TaskId, JobIndex, Option<(NodeId, Attempt)>)> {
        self.jobs
            .iter()
            .map(|(key, job)| (key.task, key.index, job.place.map(|place| (place.life.node, place.attempt))))
    }

    fn push(&mut self, effect: Effect) {
        self.effects.push_back(effect);
    }

    fn tell_coordinator(&mut self, message: AppToCoordinator) {
        self.push(Effect::ToCoordinator(message));
    }
}
