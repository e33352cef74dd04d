//! After a restart (20-delivery.md, failure table): what an earlier coordinator planned goes on where it is. Nodes bring along
//! what they hold, applications say where their jobs are; where both say the same the job has its place, and nothing is planned
//! anew. For a while after its start the coordinator waits for nodes that applications name and that are not back yet.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use super::{
    CoordinatorMachine,
    model::{JobState, Pending, Placement},
    placement::{load_of, wanted},
};
use crate::{
    id::{AppId, Attempt, BatchId, DeviceIndex, JobAttempt, JobId, JobKey, NodeId, NodeSession},
    message::{HeldJob, JobFailure, NodeHello},
    time::Instant,
};

/// Where jobs of one batch are: node, device, attempt.
type Places = BTreeMap<JobKey, (NodeId, DeviceIndex, Attempt)>;

/// A job that its application says is on a node that is not back yet.
#[derive(Clone, Copy, Debug)]
pub(super) struct Awaited {
    batch: BatchId,
    device: DeviceIndex,
    attempt: Attempt,
}

/// What is known of an earlier coordinator's plans.
#[derive(Debug, Default)]
pub(super) struct Recovery {
    /// Nodes are waited for until then; `None` before the first event.
    until: Option<Instant>,
    awaited: BTreeMap<NodeSession, BTreeMap<(AppId, JobKey), Awaited>>,
}

impl Recovery {
    pub(super) fn deadline(&self) -> Option<Instant> {
        self.until.filter(|_| !self.awaited.is_empty())
    }

    /// Jobs that wait for a node to come back.
    pub(super) fn awaited(&self) -> impl Iterator<Item = (AppId, JobKey, BatchId)> {
        let all = self.awaited.values().flatten();
        all.map(|(&(app, key), awaited)| (app, key, awaited.batch))
    }
}

/// An attempt of an earlier coordinator that a node brought along, until its application asks for it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Brought {
    attempt: Attempt,
    /// It was, since.
    executed: bool,
}

impl Brought {
    pub(super) const fn of(&self, job: JobId) -> JobAttempt {
        JobAttempt { job, attempt: self.attempt }
    }
}

impl CoordinatorMachine {
    /// The first event starts the time in which nodes are waited for: as long as silence may last.
    pub(super) fn begin_recovery(&mut self, now: Instant) {
        let dead = Duration::from_millis(self.config.liveness.dead_ms);
        self.recovery.until.get_or_insert_with(|| now.after(dead));
    }

    /// Of the jobs of a request that are new here: those that keep the place they have, or wait for its node, are taken out.
    /// Gives the others.
    pub(super) fn keep_held(
        &mut self,
        now: Instant,
        app: AppId,
        batch: BatchId,
        fresh: Vec<JobKey>,
        held: &[HeldJob],
    ) -> Vec<JobKey> {
        if held.is_empty() || app.0 > self.issued_before() {
            return fresh;
        }
        let held: BTreeMap<JobKey, &HeldJob> = match fresh.first() {
            Some(first) => {
                held.iter().map(|job| (JobKey { task: first.task, index: job.index }, job)).collect()
            }
            None => return fresh,
        };
        let sessions: BTreeMap<NodeSession, NodeId> =
            self.nodes.iter().map(|(&id, node)| (node.session, id)).collect();
        let waits = self.recovery.until.is_some_and(|until| now < until);
        let (mut here, mut others) = (Places::new(), Vec::new());
        for key in fresh {
            match held.get(&key) {
                Some(job) => match sessions.get(&job.session) {
                    Some(&node) => {
                        here.insert(key, (node, job.device, job.attempt));
                    }
                    None if waits => {
                        let awaited = Awaited { batch, device: job.device, attempt: job.attempt };
                        self.recovery.awaited.entry(job.session).or_default().insert((app, key), awaited);
                    }
                    None => others.push(key),
                },
                None => others.push(key),
            }
        }
        if let Some(until) = self.recovery.deadline() {
            self.arm(until);
        }
        others.extend(self.adopt(now, app, batch, here));
        others
    }

    /// Keeps in mind what a node brings along of earlier coordinators' plans, and gives it what waited for it.
    pub(super) fn node_brings(&mut self, now: Instant, id: NodeId, hello: &NodeHello) {
        let issued_before = self.issued_before();
        let unknown = |item: &&JobAttempt| item.job.app.0 <= issued_before && !self.knows_place(item.job);
        let brought: BTreeMap<JobId, Brought> = hello
            .inventory
            .iter()
            .filter(unknown)
            .map(|item| (item.job, Brought { attempt: item.attempt, executed: false }))
            .collect();
        let Some(node) = self.nodes.get_mut(&id) else { return };
        node.brought = brought;
        let awaited = self.recovery.awaited.remove(&hello.session).unwrap_or_default();
        let mut batches: BTreeMap<(AppId, BatchId), Places> = BTreeMap::new();
        for ((app, key), awaited) in awaited {
            let place = (id, awaited.device, awaited.attempt);
            batches.entry((app, awaited.batch)).or_default().insert(key, place);
        }
        for ((app, batch), jobs) in batches {
            let rest = self.adopt(now, app, batch, jobs);
            if !rest.is_empty() {
                self.lost.entry((app, batch)).or_default().extend(rest);
            }
        }
    }

