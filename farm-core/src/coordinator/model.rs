//! The coordinator's state, as the event families share it: applications with their jobs, nodes with their devices.
//! It keeps books; it decides nothing.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    NodeState,
    breaker::Breaker,
    inventory::Missing,
    neighbours::Samples,
    policy::Policy,
    rates::{Load, Module, Modules, Throughput},
    recovery::Brought,
    reserve::Low,
};
use crate::{
    device::{DeviceInfo, Requirements},
    id::{
        AppId, AppIncarnation, Attempt, BatchId, ContentHash, DeviceIndex, JobId, JobKey, LinkId, NodeId,
        NodeSession, StealId, TaskId,
    },
    message::{CacheFigures, Contact, CostNs, JobFailure, NodeHello, RunningJob, WaitReason},
    program::Content,
    time::Instant,
};

/// Most contents that a node is remembered to hold; beyond it the smallest hashes are forgotten: the node is then taken
/// for colder than it is.
const MAX_KNOWN_CONTENTS: usize = 4_096;

/// A job is overdue when it has taken this many times what it should. Tiles of one picture differ by less than that.
const OVERDUE: f64 = 3.0;

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
    /// Its queued jobs may be moved to balance nodes.
    pub(super) global_stealing: bool,
    pub(super) policy: Policy,
    pub(super) incarnation: AppIncarnation,
    /// `None` while it is away; then `lease_until` runs.
    pub(super) link: Option<LinkId>,
    /// It said something since it was told its incarnation.
    pub(super) heard: bool,
    /// It says that it hears nothing from here: until it does it counts as silent, whatever it says.
    pub(super) deaf: bool,
    pub(super) last_heard: Instant,
    pub(super) lease_until: Instant,
    /// Another application goes on for it: if its connection ends by then, it is over at once.
    pub(super) superseded_until: Option<Instant>,
    /// Batches with jobs in `jobs`.
    pub(super) batches: BTreeMap<BatchId, Batch>,
    /// Jobs neither delivered nor failed.
    pub(super) jobs: BTreeMap<JobKey, Job>,
    /// Jobs given up, kept because the word of it may get lost with a connection.
    pub(super) failed: BTreeMap<JobKey, JobFailure>,
    /// Nodes that its machine cannot reach, and until when that is believed.
    pub(super) unreachable: BTreeMap<NodeId, Instant>,
    pub(super) breaker: Breaker,
    pub(super) waiting_jobs: u64,
    pub(super) delivered_jobs: u64,
    pub(super) device_time_ns: u64,
}

impl App {
    /// Whether a node can be reached from the application's machine, as far as is known.
    pub(super) fn can_reach(&self, now: Instant, node: NodeId) -> bool {
        self.unreachable.get(&node).is_none_or(|until| *until <= now)
    }

    /// A job that waits in line with its batch. Keys stay in line when their jobs go; this tells them apart.
    pub(super) fn waiting_job(&self, key: JobKey, batch: BatchId) -> Option<&Job> {
        self.jobs.get(&key).filter(|job| job.state == JobState::Waiting && job.batch == batch)
    }
}

/// What the jobs of one plan request share.
#[derive(Debug)]
pub(super) struct Batch {
    pub(super) task: TaskId,
    pub(super) needs: Requirements,
    pub(super) module: Module,
    /// What a node needs to have before it can run them.
    pub(super) contents: Vec<Content>,
    /// They count for its project: some of its jobs had a place.
    pub(super) counted: bool,
    /// Its jobs in [`App::jobs`].
    pub(super) open_jobs: u32,
    /// Those of them that have a place and are not executed.
    pub(super) placed_jobs: u32,
    /// Under the policy `neighbours`: what jobs took, and when the next part of those held back is due.
    pub(super) samples: Samples,
    pub(super) low: Low,
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
    /// Attempts that ended because a node could not get its contents, and when the first did.
    pub(super) starved: u32,
    pub(super) starved_since: Option<Instant>,
    /// The node that lost it last: another one is preferred.
    pub(super) avoid: Option<NodeId>,
    /// Nodes it was stolen from, in order: it is never stolen back.
    pub(super) stolen_from: Vec<NodeId>,
}

/// Where a job is, as far as the coordinator knows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum JobState {
    /// In `fresh`, `stuck`, `lost`, `reserved` or its project's line.
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
    /// Node and device that a global steal took it from.
    pub(super) stolen_from: Option<(NodeId, DeviceIndex)>,
    pub(super) load: Load,
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
    /// It says that it hears nothing from here: until it does it counts as silent, whatever it says.
    pub(super) deaf: bool,
    pub(super) last_heard: Instant,
    pub(super) state: NodeState,
    /// Gave a job back while not draining: gets nothing new until then.
    pub(super) full_until: Option<Instant>,
    /// Jobs that it should hold and did not, because they were in transit, or so it seemed.
    pub(super) missing: BTreeMap<JobId, Missing>,
    /// Then it is asked for them again.
    pub(super) ask_at: Option<Instant>,
    /// Jobs placed or executed here.
    pub(super) jobs: BTreeSet<JobId>,
    /// What it holds of earlier coordinators' plans, and its applications have not asked for yet.
    pub(super) brought: BTreeMap<JobId, Brought>,
    /// Contents that its jobs named: it has them, or will soon.
    contents: BTreeSet<ContentHash>,
    /// By the last heartbeat, if it says so.
    pub(super) cache: Option<CacheFigures>,
    /// It joined and has not stolen yet: it may take jobs of any application.
    pub(super) joining: bool,
    /// When it may try to steal again, and how often in a row it tried in vain.
    pub(super) steal_at: Instant,
    pub(super) vain_steals: u32,
}

