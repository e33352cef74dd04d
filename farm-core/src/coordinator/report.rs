//! What nodes say of their work: executed, delivered, loads, lost devices.

use std::time::Duration;

use super::{
    CoordinatorMachine,
    model::{JobState, Placement},
    policy::Policy,
    rates::Load,
    reserve::before,
};
use crate::{
    id::{DeviceIndex, JobAttempt, JobId, JobKey, NodeId},
    message::{CacheFigures, CoordinatorToNode, DeviceLoad, Executed, JobFailure},
    time::Instant,
};

/// How long a node that gave a job back, though it does not drain, gets nothing new, in milliseconds.
const FULL_MS: u64 = 1_000;

impl CoordinatorMachine {
    pub(super) fn reported(
        &mut self,
        now: Instant,
        node: NodeId,
        executed: Vec<Executed>,
        delivered: &[JobAttempt],
    ) {
        for ended in executed {
            self.executed(now, node, ended);
        }
        for &job in delivered {
            self.delivered(node, job);
        }
    }

    pub(super) fn loads_reported(&mut self, id: NodeId, loads: &[DeviceLoad], cache: Option<CacheFigures>) {
        let Some(node) = self.nodes.get_mut(&id) else { return };
        node.cache = cache;
        for (device, load) in node.devices.iter_mut().zip(loads) {
            device.running = load.running;
        }
    }

    /// Its node moves what was queued there to devices that stand in for it, and gives it back where there is none or where
    /// jobs have to stay on their devices.
    pub(super) fn device_lost(&mut self, now: Instant, id: NodeId, index: DeviceIndex, reason: &str) {
        tracing::warn!(node = %id, device = %index, reason, "device lost");
        let Some(node) = self.nodes.get_mut(&id) else { return };
        let Some(device) = node.device_mut(index) else { return };
        device.lost = true;
        device.running = None;
        for job in node.jobs.iter().copied().collect::<Vec<_>>() {
            if self.projects.quota_of(job.app).devices.is_none() {
                self.follow_to_sibling(now, id, index, job);
            }
        }
    }

    /// Books a job of a lost device on a sibling, as its node does. Which one the node took shows when it ran.
    fn follow_to_sibling(&mut self, now: Instant, id: NodeId, lost: DeviceIndex, job: JobId) {
        let is_here = |place: &&mut Placement| place.node == id && place.device == lost;
        let app = self.apps.get_mut(&job.app);
        let first = app.and_then(|app| app.jobs.get_mut(&JobKey::of(job))).map(|job| &mut job.state);
        let first =
            first.and_then(|state| if let JobState::Placed(place) = state { Some(place) } else { None });
        let Some(place) = first.filter(is_here).or_else(|| self.backups.get_mut(&job).filter(is_here)) else {
            return;
        };
        let Some(node) = self.nodes.get_mut(&id) else { return };
        let Some(sibling) = node.sibling_of(now, lost, &self.modules) else { return };
        place.device = sibling;
        let load = place.load;
        self.projects.vacates(job.app, (id, lost));
        self.projects.occupies(job.app, (id, sibling));
        if let Some(device) = node.device_mut(lost) {
            device.drop_load(load);
        }
        if let Some(device) = node.device_mut(sibling) {
            device.add_load(now, load);
        }
    }

    fn executed(&mut self, now: Instant, node: NodeId, ended: Executed) {
        self.trace(node, &ended);
        let Executed { job: JobAttempt { job: id, attempt }, device, device_time_ns, trace: _, failure } =
            ended;
        let job = JobAttempt { job: id, attempt };
        if self.is_backup(job, node) {
            match failure {
                Some(failure) if failure.can_be_retried() => {
                    self.backup_failed(id, failure.clone(), node);
                    return self.app_crashed(now, (node, device), job, &failure);
                }
                Some(_) | None => self.first_one_loses(id),
            }
        }
        // Reports of attempts that were replaced meanwhile change nothing.
        if self.holder(id) != Some((node, attempt)) {
            self.brought_ended(node, job, failure.as_ref());
            return;
        }
        match failure {
            None => {
                self.drop_backup(id);
                if let Some(load) = self.device_freed(node, JobAttempt { job: id, attempt }) {
                    self.account(now, node, device, id, load, device_time_ns);
                }
            }
            Some(JobFailure::Returned) => {
                if !self.drains(node) && !self.device((node, device)).is_some_and(|device| device.lost) {
                    self.node_full(now, node);
                }
                self.requeue(id, Some(node));
            }
            Some(JobFailure::ContentUnavailable(content)) => self.starved(now, id, content, node),
            Some(failure) if failure.can_be_retried() => {
                self.crashed(id, failure.clone(), node);
                self.app_crashed(now, (node, device), job, &failure);
            }
            // Its application gets this failure from the node, as a result; nothing else is owed.
            Some(_) => {
                self.drop_backup(id);
                self.device_freed(node, JobAttempt { job: id, attempt });
            }
        }
    }

