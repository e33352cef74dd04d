//! Batches of the policy `neighbours`: their jobs go out in parts, each when devices are about to run
//! out of the one before, and the last few for each device at once, packed by what the jobs beside them took.
//!
//! Jobs go out in an order that is even over the batch at any time. So what has run tells of all that has not, each device
//! gets jobs from everywhere, and those that come last are as unlike as the batch is: large and small ones, of which shares
//! that end together can be made.

use super::{
    CoordinatorMachine,
    model::{Device, JobState, Node, Pending},
    neighbours::{Estimates, Place},
    placement::{load_amount, told_load},
    policy::{History, LongestFirst, Packed, PlacementPolicy as _, Policy, Question},
};
use crate::{
    id::{AppId, BatchId, DeviceIndex, JobIndex, JobKey},
    message::CostNs,
    time::Instant,
};

/// Jobs of a batch's first part, for each device: enough to measure it by, and no more than a device whose score is wrong
/// by 2 can make up for later.
const FIRST: f64 = 3.0;

/// The share of what waits that goes out in a later part.
const PART: f64 = 0.25;

/// So many for each device stay behind for the last part: of two no equal shares can be made, and five are too many to be told
/// what they cost.
const LAST: f64 = 3.5;

/// The next part goes out when no more than this for each device have not ended, or a device that ended one has one left.
const LOW: f64 = 1.5;

/// What devices should have while the next part is on its way, in nanoseconds (20 ms): a report waits for up to 5 ms, plan and
/// ticket are messages on a network. Where jobs are shorter, all of the above are as many times more.
const LEAD_NS: f64 = 20e6;

/// A job that seems to take more than so many times the mean does not wait for its turn in the even order: alone it could last
/// longer than all the others of the last part.
const DEAR: f64 = 2.0;

/// A remembered point of score counts as this much load, as if devices of score 1,000 had speed 1.0. Only ratios count.
const LOAD_PER_POINT_NS: f64 = 1e-3;

/// When the next part of a batch is due.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Low {
    /// When no more of its jobs have a place.
    pub(super) jobs: u32,
    /// When a device that ended one has no more left.
    pub(super) on_device: u64,
}

impl CoordinatorMachine {
    /// What the completed jobs of a batch tell of the others. The books are kept by it from now on.
    pub(super) fn learn(&mut self, pending: &Pending) -> Option<Estimates> {
        let app = self.apps.get(&pending.app).filter(|app| app.policy.learns())?;
        let batch = app.batches.get(&pending.batch)?;
        let (task, module) = (batch.task, batch.module);
        let rate =
            |place: Place| self.device(place).map(|device| device.throughput.rate(&self.modules, module));
        let estimates = batch.samples.estimates(rate)?;
        for (&(node, index), &rate) in &estimates.rates {
            if let Some(device) = self.nodes.get_mut(&node).and_then(|node| node.device_mut(index)) {
                device.throughput.set_rate(&self.modules, module, rate);
            }
        }
        let app = self.apps.get_mut(&pending.app)?;
        for (key, job) in app.jobs.range_mut(JobKey::range_of(task)) {
            let JobState::Placed(place) = &mut job.state else { continue };
            let device = self.nodes.get_mut(&place.node).and_then(|node| node.device_mut(place.device));
            let Some(device) = device.filter(|_| job.batch == pending.batch) else { continue };
            let before = before(&self.history, &app.policy, &app.name, key.index, job.cost);
            let amount = load_amount(before * estimates.cost(key.index));
            device.throughput.rebook(place.load, amount);
            place.load.amount = amount;
        }
        Some(estimates)
    }

    /// Puts what jobs seem to cost into a question: before any other ran, what they took the last time.
    pub(super) fn estimate(&self, pending: &Pending, question: &mut Question, estimates: Option<&Estimates>) {
        let Some(app) = self.apps.get(&pending.app) else { return };
        let Some(batch) = app.batches.get(&pending.batch) else { return };
        for wanted in &mut question.jobs {
            let Some(job) = app.jobs.get(&JobKey { task: batch.task, index: wanted.index }) else { continue };
            let recalled = recall(&self.history, &app.policy, &app.name, wanted.index);
            match (estimates, recalled) {
                (Some(estimates), _) => {
                    let before = before(&self.history, &app.policy, &app.name, wanted.index, job.cost);
                    wanted.load = before * estimates.cost(wanted.index);
                }
                (None, Some(point_ns)) => wanted.load = self.modules.load(batch.module, point_ns),
                (None, None) => {}
            }
        }
    }

    /// Gives the next part of a batch its places, and keeps the rest.
    pub(super) fn place_part(
        &mut self,
        now: Instant,
        pending: &Pending,
        mut question: Question,
        measured: bool,
    ) {
        // Jobs of other batches of the module may have been of another size.
        let at_once = if measured { jobs_at_once(&question) } else { 1.0 };
        let devices = question.devices.len() as f64 * at_once;
        let mean_load = mean_load(&question);
        let jobs = &mut question.jobs;
        jobs.sort_by_key(|job| (job.load <= DEAR * mean_load, evenly(job.index)));
        let rest = jobs.split_off(part(jobs.len(), devices, measured));
        let last = rest.is_empty();
        let choices = if last { Packed.place(&question) } else { LongestFirst.place(&question) };
        self.enter(now, pending, &question, &choices);
        if last {
            return;
        }
        let keys = rest.into_iter().map(|job| JobKey { task: question.task, index: job.index });
        let (id, answers) = ((pending.app, pending.batch), pending.answers);
        let nothing = || Pending { app: id.0, batch: id.1, answers, keys: Vec::new() };
        self.reserved.entry(id).or_insert_with(nothing).keys.extend(keys);
        if let Some(batch) = self.apps.get_mut(&id.0).and_then(|app| app.batches.get_mut(&id.1)) {
            let jobs = u32::try_from(whole(LOW * devices)).unwrap_or(u32::MAX);
            batch.low = Low { jobs, on_device: whole(at_once) as u64 };
        }
    }

