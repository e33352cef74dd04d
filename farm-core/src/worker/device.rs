//! Devices: their queues, one running and one staged job each, local stealing (10-scheduling.md sections 2 and 3),
//! completion and loss.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use super::{
    Effect, WorkerMachine,
    job::{Handed, HeldState, Rank, Spooled},
};
use crate::{
    device::DeviceInfo,
    id::{AppId, ContentHash, DeviceIndex, JobAttempt, JobId},
    message::{CostNs, DeviceLoad, Executed, JobFailure, NodeToCoordinator, RunningJob},
    time::Instant,
};

/// One running, one staged: more would move the lottery's decision further away from the moment it counts.
const MAX_HANDED_OVER: usize = 2;

/// What a job of unknown cost adds to a queue, in nanoseconds.
const UNKNOWN_COST_NS: u64 = 1_000_000;

const NANOSECONDS_PER_SECOND: f64 = 1e9;

/// A device of this node.
#[derive(Debug)]
pub(super) struct Device {
    info: DeviceInfo,
    pub(super) lost: bool,
    /// Jobs that could be staged, by application. No queue is empty.
    queues: BTreeMap<AppId, BTreeSet<Rank>>,
    pub(super) queued_jobs: usize,
    queued_ns: u128,
    /// Jobs planned here that wait for contents.
    pub(super) waiting_jobs: usize,
    /// With the executor: the first one runs or is about to, the second one is staged.
    pub(super) handed_over: VecDeque<JobId>,
}

impl Device {
    pub(super) const fn new(info: DeviceInfo) -> Self {
        Self {
            info,
            lost: false,
            queues: BTreeMap::new(),
            queued_jobs: 0,
            queued_ns: 0,
            waiting_jobs: 0,
            handed_over: VecDeque::new(),
        }
    }

    pub(super) fn enqueue(&mut self, rank: Rank, cost: CostNs) {
        assert!(
            self.queues.entry(rank.job.app).or_default().insert(rank),
            "I1: {} is queued twice",
            rank.job
        );
        self.queued_jobs += 1;
        self.queued_ns += u128::from(load_ns(cost));
    }

    pub(super) fn dequeue(&mut self, rank: Rank, cost: CostNs) {
        let queue = self.queues.get_mut(&rank.job.app);
        let (found, empty) = queue.map_or((false, false), |queue| (queue.remove(&rank), queue.is_empty()));
        assert!(found, "I1: {} is not in the queue it should be in", rank.job);
        if empty {
            self.queues.remove(&rank.job.app);
        }
        self.queued_jobs -= 1;
        self.queued_ns -= u128::from(load_ns(cost));
    }

    /// The queues, for the invariants.
    pub(super) const fn queues(&self) -> &BTreeMap<AppId, BTreeSet<Rank>> {
        &self.queues
    }

    /// Whether a job planned for `other` may run here: the same kind, and nothing that `other` has is lacking. What the
    /// job itself needs is not on its ticket.
    fn stands_in_for(&self, other: &Self) -> bool {
        !self.lost
            && self.info.kind == other.info.kind
            && self.info.features.contains(other.info.features)
            && self.info.limits.cover(&other.info.limits)
    }

    /// How long the queue takes, up to a common factor.
    fn backlog(&self) -> f64 {
        self.queued_ns as f64 / self.info.score
    }
}

impl WorkerMachine {
    /// Hands jobs to executors until every device has a running and a staged one, or nothing is left.
    pub(super) fn fill_devices(&mut self, now: Instant) {
        if self.devices.iter().all(|device| device.queued_jobs == 0) {
            return;
        }
        for index in self.device_indices() {
            while self.has_room(index) && self.hand_over(now, index, index) {}
        }
        if !self.config.local_stealing {
            return;
        }
        // An idle device steals whatever is queued; a busy one only what its owner would not start next.
        for (handed_over, left) in [(0, 1), (1, 2)] {
            for index in self.device_indices() {
                if self.device_mut(index).handed_over.len() == handed_over {
                    self.steal(now, index, left);
                }
            }
        }
    }

