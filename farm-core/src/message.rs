//! What the tiers say to each other, as domain data. Wire formats are `proto`'s; payload bytes (programs, results,
//! allocations) never enter a machine: messages carry their names and sizes only.

use std::{cmp::Ordering, time::Duration};

use serde::{Deserialize, Serialize};

use crate::{
    device::{DeviceInfo, Requirements},
    holding::Holding,
    id::{
        AppId, AppIncarnation, Attempt, BatchId, ContentHash, DeviceIndex, Epoch, JobAttempt, JobId,
        JobIndex, NodeId, NodeSession, StealId, TaskId,
    },
    program::Content,
    project::AppTerms,
    time::Instant,
};

/// The protocol this build speaks. A peer of another version is refused at hello.
pub const PROTOCOL_VERSION: u32 = 7;

/// Whether a peer that says this version in its hello is spoken to.
///
/// # Errors
/// It is of another version: both, and which side to upgrade, for the people at the peer.
pub fn check_protocol(protocol: u32) -> Result<(), String> {
    let older = match protocol.cmp(&PROTOCOL_VERSION) {
        Ordering::Equal => return Ok(()),
        Ordering::Less => "refused",
        Ordering::Greater => "refusing",
    };
    Err(format!(
        "protocol version {protocol} is not spoken here, version {PROTOCOL_VERSION} is: the {older} side is the older one, \
         upgrade it"
    ))
}

/// Estimated work of a job: nanoseconds on a device of speed 1.0. Zero means unknown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct CostNs(pub u64);

/// Order inside one application: larger goes first, equal ones first come, first served.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Priority(pub i32);

/// When a job may take a device. It says nothing of how much device time its application gets: that is the fair share's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum LatencyClass {
    /// When its turn comes.
    #[default]
    Batch,
    /// Somebody waits for it: ahead of batch jobs, and at the next launch boundary of one that runs.
    Interactive,
}

/// How often the two ends of a session say that they are alive, and when silence means what. All in milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Liveness {
    /// Each side sends a heartbeat this often.
    pub heartbeat_ms: u64,
    /// Silence after which no new work is planned there.
    pub suspect_ms: u64,
    /// Silence after which a node's undelivered jobs get new attempts elsewhere.
    pub dead_ms: u64,
    /// After a closed connection, how long the peer may take to come back before it counts as dead.
    pub reconnect_ms: u64,
    /// Two ends compare what one holds of the other's jobs this often.
    pub compare_ms: u64,
}

impl Liveness {
    /// Time between two comparisons; no shorter than between heartbeats.
    #[must_use]
    pub const fn compare_every(&self) -> Duration {
        let least_ms = if self.heartbeat_ms > 1 { self.heartbeat_ms } else { 1 };
        Duration::from_millis(if self.compare_ms > least_ms { self.compare_ms } else { least_ms })
    }
}

impl Default for Liveness {
    fn default() -> Self {
        // 20-delivery.md, failure table: heartbeat 1 s, suspect 3 s, dead 10 s; a closed connection is suspect at once.
        Self {
            heartbeat_ms: 1_000,
            suspect_ms: 3_000,
            dead_ms: 10_000,
            reconnect_ms: 2_000,
            compare_ms: 30_000,
        }
    }
}

/// How to reach a node's data plane.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Contact {
    /// `host:port` addresses, tried side by side; the pinned certificate says which answer is the node's.
    pub addresses: Vec<String>,
    /// The node's certificate, DER; the application accepts no other.
    pub certificate_der: Vec<u8>,
}

// ---------------------------------------------------------------- application <-> coordinator

/// An application's first message.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AppHello {
    /// Must equal [`PROTOCOL_VERSION`].
    pub protocol: u32,
    /// For people.
    pub name: String,
    /// Fair-share weight, > 0 and finite.
    pub weight: f64,
    /// Whether queued jobs may be moved between nodes to balance them (thesis 5.6.3). When a node joins they may be
    /// moved to it in any case.
    pub global_stealing: bool,
    /// Name of the placement policy for its jobs: [`crate::coordinator::policy::FCFS`] (also when empty),
    /// [`crate::coordinator::policy::NEIGHBOURS`], [`crate::coordinator::policy::HISTORY`], or a plug-in in the coordinator's
    /// folder.
    pub policy: String,
    /// Who the application was before its connection broke, if it comes back.
    pub resume: Option<(AppId, AppIncarnation)>,
}