    /// A job of a batch has no place any more: the next part may be due.
    pub(super) fn left_place(&mut self, app: AppId, batch: BatchId) {
        let batches = self.apps.get_mut(&app).map(|app| &mut app.batches);
        let Some(left) = batches.and_then(|batches| batches.get_mut(&batch)) else { return };
        left.placed_jobs -= 1;
        if left.placed_jobs <= left.low.jobs {
            self.next_part(app, batch);
        }
    }

    /// A device ended a job of a batch: the next part may be due.
    pub(super) fn device_has(&mut self, planned_jobs: u64, app: AppId, batch: BatchId) {
        let low = self.apps.get(&app).and_then(|app| app.batches.get(&batch)).map(|batch| batch.low);
        if low.is_some_and(|low| planned_jobs <= low.on_device) {
            self.next_part(app, batch);
        }
    }

    /// A device may have nothing left: then the next part is due of every batch that it takes jobs of, whosever its last one was.
    pub(super) fn runs_dry(&mut self, place: Place) {
        if self.reserved.is_empty() {
            return;
        }
        let takes_work = self.nodes.get(&place.0).is_some_and(Node::takes_work);
        let is_idle = |device: &&Device| takes_work && !device.lost && device.planned_jobs == 0;
        let Some(device) = self.device(place).filter(is_idle) else { return };
        let fits = |(app, batch): &(AppId, BatchId)| {
            let batch = self.apps.get(app).and_then(|app| app.batches.get(batch));
            batch.is_some_and(|batch| batch.needs.fulfilled_by(&device.info))
        };
        let due: Vec<(AppId, BatchId)> = self.reserved.keys().copied().filter(fits).collect();
        for (app, batch) in due {
            self.next_part(app, batch);
        }
    }

    /// The same of all devices: some may be new, or take work again.
    pub(super) fn any_runs_dry(&mut self) {
        if self.reserved.is_empty() {
            return;
        }
        let indices = |node: &Node| (0..).map(DeviceIndex).take(node.devices.len());
        let places: Vec<Place> =
            self.nodes.iter().flat_map(|(&id, node)| indices(node).map(move |index| (id, index))).collect();
        for place in places {
            self.runs_dry(place);
        }
    }

    /// It is placed before the current event is done with.
    fn next_part(&mut self, app: AppId, batch: BatchId) {
        self.fresh.extend(self.reserved.remove(&(app, batch)));
    }
}

/// How many of the waiting jobs go out now.
fn part(waiting: usize, devices: f64, measured: bool) -> usize {
    let last = whole(LAST * devices);
    // Nobody waits for the first part: it has a job for every device.
    let least = if measured { 0 } else { whole(devices) };
    if waiting <= last + least {
        return waiting;
    }
    let part = if measured { (PART * waiting as f64).max(devices) } else { FIRST * devices };
    whole(part).clamp(1.max(least), waiting - last)
}

/// How many jobs a device should have in the place of one, because they are short.
fn jobs_at_once(question: &Question) -> f64 {
    let time_per_load: f64 = question.devices.iter().map(|device| device.time_per_load).sum();
    let job_ns = mean_load(question) * time_per_load / question.devices.len() as f64;
    (LEAD_NS / job_ns).max(1.0)
}

fn mean_load(question: &Question) -> f64 {
    question.jobs.iter().map(|job| job.load).sum::<f64>() / question.jobs.len() as f64
}

/// What a job was taken for before its batch ran: what samples are measured against.
pub(super) fn before(history: &History, policy: &Policy, app: &str, index: JobIndex, told: CostNs) -> f64 {
    let recalled = recall(history, policy, app, index);
    recalled.map_or_else(|| told_load(told), |point_ns| point_ns * LOAD_PER_POINT_NS)
}

/// What it took the last time, under the policy that remembers, in points of score times nanoseconds.
fn recall(history: &History, policy: &Policy, app: &str, index: JobIndex) -> Option<f64> {
    if *policy == Policy::History { history.recall(app, index) } else { None }
}

/// Jobs in the order of these numbers are even over their batch at any time: multiples of the golden ratio, modulo 1.
const fn evenly(index: JobIndex) -> u32 {
    index.0.wrapping_mul(0x9e37_79b9)
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a float cast saturates, and none is negative"
)]
const fn whole(jobs: f64) -> usize {
    jobs as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_part_has_a_job_for_every_device() {
        for devices in [1.0, 2.0, 8.0, 32.0] {
            for waiting in 1..300 {
                let first = part(waiting, devices, false);
                assert!(
                    first >= waiting.min(whole(devices)),
                    "{first} of {waiting} jobs for {devices} devices"
                );
            }
        }
        assert_eq!(part(540, 32.0, false), 96, "three for each");
    }
}
