//! Devices: their queues, what their executors hold, what they are worth, completion and loss.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use super::{
    Effect, WorkerMachine,
    job::{Handed, HeldState, Phase, Rank, Spooled},
    rate::Rate,
};
use crate::{
    device::DeviceInfo,
    id::{AppId, ContentHash, DeviceIndex, JobAttempt, JobId},
    message::{CostNs, DeviceLoad, Executed, JobFailure, NodeToCoordinator, RunningJob},
    time::Instant,
};

/// What a job of unknown cost adds to a queue, in nanoseconds.
const UNKNOWN_COST_NS: u64 = 1_000_000;

/// What a job without measurable device time is charged for, in nanoseconds: it took a place all the same.
const LEAST_CHARGE_NS: u64 = 1_000;

const NANOSECONDS_PER_SECOND: f64 = 1e9;

/// A device of this node.
#[derive(Debug)]
pub(super) struct Device {
    pub(super) info: DeviceInfo,
    pub(super) lost: bool,
    /// Jobs that could be staged, by application. No queue is empty.
    queues: BTreeMap<AppId, BTreeSet<Rank>>,
    pub(super) queued_jobs: usize,
    queued_ns: u128,
    pub(super) rate: Rate,
    /// Jobs planned here that wait for contents.
    pub(super) waiting_jobs: usize,
    /// With the executor: the first one runs or is about to; behind it are those that are staged or interrupted.
    pub(super) handed_over: VecDeque<JobId>,
}

