//! The coordinator's state, as the event families share it: applications with their jobs, nodes with their devices.
//! It keeps books; it decides nothing.

use std::collections::{BTreeMap, BTreeSet};

use super::NodeState;
use crate::{
    device::{DeviceInfo, Requirements},
    id::{
        AppId, AppIncarnation, Attempt, BatchId, DeviceIndex, JobId, JobKey, LinkId, NodeId, NodeSession,
        StealId,
    },
    message::{Contact, CostNs, JobFailure, WaitReason},
    time::Instant,
};

/// Weight of a new throughput sample in a device's rate. 0.2 follows a change of speed within ten jobs and lets one
/// outlier move the rate by a fifth at most of its (bounded) distance.
const RATE_GAIN: f64 = 0.2;

/// A sample counts as at most this many times faster or slower than the rate so far: one warm-up launch or one job of
/// wrong cost must not starve or flood a device.
const MAX_RATE_STEP: f64 = 16.0;

/// Who is at the other end of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Peer {
    App(AppId),
    Node(NodeId),
}

/// A registered application.
#[derive(Debug)]
pub(super) struct App {
    pub(super) name: String,
    pub(super) weight: f64,
    /// Its queued jobs may be moved to balance nodes.
    pub(super) global_stealing: bool,
    pub(super) incarnation: AppIncarnation,
    /// `None` while it is away; then `lease_until` runs.
    pub(super) link: Option<LinkId>,
    /// It said something since it was told its incarnation.
    pub(super) heard: bool,
    pub(super) last_heard: Instant,
    pub(super) lease_until: Instant,
    /// Batches with jobs in `jobs`.
    pub(super) batches: BTreeMap<BatchId, Batch>,
    /// Jobs neither delivered nor failed.
    pub(super) jobs: BTreeMap<JobKey, Job>,
    /// Jobs given up, kept because the word of it may get lost with a connection.
    pub(super) failed: BTreeMap<JobKey, JobFailure>,
    /// Nodes that its machine cannot reach, and until when that is believed.
    pub(super) unreachable: BTreeMap<NodeId, Instant>,
    pub(super) waiting_jobs: u64,
    pub(super) delivered_jobs: u64,
    pub(super) device_time_ns: u64,
}

impl App {
    /// A job that waits in line with its batch. Keys stay in line when their jobs go; this tells them apart.
    pub(super) fn waiting_job(&self, key: JobKey, batch: BatchId) -> Option<&Job> {
        self.jobs.get(&key).filter(|job| job.state == JobState::Waiting && job.batch == batch)
    }
}

/// What the jobs of one plan request share.
#[derive(Debug)]
pub(super) struct Batch {
    pub(super) needs: Requirements,
    /// Its jobs in [`App::jobs`].
    pub(super) open_jobs: u32,
    /// The reason for waiting that the application was told last.
    pub(super) told: Option<WaitReason>,
}

/// A job neither delivered nor failed.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) batch: BatchId,
    pub(super) cost: CostNs,
    pub(super) state: JobState,
    /// Attempts that ended with their device or node.
    pub(super) crashes: u32,
    /// The node that lost it last: another one is preferred.
    pub(super) avoid: Option<NodeId>,
    /// Nodes it was stolen from, in order: it is never stolen back.
    pub(super) stolen_from: Vec<NodeId>,
}

/// Where a job is, as far as the coordinator knows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum JobState {
    /// In `fresh`, `stuck` or `lost`.
    Waiting,
    /// Planned; in transit, queued or running.
    Placed(Placement),
    /// Ended on the node's device, its result not yet acknowledged.
    Executed { node: NodeId, device: DeviceIndex, attempt: Attempt },
}

impl JobState {
    /// Node and attempt that answer for the job.
    pub(super) const fn holder(self) -> Option<(NodeId, Attempt)> {
        match self {
            Self::Waiting => None,
            Self::Placed(place) => Some((place.node, place.attempt)),
            Self::Executed { node, attempt, .. } => Some((node, attempt)),
        }
    }
}

/// A plan for one job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Placement {
    pub(super) node: NodeId,
    pub(super) device: DeviceIndex,
    pub(super) attempt: Attempt,
    pub(super) planned_at: Instant,
    /// What the job adds to the device's queue.
    pub(super) load_ns: u64,
    /// The steal that asks its node to give it up.
    pub(super) retracting: Option<StealId>,
}

/// Jobs of one batch that have no place.
#[derive(Debug)]
pub(super) struct Pending {
    pub(super) app: AppId,
    pub(super) batch: BatchId,
    /// Repeated in the plan: `None` for new attempts after a loss.
    pub(super) answers: Option<BatchId>,
    pub(super) keys: Vec<JobKey>,
}