    pub(super) fn started(&mut self, now: Instant, job: JobAttempt, device: DeviceIndex) {
        let held =
            self.jobs.get_mut(&job.job).filter(|held| (held.attempt, held.device) == (job.attempt, device));
        let Some(HeldState::HandedOver(handed)) = held.map(|held| &mut held.state) else { return };
        handed.started_at = Some(now);
        let handed_over = &mut self.device_mut(device).handed_over;
        // The executor says which one runs: it goes to the front.
        if let Some(position) = handed_over.iter().position(|other| *other == job.job) {
            handed_over.swap(0, position);
        }
    }

    pub(super) fn executed(
        &mut self,
        now: Instant,
        job: JobAttempt,
        device: DeviceIndex,
        device_time_ns: u64,
        outcome: Result<(Vec<u64>, ContentHash), JobFailure>,
    ) {
        let current =
            self.jobs.get(&job.job).filter(|held| held.attempt == job.attempt && held.device == device);
        let Some(HeldState::HandedOver(handed)) = current.map(|held| &held.state) else {
            // Aborted, replaced, or lost with its device: nobody waits for this payload. A spooled result of the same
            // attempt is another matter, and stays.
            if self.jobs.get(&job.job).is_none_or(|held| held.attempt != job.attempt) {
                self.push(Effect::Discard(job));
            }
            return;
        };
        let trace = handed.trace(now);
        let cost = device_time_ns as f64 / NANOSECONDS_PER_SECOND * self.device_mut(device).info.score;
        self.share.charge(job.job.app, cost);
        match outcome {
            Err(failure) if failure.can_be_retried() => {
                self.remove(job);
                self.push(Effect::Discard(job));
                let failed = Executed { job, device, device_time_ns, trace, failure: Some(failure) };
                self.reports.executed(now, failed);
            }
            Ok((sections, digest)) => {
                self.reports.executed(now, Executed { job, device, device_time_ns, trace, failure: None });
                self.spool(job, Spooled::completed(job, device, device_time_ns, sections, digest));
            }
            Err(failure) => {
                let failed = Executed { job, device, device_time_ns, trace, failure: Some(failure.clone()) };
                self.reports.executed(now, failed);
                self.spool(job, Spooled::failed(job, device, device_time_ns, failure));
            }
        }
    }

    pub(super) fn device_lost(&mut self, now: Instant, index: DeviceIndex, reason: &str) {
        let Some(device) = self.devices.get_mut(usize::from(index.0)).filter(|device| !device.lost) else {
            return;
        };
        device.lost = true;
        if self.session.is_registered() {
            self.tell_coordinator(NodeToCoordinator::DeviceLost { device: index, reason: reason.to_owned() });
        }
        let mut on_it = Vec::new();
        let mut queued = Vec::new();
        for (&job, held) in self.jobs.iter().filter(|(_, held)| held.device == index) {
            let job = JobAttempt { job, attempt: held.attempt };
            match held.state {
                HeldState::HandedOver(_) => on_it.push(job),
                HeldState::Fetching { .. } | HeldState::Queued => queued.push((held.arrival, job)),
                HeldState::Executed(_) => {}
            }
        }
        for job in on_it {
            self.remove(job);
            self.push(Effect::Discard(job));
            self.report_failure(now, job, index, JobFailure::DeviceLost(reason.to_owned()));
        }
        queued.sort_unstable();
        for (_, job) in queued {
            self.move_or_give_back(now, job, index);
        }
    }

    /// As the coordinator is told.
    pub(super) fn loads(&self, now: Instant) -> Vec<DeviceLoad> {
        self.devices.iter().map(|device| self.load(now, device)).collect()
    }

    fn load(&self, now: Instant, device: &Device) -> DeviceLoad {
        let running = device.handed_over.front().and_then(|&id| {
            let held = self.jobs.get(&id)?;
            let HeldState::HandedOver(Handed { started_at: Some(started_at), .. }) = held.state else {
                return None;
            };
            let for_ns = u64::try_from(now.since(started_at).as_nanos()).unwrap_or(u64::MAX);
            Some(RunningJob { job: JobAttempt { job: id, attempt: held.attempt }, for_ns })
        });
        let held = device.queued_jobs + device.waiting_jobs + device.handed_over.len();
        let queued_jobs = u32::try_from(held - usize::from(running.is_some())).unwrap_or(u32::MAX);
        DeviceLoad { queued_jobs, running }
    }

