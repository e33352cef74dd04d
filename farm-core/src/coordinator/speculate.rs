//! The tail of a run: when nothing is queued, a running job that will take long may run a second time on an idle device
//! (10-scheduling.md section 3). The first result counts, the other attempt is cancelled.
//!
//! It is the only defence against a node that computes far slower than anybody knows. Backups stand beside
//! [`JobState`], which names the attempt that goes on if both are lost.

use std::collections::BTreeMap;

use super::{
    CoordinatorMachine,
    model::{JobState, Placement},
};
use crate::{
    id::{AppId, Attempt, DeviceIndex, JobAttempt, JobId, JobKey, NodeId},
    message::{CoordinatorToApp, CoordinatorToNode, Plan},
    time::Instant,
};

/// A second attempt has to be this many times faster than what the first one is expected to need.
const LEAST_SPEEDUP: f64 = 2.0;

/// Most second attempts at one time in the farm: a bound of the books, far above the idle devices of a tail.
const MAX_BACKUPS: usize = 4_096;

/// A running job, as a candidate for a second attempt.
struct Straggler {
    job: JobId,
    place: Placement,
    remaining_ns: f64,
}

impl CoordinatorMachine {
    /// A node said how its devices stand: one that is idle at the tail may help.
    pub(super) fn consider_speculating(&mut self, now: Instant, helper: NodeId) {
        let Some(node) = self.nodes.get(&helper).filter(|node| node.takes_work()) else { return };
        let idle = |(_, device): &(u16, &super::model::Device)| !device.lost && device.planned_jobs == 0;
        let idle: Vec<DeviceIndex> =
            (0_u16..).zip(&node.devices).filter(idle).map(|(index, _)| DeviceIndex(index)).collect();
        if idle.is_empty() || self.backups.len() >= MAX_BACKUPS || !self.is_tail() {
            return;
        }
        for index in idle {
            if let Some(straggler) = self.straggler_for(now, helper, index) {
                self.start_backup(now, &straggler, helper, index);
            }
        }
    }

    /// Whether this attempt runs beside the one that the job's state names.
    pub(super) fn is_backup(&self, job: JobAttempt, node: NodeId) -> bool {
        self.backups.get(&job.job).is_some_and(|backup| (backup.node, backup.attempt) == (node, job.attempt))
    }

    /// Whether a node answers for this attempt.
    pub(super) fn answers_for(&self, node: NodeId, job: JobAttempt) -> bool {
        self.holder(job.job) == Some((node, job.attempt)) || self.is_backup(job, node)
    }

    /// The second attempt takes the first one's place. The caller has seen to the first one's node.
    pub(super) fn promote_backup(&mut self, id: JobId) -> Option<Placement> {
        let backup = self.backups.remove(&id)?;
        let before = std::mem::replace(&mut self.job_mut(id)?.state, JobState::Placed(backup));
        self.release(id.app, JobKey::of(id), before);
        Some(backup)
    }

    /// The second attempt of a job is of no use any more.
    pub(super) fn drop_backup(&mut self, id: JobId) {
        let Some(backup) = self.backups.remove(&id) else { return };
        self.release(id.app, JobKey::of(id), JobState::Placed(backup));
        let jobs = vec![JobAttempt { job: id, attempt: backup.attempt }];
        self.tell_node(backup.node, CoordinatorToNode::Cancel { jobs });
    }

    pub(super) fn drop_backups(&mut self, useless: impl Fn(&JobId, &Placement) -> bool) {
        let useless: Vec<JobId> =
            self.backups.iter().filter(|(id, backup)| useless(id, backup)).map(|(&id, _)| id).collect();
        useless.into_iter().for_each(|id| self.drop_backup(id));
    }

    /// Nothing is queued: each job that is not waiting for its result's acknowledgement is on a device.
    fn is_tail(&self) -> bool {
        let devices = || self.nodes.values().flat_map(|node| &node.devices);
        devices().all(|device| device.planned_jobs <= 1) && devices().any(|device| device.running.is_some())
    }