/// One job of a plan request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PlanJob {
    /// The job inside the request's task.
    pub index: JobIndex,
    /// Estimated work.
    pub cost: CostNs,
}

/// Where a job is that an earlier coordinator planned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HeldJob {
    /// The job inside the request's task.
    pub index: JobIndex,
    /// The life of the node that holds it.
    pub session: NodeSession,
    /// The device it was planned for.
    pub device: DeviceIndex,
    /// The attempt there.
    pub attempt: Attempt,
}

/// One batch of jobs to be placed (10-scheduling.md section 1).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlanRequest {
    /// Repeated in the answer.
    pub batch: BatchId,
    /// The task of all the jobs.
    pub task: TaskId,
    /// The jobs.
    pub jobs: Vec<PlanJob>,
    /// What every job of the batch needs of a device.
    pub needs: Requirements,
    /// The module that every job's program names first: devices are rated for each by itself. `None` for
    /// programs without a kernel.
    pub module: Option<ContentHash>,
    /// Task allocations and modules the jobs use: a device that holds them is preferred.
    pub contents: Vec<Content>,
    /// Those of the jobs that have a place, when the request is repeated: a coordinator that has not planned them takes them
    /// over as they are.
    pub held: Vec<HeldJob>,
}

/// Attempts placed on one device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DevicePlan {
    /// The device inside the node.
    pub device: DeviceIndex,
    /// In the order they should run.
    pub jobs: Vec<JobAttempt>,
}

/// Attempts placed on one node, grouped by device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodePlan {
    /// The node.
    pub node: NodeId,
    /// The life of the node that the plan is for.
    pub session: NodeSession,
    /// How to reach it.
    pub contact: Contact,
    /// Its devices' shares.
    pub devices: Vec<DevicePlan>,
}

/// Where jobs go. The answer to a plan request, or new attempts after a loss.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Plan {
    /// The request answered; `None` when the coordinator re-plans on its own.
    pub batch: Option<BatchId>,
    /// The jobs run elsewhere already and go on there: these attempts are in addition, and the first result counts.
    pub speculative: bool,
    /// Grouped by node.
    pub nodes: Vec<NodePlan>,
}

/// Why a batch or a job waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum WaitReason {
    /// No node is registered.
    NoNode,
    /// Nodes are there, but no device fulfils the requirements.
    NoFittingDevice,
    /// The application's project has as much as it may have.
    OverQuota,
}

/// Why a job ended without a result.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum JobFailure {
    /// The program is wrong; a further attempt would fail the same way. The text names the command.
    InvalidProgram(String),
    /// A launch ran past its limit.
    Timeout,
    /// The device was lost while the attempt was on it.
    DeviceLost(String),
    /// The device had no memory for it.
    OutOfMemory(String),
    /// A task allocation or module could not be had.
    ContentUnavailable(ContentHash),
    /// Too many attempts ended with the device or node (poison); the text is the last one's.
    Poison(String),
    /// Too many attempts of the application's jobs in a row ended with their devices, and it was stopped as a whole; the text
    /// names the last one.
    PoisonApplication(String),
    /// It needs more than its application's project may have at all; the text says of what.
    OverQuota(String),
    /// Cancelled by the application or by an operator.
    Cancelled,
    /// The node gave the job back unexecuted (it drains, it is full, or the result could not be handed over intact).
    /// Nobody's fault: a further attempt follows and no crash is counted.
    Returned,
}

