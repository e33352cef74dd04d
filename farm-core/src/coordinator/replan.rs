//! What was lost, given up or withdrawn: jobs lose their place here, and get into line for a new one or leave.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use super::{
    CoordinatorMachine, NodeState,
    model::{Device, Job, JobState},
    neighbours::Place,
};
use crate::{
    id::{AppId, Attempt, ContentHash, DeviceIndex, JobAttempt, JobId, JobKey, NodeId, NodeSession, TaskId},
    message::{CoordinatorToApp, CoordinatorToNode, JobFailure, NodeHello},
    time::Instant,
};

/// How long a node stays out of an application's plans after the application could not reach it, in milliseconds.
const UNREACHABLE_MS: u64 = 60_000;

/// Most failures of one application that are remembered for repetition; beyond it the smallest ids are forgotten.
const MAX_REMEMBERED_FAILURES: usize = 4_096;

/// A job fails by its contents after so many attempts in which a node could not get them (three tries each)…
const MAX_STARVED: u32 = 8;

/// … and no sooner than this after the first: a network that is down for some seconds costs no job.
const STARVED_PATIENCE: Duration = Duration::from_secs(30);

/// On each device a node runs one job and has staged one: only these can have brought it down.
const SUSPECT_JOBS_PER_DEVICE: usize = 2;

/// Whose crash the loss of a node counts as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Blame {
    /// It was a partition, or the node left in good order.
    Nobody,
    /// The process died: of the jobs that must have been on a device then, the oldest of each application on it.
    OldestOnEachDevice,
}

impl CoordinatorMachine {
    /// Removes a node; its undelivered jobs get into line for new attempts.
    pub(super) fn remove_node(&mut self, now: Instant, id: NodeId, blame: Blame) {
        self.end_steals_from(id);
        self.drop_backups(|_, backup| backup.node == id);
        let Some(node) = self.nodes.remove(&id) else { return };
        if let Some(link) = node.link {
            self.close(link);
        }
        self.forget_cache_of(now, id);
        for app in self.apps.values_mut() {
            app.unreachable.remove(&id);
        }
        let blamed = match blame {
            Blame::Nobody => BTreeSet::new(),
            Blame::OldestOnEachDevice => self.oldest_jobs(&node.jobs),
        };
        tracing::warn!(node = %id, %now, jobs = node.jobs.len(), "node lost");
        for job in node.jobs {
            if blamed.contains(&job) {
                self.crashed(job, JobFailure::DeviceLost(format!("{id} was lost")), id);
            } else {
                self.requeue(job, Some(id));
            }
        }
    }

    /// Jobs of a node's earlier life that its new one brought along, taken off the earlier one's books.
    pub(super) fn inherited(&mut self, id: NodeId, hello: &NodeHello) -> Vec<JobId> {
        let mut kept = Vec::new();
        for item in &hello.inventory {
            let holder = self.job(item.job).map(|job| job.state);
            let fits = match holder {
                Some(JobState::Placed(place)) => usize::from(place.device.0) < hello.devices.len(),
                Some(JobState::Executed { .. }) => true,
                Some(JobState::Waiting) | None => false,
            };
            if fits && self.holder(item.job) == Some((id, item.attempt)) {
                let Some(node) = self.nodes.get_mut(&id) else { break };
                if node.jobs.remove(&item.job) {
                    kept.push(item.job);
                }
            }
        }
        kept
    }

    /// Books inherited jobs on the new life of their node, and tells their applications.
    pub(super) fn inherit(&mut self, now: Instant, id: NodeId, kept: &[JobId]) {
        let mut by_app: BTreeMap<AppId, Vec<JobKey>> = BTreeMap::new();
        for &job in kept {
            let state = self.job(job).map(|job| job.state);
            let Some(node) = self.nodes.get_mut(&id) else { return };
            node.jobs.insert(job);
            if let Some(JobState::Placed(place)) = state
                && let Some(device) = node.device_mut(place.device)
            {
                device.add_load(now, place.load);
                by_app.entry(job.app).or_default().push(JobKey::of(job));
            }
        }
        for (app, keys) in by_app {
            self.repeat_plan(app, &keys);
        }
    }

    /// An application cannot reach a node: its jobs move off it.
    pub(super) fn unreachable(&mut self, now: Instant, app: AppId, id: NodeId, session: NodeSession) {
        if self.nodes.get(&id).is_none_or(|node| node.session != session) {
            return;
        }
        self.drop_backups(|job, backup| (job.app, backup.node) == (app, id));
        let Some(node) = self.nodes.get(&id) else { return };
        let jobs: Vec<JobId> = node.jobs.range(JobId::range_of(app)).copied().collect();
        let until = now.after(Duration::from_millis(UNREACHABLE_MS));
        if let Some(app) = self.apps.get_mut(&app) {
            app.unreachable.insert(id, until);
            self.arm(until);
        }
        self.move_off(id, jobs);
    }