    /// The second attempt ended first. Its application hears that this is the one that counts now: it may have lost its link to
    /// the node meanwhile, and have given up what was only a second attempt.
    fn first_one_loses(&mut self, id: JobId) {
        let loser = self.holder(id);
        self.promote_backup(id);
        self.repeat_plan(id.app, &[JobKey::of(id)]);
        if let Some((node, attempt)) = loser {
            self.tell_node(node, CoordinatorToNode::Cancel { jobs: vec![JobAttempt { job: id, attempt }] });
        }
    }

    fn delivered(&mut self, node: NodeId, job: JobAttempt) {
        if self.holder(job.job) != Some((node, job.attempt)) {
            if let Some(node) = self.nodes.get_mut(&node) {
                node.brought.remove(&job.job);
            }
            return;
        }
        self.forget_delivered(job.job);
    }

    /// A job is over: its application has the result.
    pub(super) fn forget_delivered(&mut self, job: JobId) {
        self.forget_job(job);
        self.delivered_jobs += 1;
        if let Some(app) = self.apps.get_mut(&job.app) {
            app.delivered_jobs += 1;
        }
    }

    /// The job left its device. Returns its load the first time it is told.
    fn device_freed(&mut self, id: NodeId, job: JobAttempt) -> Option<Load> {
        let record = self.job_mut(job.job)?;
        let JobState::Placed(place) = record.state else { return None };
        record.state = JobState::Executed { node: id, device: place.device, attempt: job.attempt };
        let batch = record.batch;
        self.projects.vacates(job.job.app, (id, place.device));
        let device = self.nodes.get_mut(&id)?.device_mut(place.device)?;
        device.drop_load(place.load);
        let planned_jobs = device.planned_jobs;
        self.left_place(job.job.app, batch);
        self.device_has(planned_jobs, job.job.app, batch);
        self.runs_dry((id, place.device));
        Some(place.load)
    }

    /// Charges a completed job, and learns from it, on the device that ran it (a local steal may have moved it).
    fn account(
        &mut self,
        now: Instant,
        id: NodeId,
        index: DeviceIndex,
        job: JobId,
        load: Load,
        device_time_ns: u64,
    ) {
        let place = (id, index);
        let Some(device) = self.nodes.get_mut(&id).and_then(|node| node.device_mut(index)) else { return };
        let point_ns = device.completed(now, &mut self.modules, load, device_time_ns);
        let Some(app) = self.apps.get_mut(&job.app) else { return };
        app.device_time_ns = app.device_time_ns.saturating_add(device_time_ns);
        app.breaker.completed();
        if app.policy.learns()
            && let Some(record) = app.jobs.get(&JobKey::of(job))
            && let Some(batch) = app.batches.get_mut(&record.batch)
        {
            let before = before(&self.history, &app.policy, &app.name, job.index, record.cost);
            batch.samples.note(job.index, place, before, device_time_ns);
        }
        if app.policy == Policy::History {
            self.history.note(&app.name, job.index, point_ns);
        }
        self.keep_speeds(id, index);
    }

    fn node_full(&mut self, now: Instant, id: NodeId) {
        let until = now.after(Duration::from_millis(FULL_MS));
        if let Some(node) = self.nodes.get_mut(&id) {
            node.full_until = Some(until);
            self.arm(until);
        }
    }
}