/// A registered node.
#[derive(Debug)]
pub(super) struct Node {
    pub(super) name: String,
    pub(super) session: NodeSession,
    pub(super) contact: Contact,
    pub(super) devices: Vec<Device>,
    /// `None` since `last_heard` when the connection is gone.
    pub(super) link: Option<LinkId>,
    pub(super) last_heard: Instant,
    pub(super) state: NodeState,
    /// Gave a job back while not draining: gets nothing new until then.
    pub(super) full_until: Option<Instant>,
    /// Jobs that a hello's inventory lacked because they were in transit, or so it seemed: looked at once more then.
    pub(super) recheck: Option<Recheck>,
    /// Jobs placed or executed here.
    pub(super) jobs: BTreeSet<JobId>,
    /// It joined and has not stolen yet: it may take jobs of any application.
    pub(super) joining: bool,
    /// When it may try to steal again, and how often in a row it tried in vain.
    pub(super) steal_at: Instant,
    pub(super) vain_steals: u32,
}

impl Node {
    /// Whether new work may be planned here.
    pub(super) fn takes_work(&self) -> bool {
        match self.state {
            NodeState::Alive => self.link.is_some() && self.full_until.is_none(),
            NodeState::Suspect | NodeState::Draining => false,
        }
    }

    pub(super) fn device_mut(&mut self, device: DeviceIndex) -> Option<&mut Device> {
        self.devices.get_mut(usize::from(device.0))
    }
}

/// Attempts whose whereabouts are in doubt until a deadline.
#[derive(Debug)]
pub(super) struct Recheck {
    pub(super) at: Instant,
    pub(super) jobs: Vec<(JobId, Attempt)>,
}

/// A device of a node.
#[derive(Debug)]
pub(super) struct Device {
    pub(super) info: DeviceInfo,
    pub(super) lost: bool,
    /// Loads of the jobs placed here and not executed.
    pub(super) queued_ns: u128,
    pub(super) planned_jobs: u64,
    pub(super) running_jobs: u32,
    pub(super) executed_jobs: u64,
    pub(super) device_time_ns: u64,
    /// Work per device time, by completed jobs.
    pub(super) measured_rate: Option<f64>,
}

impl Device {
    pub(super) const fn new(info: DeviceInfo) -> Self {
        Self {
            info,
            lost: false,
            queued_ns: 0,
            planned_jobs: 0,
            running_jobs: 0,
            executed_jobs: 0,
            device_time_ns: 0,
            measured_rate: None,
        }
    }

    /// Work per time. This is the place where a rate per (module, device) will be looked up.
    pub(super) fn rate(&self, calibration: &Calibration) -> f64 {
        self.measured_rate.unwrap_or(self.info.score * calibration.rate_per_score)
    }

    pub(super) fn add_load(&mut self, load_ns: u64) {
        self.queued_ns += u128::from(load_ns);
        self.planned_jobs += 1;
    }

    pub(super) fn drop_load(&mut self, load_ns: u64) {
        self.queued_ns -= u128::from(load_ns);
        self.planned_jobs -= 1;
    }

    /// Learns from one completed job.
    pub(super) fn completed(&mut self, calibration: &mut Calibration, load_ns: u64, device_time_ns: u64) {
        if load_ns == 0 || device_time_ns == 0 {
            return;
        }
        let sample = load_ns as f64 / device_time_ns as f64;
        calibration.observe(sample / self.info.score);
        let rate = self.rate(calibration);
        let sample = sample.clamp(rate / MAX_RATE_STEP, rate * MAX_RATE_STEP);
        self.measured_rate = Some(rate + RATE_GAIN * (sample - rate));
    }
}

/// What a point of score is worth: makes the scores of devices without a completed job comparable with the measured
/// rates of the others.
#[derive(Debug)]
pub(super) struct Calibration {
    rate_per_score: f64,
    calibrated: bool,
}

impl Default for Calibration {
    fn default() -> Self {
        Self { rate_per_score: 1.0, calibrated: false }
    }
}

impl Calibration {
    fn observe(&mut self, sample: f64) {
        if self.calibrated {
            let so_far = self.rate_per_score;
            let sample = sample.clamp(so_far / MAX_RATE_STEP, so_far * MAX_RATE_STEP);
            self.rate_per_score = so_far + RATE_GAIN * (sample - so_far);
        } else {
            self.rate_per_score = sample;
            self.calibrated = true;
        }
    }
}