    /// The application has results of these jobs already: of attempts that were given up here, or of which the node could
    /// not tell. Nothing further is owed.
    pub(super) fn already_delivered(&mut self, app: AppId, jobs: &[JobId]) {
        for &job in jobs.iter().filter(|job| job.app == app) {
            if self.job(job).is_some() {
                self.forget_delivered(job);
            }
        }
    }

    /// The application gives a task up.
    pub(super) fn cancel_task(&mut self, id: AppId, task: TaskId) {
        let Some(app) = self.apps.get(&id) else { return };
        let jobs: Vec<JobId> =
            app.jobs.range(JobKey::range_of(task)).map(|(key, _)| key.in_app(id)).collect();
        self.withdraw(jobs);
        self.forget_waiting(id, task);
    }

    /// Forgets jobs, and has nodes drop what they hold of them.
    pub(super) fn withdraw(&mut self, jobs: Vec<JobId>) {
        let mut on_nodes: BTreeMap<NodeId, Vec<JobAttempt>> = BTreeMap::new();
        for job in jobs {
            self.drop_backup(job);
            if let Some((node, attempt)) = self.holder(job) {
                on_nodes.entry(node).or_default().push(JobAttempt { job, attempt });
            }
            self.forget_job(job);
        }
        for (node, jobs) in on_nodes {
            self.tell_node(node, CoordinatorToNode::Cancel { jobs });
        }
    }

    /// An attempt ended with its device or node: a new one follows, unless there were too many.
    pub(super) fn crashed(&mut self, id: JobId, failure: JobFailure, node: NodeId) {
        if !self.is_poison(id, failure, node) {
            self.requeue(id, Some(node));
        }
    }

    /// A second attempt failed: the first one goes on, unless that was a crash too many.
    pub(super) fn backup_failed(&mut self, id: JobId, failure: JobFailure, node: NodeId) {
        self.drop_backup(id);
        let first = self.holder(id);
        if failure != JobFailure::Returned
            && self.is_poison(id, failure, node)
            && let Some((node, attempt)) = first
        {
            self.tell_node(node, CoordinatorToNode::Cancel { jobs: vec![JobAttempt { job: id, attempt }] });
        }
    }

    /// Counts a crash. A job that had too many fails here.
    fn is_poison(&mut self, id: JobId, failure: JobFailure, node: NodeId) -> bool {
        let max_crashes = self.config.max_crashes;
        let Some(job) = self.job_mut(id) else { return false };
        job.crashes = job.crashes.saturating_add(1);
        if job.crashes < max_crashes {
            return false;
        }
        let reason = format!(
            "{} attempts ended with their device or node, the last one on {node}: {failure:?}",
            job.crashes
        );
        self.fail_job(id, JobFailure::Poison(reason));
        true
    }

    /// A node could not get what a job needs: no executor crashed, but it cannot go on for ever.
    pub(super) fn starved(&mut self, now: Instant, id: JobId, content: ContentHash, node: NodeId) {
        let Some(job) = self.job_mut(id) else { return };
        job.starved = job.starved.saturating_add(1);
        let since = *job.starved_since.get_or_insert(now);
        if job.starved >= MAX_STARVED && now.since(since) >= STARVED_PATIENCE {
            self.fail_job(id, JobFailure::ContentUnavailable(content));
        } else {
            self.requeue(id, Some(node));
        }
    }

    /// Takes a job off its place and puts it into line for a new attempt; one that runs elsewhere too just goes on
    /// there.
    pub(super) fn requeue(&mut self, id: JobId, avoid: Option<NodeId>) {
        if self.promote_backup(id).is_some() {
            self.repeat_plan(id.app, &[JobKey::of(id)]);
            return;
        }
        let Some(app) = self.apps.get_mut(&id.app) else { return };
        let key = JobKey::of(id);
        let Some(job) = app.jobs.get_mut(&key) else { return };
        let before = std::mem::replace(&mut job.state, JobState::Waiting);
        if before == JobState::Waiting {
            return;
        }
        job.avoid = avoid;
        let batch = job.batch;
        app.waiting_jobs += 1;
        self.lost.entry((id.app, batch)).or_default().push(key);
        self.release(id.app, key, before);
        if matches!(before, JobState::Placed(_)) {
            self.left_place(id.app, batch);
        }
    }