    pub(super) fn lost_devices(&self) -> impl Iterator<Item = DeviceIndex> {
        (0_u16..).zip(&self.devices).filter(|(_, device)| device.lost).map(|(index, _)| DeviceIndex(index))
    }

    /// The device itself, or a sibling that stands in for it if it is lost.
    pub(super) fn standing_device(&self, index: DeviceIndex) -> Option<DeviceIndex> {
        let planned = self.devices.get(usize::from(index.0))?;
        if !planned.lost {
            return Some(index);
        }
        let siblings = (0_u16..).zip(&self.devices).filter(|(_, device)| device.stands_in_for(planned));
        let shortest = siblings.min_by(|(_, one), (_, other)| one.backlog().total_cmp(&other.backlog()));
        shortest.map(|(index, _)| DeviceIndex(index))
    }

    pub(super) fn device_mut(&mut self, index: DeviceIndex) -> &mut Device {
        self.devices.get_mut(usize::from(index.0)).expect("held jobs are only on devices of this node")
    }

    fn device_indices(&self) -> impl Iterator<Item = DeviceIndex> + use<> {
        let count = u16::try_from(self.devices.len()).unwrap_or(u16::MAX);
        (0..count).map(DeviceIndex)
    }

    fn has_room(&mut self, index: DeviceIndex) -> bool {
        let device = self.device_mut(index);
        !device.lost && device.handed_over.len() < MAX_HANDED_OVER
    }

    /// Takes a job of the sibling with the longest queue, if that has at least `least` queued.
    fn steal(&mut self, now: Instant, thief: DeviceIndex, least: usize) -> bool {
        let Some(own) = self.devices.get(usize::from(thief.0)).filter(|device| !device.lost) else {
            return false;
        };
        if own.queued_jobs > 0 {
            return false;
        }
        let victims = (0_u16..).zip(&self.devices).filter(|(index, device)| {
            *index != thief.0 && device.queued_jobs >= least && own.stands_in_for(device)
        });
        let longest = victims.max_by(|(_, one), (_, other)| one.backlog().total_cmp(&other.backlog()));
        let Some(victim) = longest.map(|(index, _)| DeviceIndex(index)) else { return false };
        self.hand_over(now, victim, thief)
    }

    /// Draws an application among those with jobs in a device's queue, and hands its first job to a device.
    fn hand_over(&mut self, now: Instant, from: DeviceIndex, to: DeviceIndex) -> bool {
        let Some(source) = self.devices.get(usize::from(from.0)) else { return false };
        let Some(app) = self.share.draw(&mut source.queues.keys().copied(), &mut self.rng) else {
            return false;
        };
        let Some(rank) = source.queues.get(&app).and_then(|queue| queue.first()).copied() else {
            return false;
        };
        let Some(held) = self.jobs.get_mut(&rank.job) else { return false };
        let stolen_from = (from != to).then_some(from);
        held.state = HeldState::HandedOver(Handed { staged_at: now, started_at: None, stolen_from });
        held.device = to;
        let (attempt, cost) = (held.attempt, held.cost);
        self.device_mut(from).dequeue(rank, cost);
        self.device_mut(to).handed_over.push_back(rank.job);
        self.push(Effect::Execute { job: JobAttempt { job: rank.job, attempt }, device: to });
        true
    }

    fn move_or_give_back(&mut self, now: Instant, job: JobAttempt, lost: DeviceIndex) {
        let Some(to) = self.standing_device(lost) else { return self.give_back(now, job) };
        let Some(held) = self.jobs.get_mut(&job.job) else { return };
        held.device = to;
        let (rank, cost) = (held.rank(job.job), held.cost);
        let queued = matches!(held.state, HeldState::Queued);
        if queued {
            self.device_mut(lost).dequeue(rank, cost);
            self.device_mut(to).enqueue(rank, cost);
        } else {
            self.device_mut(lost).waiting_jobs -= 1;
            self.device_mut(to).waiting_jobs += 1;
        }
    }
}

fn load_ns(cost: CostNs) -> u64 {
    if cost == CostNs(0) { UNKNOWN_COST_NS } else { cost.0 }
}