    /// Whether an attempt of a node's inventory may still be asked for: an earlier coordinator planned it, and its application
    /// has not said yet what it has of it.
    pub(super) fn may_be_adopted(&self, node: NodeId, item: JobAttempt) -> bool {
        let brought = self.nodes.get(&node).and_then(|node| node.brought.get(&item.job));
        brought.is_some_and(|brought| brought.attempt == item.attempt)
    }

    /// A report of what a node brought along, and nobody has asked for yet.
    pub(super) fn brought_ended(&mut self, node: NodeId, job: JobAttempt, failure: Option<&JobFailure>) {
        let Some(node) = self.nodes.get_mut(&node) else { return };
        match failure {
            None => {
                let brought = node.brought.get_mut(&job.job).filter(|brought| brought.attempt == job.attempt);
                brought.into_iter().for_each(|brought| brought.executed = true);
            }
            Some(_) => drop(node.brought.remove(&job.job)),
        }
    }

    /// Nobody is waited for any longer: what waits is planned anew.
    pub(super) fn end_recovery(&mut self, now: Instant) {
        if self.recovery.until.is_none_or(|until| now < until) {
            return;
        }
        for ((app, key), awaited) in std::mem::take(&mut self.recovery.awaited).into_values().flatten() {
            let waits = self.apps.get(&app).and_then(|app| app.waiting_job(key, awaited.batch)).is_some();
            if waits {
                self.lost.entry((app, awaited.batch)).or_default().push(key);
            }
        }
    }

    fn knows_place(&self, job: JobId) -> bool {
        self.holder(job).is_some()
    }

    /// Gives jobs the places that they have already; gives back those that their nodes do not hold, and that still wait.
    fn adopt(&mut self, now: Instant, id: AppId, batch: BatchId, jobs: Places) -> Vec<JobKey> {
        let pending = Pending { app: id, batch, answers: None, keys: jobs.keys().copied().collect() };
        let Some(app) = self.apps.get(&id) else { return Vec::new() };
        let Some(module) = app.batches.get(&batch).map(|batch| batch.module) else { return Vec::new() };
        let wanted = wanted(app, &pending);
        let (mut adopted, mut rest) = (Vec::new(), Vec::new());
        let mut touched = BTreeSet::new();
        let Some(task) = pending.keys.first().map(|key| key.task) else { return rest };
        for job in &wanted {
            let key = JobKey { task, index: job.index };
            let Some(&(node_id, device, attempt)) = jobs.get(&key) else { continue };
            let Some(node) = self.nodes.get_mut(&node_id) else { continue };
            let has_device = node.devices.get(usize::from(device.0)).is_some_and(|device| !device.lost);
            let job_id = key.in_app(id);
            let brought = node.brought.get(&job_id).copied();
            let Some(brought) = brought.filter(|brought| has_device && brought.attempt == attempt) else {
                rest.push(key);
                continue;
            };
            node.brought.remove(&job_id);
            node.jobs.insert(job_id);
            node.joining = false;
            let load = load_of(module, job);
            let state = if brought.executed {
                JobState::Executed { node: node_id, device, attempt }
            } else {
                if let Some(device) = node.device_mut(device) {
                    device.add_load(now, load);
                }
                self.projects.occupies(id, (node_id, device));
                JobState::Placed(Placement {
                    node: node_id,
                    device,
                    attempt,
                    planned_at: now,
                    stolen_from: None,
                    load,
                    retracting: None,
                })
            };
            touched.insert(node_id);
            adopted.push((key, state));
        }
        if !adopted.is_empty() {
            self.count_contents(&pending);
        }
        let Some(app) = self.apps.get_mut(&id) else { return rest };
        let contents = app.batches.get_mut(&batch).map_or_else(Vec::new, |batch| {
            batch.told = None;
            batch.contents.clone()
        });
        for &(key, state) in &adopted {
            if let Some(job) = app.jobs.get_mut(&key) {
                job.state = state;
                app.waiting_jobs -= 1;
            }
            if let (JobState::Placed(_), Some(batch)) = (state, app.batches.get_mut(&batch)) {
                batch.placed_jobs += 1;
            }
        }
        for node in touched {
            if let Some(node) = self.nodes.get_mut(&node) {
                node.will_hold(&contents);
            }
        }
        // What has been delivered meanwhile the application says in turn.
        let keys: Vec<JobKey> = adopted.into_iter().map(|(key, _)| key).collect();
        self.repeat_plan(id, &keys);
        rest
    }
}
