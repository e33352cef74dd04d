//! The application's job ledger: the owner of the truth about an application's jobs (20-delivery.md).
//!
//! It decides which attempt of a job counts, gives each job to the application exactly once, and says what to send
//! where. Programs and results are its driver's, by [`JobId`].

use crate::{
    device::Requirements,
    id::{AppId, BatchId, ContentHash, JobAttempt, JobId, JobIndex, NodeId, NodeSession, TaskId},
    message::{
        AppHello, AppToCoordinator, AppToNode, Contact, CoordinatorToApp, CostNs, JobFailure, NodeToApp, Priority,
        WaitReason,
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
    /// Order inside the application.
    pub priority: Priority,
    /// Task allocations and modules its program names.
    pub contents: Vec<Content>,
}

/// What happens to an application.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The driver has a connection to the coordinator: say hello on it.
    CoordinatorConnected,
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
    /// The application gives a task up.
    Cancelled(TaskId),
    /// The application is done: say goodbye.
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
    /// New attempts after losses.
    pub replanned_jobs: u64,
}

/// An application's ledger.
#[derive(Debug)]
pub struct Ledger {
    hello: AppHello,
}

impl Ledger {
    /// A ledger of an application that is not registered yet.
    #[must_use]
    pub fn new(hello: AppHello) -> Self {
        Self { hello }
    }

    /// Takes one event in.
    pub fn handle(&mut self, now: Instant, event: Event) {
        let _ = (now, event, &self.hello);
    }

    /// Acts on the timers that are due.
    pub fn handle_timeout(&mut self, now: Instant) {
        let _ = now;
    }

    /// When [`Self::handle_timeout`] wants to be called next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        None
    }

    /// The next thing to do; call until `None` after every `handle` and `handle_timeout`.
    pub fn poll_effect(&mut self) -> Option<Effect> {
        None
    }

    /// The cluster-wide id, once registered.
    #[must_use]
    pub fn app(&self) -> Option<AppId> {
        None
    }

    /// How far the jobs are.
    #[must_use]
    pub fn counts(&self) -> LedgerCounts {
        LedgerCounts::default()
    }

    /// Asserts what must hold between any two events.
    ///
    /// # Panics
    /// An invariant is broken; the message says which.
    pub fn check_invariants(&self) {}
}