impl JobFailure {
    /// Whether another attempt, elsewhere, may succeed.
    #[must_use]
    pub const fn can_be_retried(&self) -> bool {
        match self {
            Self::Timeout
            | Self::DeviceLost(_)
            | Self::OutOfMemory(_)
            | Self::ContentUnavailable(_)
            | Self::Returned => true,
            Self::InvalidProgram(_)
            | Self::Poison(_)
            | Self::PoisonApplication(_)
            | Self::OverQuota(_)
            | Self::Cancelled => false,
        }
    }
}

/// Application to coordinator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum AppToCoordinator {
    /// First message of a session.
    Hello(AppHello),
    /// Place these jobs.
    Plan(PlanRequest),
    /// These jobs need no further attempt: their results are here (answer to a re-plan that came too late).
    AlreadyDelivered(Vec<JobId>),
    /// The data plane of this node cannot be reached from here: move this application's jobs off it.
    Unreachable {
        /// The node.
        node: NodeId,
        /// The life of it that was tried.
        session: NodeSession,
    },
    /// Forget the undelivered jobs of this task and stop them.
    Cancel(TaskId),
    /// This application goes on with what that one, whose process is dead, has begun: its lease is of no use to anybody.
    Supersede(AppId),
    /// Alive.
    Heartbeat {
        /// Echoed in the answer.
        sequence: u64,
        /// No answer came for [`Liveness::suspect_ms`]: nothing gets through from there to here.
        unanswered: bool,
    },
    /// No more jobs will come; everything of this application can be freed.
    Goodbye,
}

/// Coordinator to application.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum CoordinatorToApp {
    /// Registered.
    Welcome {
        /// The cluster-wide id.
        app: AppId,
        /// Which life of it this is.
        incarnation: AppIncarnation,
        /// The coordinator's life.
        epoch: Epoch,
        /// Timings to keep.
        liveness: Liveness,
    },
    /// Not registered; the connection closes.
    Refused {
        /// Why, for people.
        reason: String,
    },
    /// Where jobs go.
    Plan(Plan),
    /// The batch is kept and will be planned when this changes.
    Waiting {
        /// The batch.
        batch: BatchId,
        /// Why.
        reason: WaitReason,
    },
    /// The coordinator gave a job up.
    JobFailed {
        /// The job.
        job: JobId,
        /// Why.
        failure: JobFailure,
    },
    /// The coordinator gave all jobs up ([`JobFailure::PoisonApplication`]), and plans none for a while.
    Stopped {
        /// Why, for people.
        reason: String,
    },
    /// Answer to a heartbeat.
    HeartbeatAck {
        /// Of the heartbeat answered.
        sequence: u64,
    },
    /// What to show to nodes of a secured farm from now on. From driver to driver: the machines know nothing of it.
    Capability(Vec<u8>),
}

// ---------------------------------------------------------------- node <-> coordinator

/// A node's first message.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeHello {
    /// Must equal [`PROTOCOL_VERSION`].
    pub protocol: u32,
    /// For people, and the node's identity over restarts: a second session of one name fences the first.
    pub name: String,
    /// Its id at the coordinator that it was registered with last.
    pub node: Option<NodeId>,
    /// This life of the worker process.
    pub session: NodeSession,
    /// The devices, by [`DeviceIndex`].
    pub devices: Vec<DeviceInfo>,
    /// The data plane.
    pub contact: Contact,
    /// Attempts the node holds, executed but undelivered ones too (after a reconnect).
    pub inventory: Vec<JobAttempt>,
}

/// When and how an attempt went through its node, by the node's own clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobTrace {
    /// Handed to the device's executor.
    pub staged_at: Instant,
    /// Began to run; equals `ended_at` for an attempt that never ran.
    pub started_at: Instant,
    /// Ended.
    pub ended_at: Instant,
    /// The sibling device whose queue it was taken from (local steal).
    pub stolen_from: Option<DeviceIndex>,
}

/// One finished execution.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Executed {
    /// What ran.
    pub job: JobAttempt,
    /// Where it ran (a local steal may have moved it).
    pub device: DeviceIndex,
    /// Measured device time in nanoseconds: what fairness charges.
    pub device_time_ns: u64,
    /// When and how.
    pub trace: JobTrace,
    /// `None` when it completed.
    pub failure: Option<JobFailure>,
}