    /// The running job that gains most from a second attempt on this device.
    fn straggler_for(&self, now: Instant, helper: NodeId, index: DeviceIndex) -> Option<Straggler> {
        let device = self.device((helper, index))?;
        let running = self.nodes.iter().filter(|(id, _)| **id != helper).flat_map(|(_, node)| {
            node.devices.iter().filter_map(|device| device.running.map(|running| (node.last_heard, running)))
        });
        let mut best: Option<Straggler> = None;
        for (heard, running) in running {
            let id = running.job.job;
            let Some(place) = self.running_place(running.job) else { continue };
            let Some(app) = self.apps.get(&id.app) else { continue };
            let Some(job) = app.jobs.get(&JobKey::of(id)) else { continue };
            let fits =
                app.batches.get(&job.batch).is_some_and(|batch| batch.needs.fulfilled_by(&device.info));
            let reachable = app.link.is_some()
                && app.can_reach(now, helper)
                && self.projects.may_use(id.app, (helper, index));
            // What crashed once may be poison: one device at a time.
            let harmless = job.crashes == 0 && job.avoid != Some(helper);
            if !(app.global_stealing && fits && reachable && harmless) {
                continue;
            }
            let elapsed_ns = running.for_ns as f64 + now.since(heard).as_nanos() as f64;
            let Some(remaining_ns) = self.remaining_ns(&place, elapsed_ns) else { continue };
            let again_ns =
                place.load.amount as f64 / device.throughput.rate(&self.modules, place.load.module);
            let worth = remaining_ns > LEAST_SPEEDUP * (self.steal_latency.ns() + again_ns);
            if worth && best.as_ref().is_none_or(|best| remaining_ns > best.remaining_ns) {
                best = Some(Straggler { job: id, place, remaining_ns });
            }
        }
        best
    }

    fn running_place(&self, job: JobAttempt) -> Option<Placement> {
        match self.job(job.job).map(|job| job.state) {
            Some(JobState::Placed(place)) if place.attempt == job.attempt => {
                (!self.backups.contains_key(&job.job) && place.retracting.is_none()).then_some(place)
            }
            Some(JobState::Placed(_) | JobState::Waiting | JobState::Executed { .. }) | None => None,
        }
    }

    /// What a job still needs where it runs. One that is over its time needs as long again, as far as anybody knows.
    /// `None` while no job of its module was completed: then there is no telling.
    fn remaining_ns(&self, place: &Placement, elapsed_ns: f64) -> Option<f64> {
        if !self.modules.is_known(place.load.module) {
            return None;
        }
        let device = self.device((place.node, place.device))?;
        let whole_ns = place.load.amount as f64 / device.throughput.rate(&self.modules, place.load.module);
        Some(if elapsed_ns < whole_ns { whole_ns - elapsed_ns } else { elapsed_ns })
    }

    fn start_backup(&mut self, now: Instant, straggler: &Straggler, helper: NodeId, device: DeviceIndex) {
        let attempt = Attempt { epoch: self.config.epoch, sequence: self.next_attempt };
        self.next_attempt += 1;
        let id = straggler.job;
        let Some(node) = self.nodes.get_mut(&helper) else { return };
        let place = Placement {
            node: helper,
            device,
            attempt,
            planned_at: now,
            stolen_from: None,
            retracting: None,
            ..straggler.place
        };
        node.jobs.insert(id);
        if let Some(device) = node.device_mut(device) {
            device.add_load(now, place.load);
        }
        self.projects.occupies(id.app, (helper, device));
        self.backups.insert(id, place);
        self.speculations += 1;
        tracing::info!(job = %id, from = %straggler.place.node, to = %helper, "second attempt at the tail");
        self.say_backup(id);
    }

    fn say_backup(&mut self, id: JobId) {
        let Some(place) = self.backups.get(&id) else { return };
        let job = JobAttempt { job: id, attempt: place.attempt };
        let Some(plan) = self.node_plan(place.node, BTreeMap::from([(place.device, vec![job])])) else {
            return;
        };
        self.tell_app(
            id.app,
            CoordinatorToApp::Plan(Plan { batch: None, speculative: true, nodes: vec![plan] }),
        );
    }

    /// Says again which second attempts an application has.
    pub(super) fn repeat_backups(&mut self, app: AppId) {
        let of_app: Vec<JobId> = self.backups.keys().filter(|job| job.app == app).copied().collect();
        of_app.into_iter().for_each(|job| self.say_backup(job));
    }
}

impl CoordinatorMachine {
    /// Each backup is on the books of its node, beside a job that is placed elsewhere.
    pub(super) fn check_backups(&self) {
        for (id, backup) in &self.backups {
            let placed = match self.job(*id).map(|job| job.state) {
                Some(JobState::Placed(place)) => place.node != backup.node && place.attempt < backup.attempt,
                Some(JobState::Waiting | JobState::Executed { .. }) | None => false,
            };
            assert!(placed, "I5: {id} has a second attempt and no first one");
            let booked = self.nodes.get(&backup.node).is_some_and(|node| node.jobs.contains(id));
            assert!(booked, "I1: the second attempt at {id} is on {}, which does not know it", backup.node);
        }
    }

    pub(super) fn drop_backups_of(&mut self, app: AppId) {
        self.drop_backups(|id, _| id.app == app);
    }
}