    /// Takes what a job occupies off the books of its node.
    pub(super) fn release(&mut self, app: AppId, key: JobKey, state: JobState) {
        let Some((id, _)) = state.holder() else { return };
        self.projects.relieve(app);
        if let JobState::Placed(place) = state {
            self.projects.vacates(app, (place.node, place.device));
        }
        // A node that is gone took its books along.
        let Some(node) = self.nodes.get_mut(&id) else { return };
        node.jobs.remove(&key.in_app(app));
        if let JobState::Placed(place) = state
            && let Some(device) = node.device_mut(place.device)
        {
            device.drop_load(place.load);
            self.runs_dry((place.node, place.device));
        }
    }

    /// A job is over, or nobody wants it any more.
    pub(super) fn forget_job(&mut self, id: JobId) -> Option<Job> {
        self.drop_backup(id);
        let app = self.apps.get_mut(&id.app)?;
        let key = JobKey::of(id);
        let job = app.jobs.remove(&key)?;
        match job.state {
            JobState::Waiting => app.waiting_jobs -= 1,
            JobState::Placed(_) => self.left_place(id.app, job.batch),
            JobState::Executed { .. } => {}
        }
        let app = self.apps.get_mut(&id.app)?;
        if let Some(batch) = app.batches.get_mut(&job.batch) {
            batch.open_jobs -= 1;
            if batch.open_jobs == 0 {
                if let Some(over) = app.batches.remove(&job.batch) {
                    self.projects.batch_over(id.app, &over);
                }
                let batch = job.batch;
                self.forget_pending(|pending| pending.app == id.app && pending.batch == batch);
            }
        }
        self.release(id.app, key, job.state);
        Some(job)
    }

    /// Says again which jobs were given up.
    pub(super) fn repeat_failures(&mut self, id: AppId) {
        let Some(app) = self.apps.get(&id) else { return };
        let keys: Vec<JobKey> = app.failed.keys().copied().collect();
        keys.into_iter().for_each(|key| self.repeat_failure(id, key));
    }

    pub(super) fn repeat_failure(&mut self, id: AppId, key: JobKey) {
        let Some(failure) = self.apps.get(&id).and_then(|app| app.failed.get(&key)).cloned() else { return };
        self.tell_app(id, CoordinatorToApp::JobFailed { job: key.in_app(id), failure });
    }

    /// Node and attempt that answer for a job.
    pub(super) fn holder(&self, id: JobId) -> Option<(NodeId, Attempt)> {
        self.job(id).and_then(|job| job.state.holder())
    }

    /// Whether the node drains: jobs that it gives back are no sign of a full queue.
    pub(super) fn drains(&self, id: NodeId) -> bool {
        self.nodes.get(&id).is_some_and(|node| node.state == NodeState::Draining)
    }

    pub(super) fn job_mut(&mut self, id: JobId) -> Option<&mut Job> {
        self.apps.get_mut(&id.app)?.jobs.get_mut(&JobKey::of(id))
    }

    pub(super) fn device(&self, (node, index): Place) -> Option<&Device> {
        self.nodes.get(&node)?.devices.get(usize::from(index.0))
    }

    pub(super) fn job(&self, id: JobId) -> Option<&Job> {
        self.apps.get(&id.app)?.jobs.get(&JobKey::of(id))
    }

    pub(super) fn fail_job(&mut self, id: JobId, failure: JobFailure) {
        self.forget_job(id);
        let key = JobKey::of(id);
        let Some(app) = self.apps.get_mut(&id.app) else { return };
        if app.failed.len() >= MAX_REMEMBERED_FAILURES {
            app.failed.pop_first();
        }
        app.failed.insert(key, failure);
        self.repeat_failure(id.app, key);
    }

    /// Takes jobs off a node that still stands.
    pub(super) fn move_off(&mut self, id: NodeId, jobs: Vec<JobId>) {
        let mut cancelled = Vec::with_capacity(jobs.len());
        for job in jobs {
            if let Some((_, attempt)) = self.holder(job) {
                cancelled.push(JobAttempt { job, attempt });
            }
            self.requeue(job, Some(id));
        }
        if !cancelled.is_empty() {
            self.tell_node(id, CoordinatorToNode::Cancel { jobs: cancelled });
        }
    }

    /// The jobs that may have been on a device when their node died.
    fn oldest_jobs(&self, jobs: &BTreeSet<JobId>) -> BTreeSet<JobId> {
        let mut queues: BTreeMap<(AppId, DeviceIndex), BTreeMap<Attempt, JobId>> = BTreeMap::new();
        for &id in jobs {
            let Some(JobState::Placed(place)) = self.job(id).map(|job| job.state) else { continue };
            let oldest = queues.entry((id.app, place.device)).or_default();
            oldest.insert(place.attempt, id);
            if oldest.len() > SUSPECT_JOBS_PER_DEVICE {
                oldest.pop_last();
            }
        }
        queues.into_values().flat_map(BTreeMap::into_values).collect()
    }
}
