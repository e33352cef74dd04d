//! A worker node's state machine: per-application queues, the feedback lottery, device queues of one running and
//! one staged job, local stealing, the result spool's book-keeping.
//!
//! It never sees payloads: its driver keeps programs, contents and results by [`JobAttempt`] and [`ContentHash`].

use crate::{
    device::DeviceInfo,
    id::{ContentHash, DeviceIndex, JobAttempt, LinkId, NodeId, NodeSession},
    message::{AppToNode, Contact, CoordinatorToNode, JobFailure, NodeToApp, NodeToCoordinator},
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
    /// Gain of the lottery's feedback (10-scheduling.md section 2: c = 0.15).
    pub lottery_gain: f64,
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
        /// The connection of the application that has it.
        link: LinkId,
    },
    /// Hand a job to a device's executor, which holds at most one running and one staged job.
    Execute {
        /// Which.
        job: JobAttempt,
        /// Where.
        device: DeviceIndex,
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
    /// Drained, goodbye said: the process may end.
    Exit,
}

/// A worker node.
#[derive(Debug)]
pub struct WorkerMachine {
    config: WorkerConfig,
}

impl WorkerMachine {
    /// A worker that is not registered yet.
    #[must_use]
    pub fn new(config: WorkerConfig) -> Self {
        Self { config }
    }

    /// Takes one event in.
    pub fn handle(&mut self, now: Instant, event: Event) {
        let _ = (now, event, &self.config);
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

    /// The node's id, once registered.
    #[must_use]
    pub fn node(&self) -> Option<NodeId> {
        None
    }

    /// Asserts what must hold between any two events.
    ///
    /// # Panics
    /// An invariant is broken; the message says which.
    pub fn check_invariants(&self) {}
}