/// How one device of a node stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceLoad {
    /// Jobs queued, staged or interrupted.
    pub queued_jobs: u32,
    /// The job that runs.
    pub running: Option<RunningJob>,
}

/// A job that runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunningJob {
    /// Which attempt.
    pub job: JobAttempt,
    /// For how long, in nanoseconds.
    pub for_ns: u64,
}

/// A node's cache of task allocations and modules; counts are since the node started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CacheFigures {
    /// Contents in memory.
    pub memory_contents: u64,
    /// Their bytes.
    pub memory_bytes: u64,
    /// Contents on disk, those in memory too.
    pub disk_contents: u64,
    /// Their bytes.
    pub disk_bytes: u64,
    /// Contents that jobs needed and that were in memory.
    pub memory_hits: u64,
    /// Contents that jobs needed and that were on disk.
    pub disk_hits: u64,
    /// Contents that were fetched from elsewhere.
    pub fetches: u64,
    /// Their bytes.
    pub fetched_bytes: u64,
    /// Contents that went from memory to make room.
    pub memory_evictions: u64,
    /// Contents that went from the disk to make room.
    pub disk_evictions: u64,
}

/// Node to coordinator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum NodeToCoordinator {
    /// First message of a session.
    Hello(NodeHello),
    /// Alive, and how the devices stand.
    Heartbeat {
        /// Echoed in the answer.
        sequence: u64,
        /// No answer came for [`Liveness::suspect_ms`]: nothing gets through from there to here.
        unanswered: bool,
        /// By [`DeviceIndex`].
        devices: Vec<DeviceLoad>,
        /// Executed results not yet acknowledged, in bytes.
        spool_bytes: u64,
        /// How the node's cache of contents stands; `None` from a node that does not know of caches on demand.
        cache: Option<CacheFigures>,
    },
    /// What ended since the last report. Batched by the machine: every 5 ms or 64 jobs.
    Report {
        /// When it left, by the node's clock: what relates the traces to other nodes' clocks.
        sent_at: Instant,
        /// Device free: for scheduling.
        executed: Vec<Executed>,
        /// Acknowledged by the application: the job is over.
        delivered: Vec<JobAttempt>,
    },
    /// A device is gone; its jobs were requeued on siblings or reported failed.
    DeviceLost {
        /// Which.
        device: DeviceIndex,
        /// Why, for people.
        reason: String,
    },
    /// Answer to [`CoordinatorToNode::Retract`]: each of its attempts is in one of the three lists.
    Retracted {
        /// Of the order answered.
        steal: StealId,
        /// Will never run here: a new attempt may be issued.
        retracted: Vec<JobAttempt>,
        /// Run or ran here, and stay.
        running: Vec<JobAttempt>,
        /// Ended here, or another attempt is here: the reports say what became of them.
        unknown: Vec<JobAttempt>,
    },
    /// This content is needed here and large: where should it come from? Answered with [`CoordinatorToNode::Located`], at
    /// once or when another node has it. Asked again when it could not be had from there.
    Locate(Content),
    /// What large contents the cache holds now, or does no more; after a welcome all that it holds. A content that was
    /// asked for and is not needed any more is gone, too.
    CacheChanged {
        /// Can be fetched here.
        held: Vec<Content>,
        /// Cannot.
        gone: Vec<ContentHash>,
    },
    /// A drained node leaves: it holds no job any more.
    Goodbye,
    /// Every attempt held, executed but undelivered ones too; every [`Liveness::compare_ms`]. Where the coordinator would have it otherwise it
    /// answers with [`CoordinatorToNode::SayInventory`].
    Holding(Holding),
    /// Answer to [`CoordinatorToNode::SayInventory`]: those attempts.
    Inventory(Vec<JobAttempt>),
}