impl Device {
    pub(super) fn new(info: DeviceInfo) -> Self {
        Self {
            info,
            lost: false,
            queues: BTreeMap::new(),
            queued_jobs: 0,
            queued_ns: 0,
            rate: Rate::default(),
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

    /// Whether a job planned for `other` may run here.
    pub(super) fn stands_in_for(&self, other: &Self) -> bool {
        !self.lost && self.info.stands_in_for(&other.info)
    }

    /// Work in the queue, in nanoseconds at speed 1.0.
    pub(super) const fn queued_ns(&self) -> u128 {
        self.queued_ns
    }
}

impl WorkerMachine {
    /// The executor says that a job runs: for the first time, or again.
    pub(super) fn started(&mut self, now: Instant, job: JobAttempt, device: DeviceIndex) {
        if self.handed(job, device).is_none() {
            return;
        }
        // One runs at a time: what ran before has been interrupted.
        for other in self.device_mut(device).handed_over.clone() {
            if let Some(handed) = self.handed_mut(other)
                && other != job.job
            {
                handed.pause(now);
            }
        }
        if let Some(handed) = self.handed_mut(job.job) {
            handed.run(now);
        }
        let handed_over = &mut self.device_mut(device).handed_over;
        if let Some(position) = handed_over.iter().position(|other| *other == job.job)
            && let Some(first) = handed_over.remove(position)
        {
            handed_over.push_front(first);
        }
    }

    /// The executor says that a job was interrupted at a launch boundary; its state is still on the device.
    pub(super) fn yielded(&mut self, now: Instant, job: JobAttempt, device: DeviceIndex) {
        if self.handed(job, device).is_some()
            && let Some(handed) = self.handed_mut(job.job)
        {
            handed.pause(now);
        }
    }

    /// How a job is with the executor of `device`, if it is.
    fn handed(&self, job: JobAttempt, device: DeviceIndex) -> Option<Handed> {
        let held = self.jobs.get(&job.job)?;
        match held.state {
            HeldState::HandedOver(handed) if (held.attempt, held.device) == (job.attempt, device) => {
                Some(handed)
            }
            HeldState::HandedOver(_)
            | HeldState::Fetching { .. }
            | HeldState::Queued
            | HeldState::Executed(_) => None,
        }
    }

    fn handed_mut(&mut self, job: JobId) -> Option<&mut Handed> {
        match self.jobs.get_mut(&job).map(|held| &mut held.state) {
            Some(HeldState::HandedOver(handed)) => Some(handed),
            Some(HeldState::Fetching { .. } | HeldState::Queued | HeldState::Executed(_)) | None => None,
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
        let Some(handed) = self.handed(job, device) else {
            // Aborted, replaced, or lost with its device: nobody waits for this payload. A spooled result of the same
            // attempt is another matter, and stays.
            if self.jobs.get(&job.job).is_none_or(|held| held.attempt != job.attempt) {
                self.push(Effect::Discard(job));
                // It took the device as long as it ran.
                self.charge(job.job.app, device, device_time_ns);
            }
            return;
        };
        let trace = handed.trace(now);
        self.charge(job.job.app, device, device_time_ns.max(LEAST_CHARGE_NS));
        if outcome.is_ok() {
            let cost = self.jobs.get(&job.job).map_or(CostNs(0), |held| held.cost);
            self.device_mut(device).rate.observe(cost, device_time_ns);
        }
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

    fn charge(&mut self, app: AppId, device: DeviceIndex, device_time_ns: u64) {
        let Some(device) = self.devices.get(usize::from(device.0)) else { return };
        self.lags.charge(app, device_time_ns as f64 / NANOSECONDS_PER_SECOND * device.info.score);
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
                HeldState::HandedOver(handed) => on_it.push((job, handed.trace(now))),
                HeldState::Fetching { .. } | HeldState::Queued => queued.push((held.arrival, job)),
                HeldState::Executed(_) => {}
            }
        }
        for (job, trace) in on_it {
            self.remove(job);
            self.push(Effect::Discard(job));
            let failure = Some(JobFailure::DeviceLost(reason.to_owned()));
            self.reports.executed(now, Executed { job, device: index, device_time_ns: 0, trace, failure });
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
            let HeldState::HandedOver(handed) = held.state else { return None };
            let Phase::Running { .. } = handed.phase else { return None };
            let for_ns = u64::try_from(handed.ran(now).as_nanos()).unwrap_or(u64::MAX);
            Some(RunningJob { job: JobAttempt { job: id, attempt: held.attempt }, for_ns })
        });
        let held = device.queued_jobs + device.waiting_jobs + device.handed_over.len();
        let queued_jobs = u32::try_from(held - usize::from(running.is_some())).unwrap_or(u32::MAX);
        DeviceLoad { queued_jobs, running }
    }

    pub(super) fn lost_devices(&self) -> impl Iterator<Item = DeviceIndex> {
        (0_u16..).zip(&self.devices).filter(|(_, device)| device.lost).map(|(index, _)| DeviceIndex(index))
    }

    /// The device itself, or a sibling that stands in for it if it is lost and the application's jobs may go there.
    pub(super) fn standing_device(&self, index: DeviceIndex, app: AppId) -> Option<DeviceIndex> {
        let planned = self.devices.get(usize::from(index.0))?;
        if !planned.lost {
            return Some(index);
        }
        if self.apps.get(&app).is_some_and(|app| app.stays) {
            return None;
        }
        let siblings = (0_u16..).zip(&self.devices).filter(|(_, device)| device.stands_in_for(planned));
        let backlog = |device: &Device| device.queued_ns as f64 / self.speed(device);
        let shortest = siblings.min_by(|(_, one), (_, other)| backlog(one).total_cmp(&backlog(other)));
        shortest.map(|(index, _)| DeviceIndex(index))
    }

    pub(super) fn device_mut(&mut self, index: DeviceIndex) -> &mut Device {
        self.devices.get_mut(usize::from(index.0)).expect("held jobs are only on devices of this node")
    }

    pub(super) fn device_indices(&self) -> impl Iterator<Item = DeviceIndex> + use<> {
        let count = u16::try_from(self.devices.len()).unwrap_or(u16::MAX);
        (0..count).map(DeviceIndex)
    }

    fn move_or_give_back(&mut self, now: Instant, job: JobAttempt, lost: DeviceIndex) {
        let Some(to) = self.standing_device(lost, job.job.app) else { return self.give_back(now, job) };
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

pub(super) fn load_ns(cost: CostNs) -> u64 {
    if cost == CostNs(0) { UNKNOWN_COST_NS } else { cost.0 }
}