impl Node {
    pub(super) fn new(hello: &NodeHello, now: Instant) -> Self {
        Self {
            name: hello.name.clone(),
            session: hello.session,
            contact: hello.contact.clone(),
            devices: hello.devices.iter().cloned().map(|info| Device::new(info, now)).collect(),
            link: None,
            deaf: false,
            last_heard: now,
            state: NodeState::Alive,
            full_until: None,
            missing: BTreeMap::new(),
            ask_at: None,
            jobs: BTreeSet::new(),
            brought: BTreeMap::new(),
            contents: BTreeSet::new(),
            cache: None,
            joining: true,
            steal_at: now,
            vain_steals: 0,
        }
    }

    /// Bytes of these contents that it has to fetch.
    pub(super) fn missing_bytes(&self, contents: &[Content]) -> u64 {
        let missing = contents.iter().filter(|content| !self.contents.contains(&content.hash));
        missing.fold(0, |sum, content| sum.saturating_add(content.size_bytes))
    }

    /// It gets jobs that name these.
    pub(super) fn will_hold(&mut self, contents: &[Content]) {
        self.contents.extend(contents.iter().map(|content| content.hash));
        while self.contents.len() > MAX_KNOWN_CONTENTS {
            self.contents.pop_first();
        }
    }

    /// It dropped one.
    pub(super) fn holds_no_more(&mut self, content: ContentHash) {
        self.contents.remove(&content);
    }

    /// Whether it answers, as far as is known.
    pub(super) fn is_up(&self) -> bool {
        match self.state {
            NodeState::Alive | NodeState::Draining => self.link.is_some(),
            NodeState::Suspect => false,
        }
    }

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

    /// The device that will be free first of those that can take the jobs of a lost one.
    pub(super) fn sibling_of(
        &self,
        now: Instant,
        lost: DeviceIndex,
        modules: &Modules,
    ) -> Option<DeviceIndex> {
        let lost = &self.devices.get(usize::from(lost.0))?.info;
        let siblings = (0_u16..).zip(&self.devices);
        let standing = siblings.filter(|(_, device)| !device.lost && device.info.stands_in_for(lost));
        let free_at = |device: &Device| device.free_at_ns(now, modules);
        let first = standing.min_by(|(_, one), (_, other)| free_at(one).total_cmp(&free_at(other)));
        first.map(|(index, _)| DeviceIndex(index))
    }
}

/// A device of a node.
#[derive(Debug)]
pub(super) struct Device {
    pub(super) info: DeviceInfo,
    pub(super) lost: bool,
    /// Of the jobs placed here and not executed.
    pub(super) throughput: Throughput,
    pub(super) planned_jobs: u64,
    /// Since when it may have been at the job that it runs now.
    busy_since: Instant,
    /// By the last heartbeat.
    pub(super) running: Option<RunningJob>,
    pub(super) executed_jobs: u64,
    pub(super) device_time_ns: u64,
}

impl Device {
    pub(super) const fn new(info: DeviceInfo, now: Instant) -> Self {
        let throughput = Throughput::new(info.score);
        Self {
            info,
            lost: false,
            throughput,
            planned_jobs: 0,
            busy_since: now,
            running: None,
            executed_jobs: 0,
            device_time_ns: 0,
        }
    }

    /// When it will be done with what it has, in nanoseconds from now: what is queued, less what of the first job must be
    /// done already. A first job that takes far longer than it should is taken to need as long again as it is overdue: then
    /// either the job or the device is not what it was taken for, and nothing else will tell before it ends.
    pub(super) fn free_at_ns(&self, now: Instant, modules: &Modules) -> f64 {
        if self.planned_jobs == 0 {
            return 0.0;
        }
        let queued_ns = self.throughput.queued_ns(modules);
        let elapsed_ns = now.since(self.busy_since).as_nanos() as f64;
        let first_ns = queued_ns / self.planned_jobs as f64;
        queued_ns - elapsed_ns.min(first_ns) + (elapsed_ns - OVERDUE * first_ns).max(0.0)
    }

    pub(super) fn add_load(&mut self, now: Instant, load: Load) {
        if self.planned_jobs == 0 {
            self.busy_since = now;
        }
        self.throughput.add(load);
        self.planned_jobs += 1;
    }

    pub(super) fn drop_load(&mut self, load: Load) {
        self.throughput.remove(load);
        self.planned_jobs -= 1;
    }

    /// Counts one completed job, and learns from it what such jobs cost, in points of score times nanoseconds.
    pub(super) fn completed(
        &mut self,
        now: Instant,
        modules: &mut Modules,
        load: Load,
        device_time_ns: u64,
    ) -> f64 {
        self.busy_since = now;
        self.executed_jobs += 1;
        self.device_time_ns = self.device_time_ns.saturating_add(device_time_ns);
        self.throughput.completed(modules, load, device_time_ns)
    }
}