/// Coordinator to node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum CoordinatorToNode {
    /// Registered.
    Welcome {
        /// The node's id.
        node: NodeId,
        /// The coordinator's life.
        epoch: Epoch,
        /// Timings to keep.
        liveness: Liveness,
    },
    /// Not registered, or expelled (a newer session of the same name); the connection closes.
    Refused {
        /// Why, for people.
        reason: String,
    },
    /// Applications may send jobs, and what each may have; said again of those of which that changes.
    AppsJoined(Vec<(AppId, AppTerms)>),
    /// Everything of this application can be freed.
    AppLeft {
        /// Which.
        app: AppId,
    },
    /// Forget these attempts; stop them at the next launch boundary if they run.
    Cancel {
        /// Which.
        jobs: Vec<JobAttempt>,
    },
    /// Give these attempts up unless they run; answer with [`NodeToCoordinator::Retracted`].
    Retract {
        /// Repeated in the answer.
        steal: StealId,
        /// Which.
        jobs: Vec<JobAttempt>,
    },
    /// Where to fetch a content.
    Located {
        /// Which.
        content: ContentHash,
        /// A node that has it; `None`: from the application.
        peer: Option<Contact>,
    },
    /// Say what is held: answer with [`NodeToCoordinator::Inventory`].
    SayInventory,
    /// Drop these contents, in memory and on disk, where no job needs them; all such if none is named.
    Evict {
        /// Which.
        contents: Vec<ContentHash>,
    },
    /// Take no new work, finish what runs, say goodbye.
    Drain,
    /// Answer to a heartbeat.
    HeartbeatAck {
        /// Of the heartbeat answered.
        sequence: u64,
    },
}

// ---------------------------------------------------------------- application <-> node (data plane)

/// One job on its way to a node, without its program's bytes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobTicket {
    /// Which attempt.
    pub job: JobAttempt,
    /// The device the plan names.
    pub device: DeviceIndex,
    /// When it may take a device.
    pub class: LatencyClass,
    /// Order inside the application and class.
    pub priority: Priority,
    /// Estimated work.
    pub cost: CostNs,
    /// What must be on the node before the job can be staged.
    pub contents: Vec<Content>,
}

/// An application's word that a result is safe.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResultAck {
    /// Which attempt.
    pub job: JobAttempt,
    /// blake3 of the payload received.
    pub digest: ContentHash,
}

/// Application to node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum AppToNode {
    /// First message of a link.
    Hello {
        /// Must equal [`PROTOCOL_VERSION`].
        protocol: u32,
        /// Who.
        app: AppId,
        /// Which life of it.
        incarnation: AppIncarnation,
    },
    /// Queue these. The frame's payload is the jobs' encoded programs, one after the other.
    Jobs(Vec<JobTicket>),
    /// These results are safe.
    Acks(Vec<ResultAck>),
    /// Forget these attempts.
    Cancel(Vec<JobAttempt>),
    /// Attempts of the application that should be there, and its results that it has not acknowledged; every
    /// [`Liveness::compare_ms`]. A node that holds others answers with [`NodeToApp::Inventory`].
    Holding(Holding),
}

/// What became of an attempt, as its application sees it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResultHeader {
    /// Which attempt.
    pub job: JobAttempt,
    /// Where it ran.
    pub device: DeviceIndex,
    /// Measured device time in nanoseconds.
    pub device_time_ns: u64,
    /// `Ok`: lengths in bytes of the sections of the payload, one for each device-to-host copy, in program order.
    pub outcome: Result<Vec<u64>, JobFailure>,
    /// blake3 of the payload.
    pub digest: ContentHash,
}

/// Node to application.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum NodeToApp {
    /// The link stands.
    Welcome {
        /// Who answers.
        node: NodeId,
        /// Which life of it.
        session: NodeSession,
    },
    /// The link is refused and closes.
    Refused {
        /// Why, for people.
        reason: String,
    },
    /// An attempt ended. The frame's payload is the sections, one after the other.
    Result(ResultHeader),
    /// Every attempt of the application that is held, executed but unacknowledged ones too.
    Inventory(Vec<JobAttempt>),
}
