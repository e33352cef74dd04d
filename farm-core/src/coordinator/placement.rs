//! Where jobs go: first come, first served over plan requests, and list scheduling inside one: each job to the device
//! with the earliest estimated finish (10-scheduling.md section 1).
//!
//! It never moves a job that has a place; that is `replan`'s.

use std::collections::BTreeMap;

use super::{
    CoordinatorMachine,
    model::{App, Batch, Job, JobState, Pending, Placement},
};
use crate::{
    device::Requirements,
    id::{AppId, Attempt, BatchId, DeviceIndex, JobAttempt, JobKey, NodeId, TaskId},
    message::{CoordinatorToApp, CostNs, DevicePlan, NodePlan, Plan, PlanRequest, WaitReason},
    time::Instant,
};

/// Most jobs in one plan request. The ledger asks for a quarter of it; a peer that asks for more is expelled.
const MAX_REQUEST_JOBS: usize = 16_384;

/// Most jobs of one application that are neither delivered nor failed: 1 Mi. The ledger keeps to a quarter of it
/// and holds the rest back in the application's own memory; an application that asks for more is expelled.
const MAX_APP_JOBS: usize = 1 << 20;

/// Most jobs in one repeated plan.
const MAX_REPEATED_JOBS: usize = 4_096;

/// What a job of unknown cost counts as when no job of its batch has a known one, in nanoseconds. Only its ratio to
/// other jobs of unknown cost matters, and that is 1.
const UNIT_LOAD_NS: u64 = 1_000_000;

/// Costs count up to this, in nanoseconds (about 13 days): no hint can make a device's queue overflow.
const MAX_LOAD_NS: u64 = 1 << 50;

impl CoordinatorMachine {
    pub(super) fn plan_requested(&mut self, id: AppId, request: PlanRequest) {
        let Some(app) = self.apps.get_mut(&id) else { return };
        if request.jobs.len() > MAX_REQUEST_JOBS || app.jobs.len() + request.jobs.len() > MAX_APP_JOBS {
            let reason = format!(
                "a request holds at most {MAX_REQUEST_JOBS} jobs, an application at most {MAX_APP_JOBS} undelivered ones"
            );
            self.expel_app(id, reason);
            return;
        }
        // Asked again: whoever waits is told again.
        let mut keys = self.withdraw_pending(id, request.batch);
        let Some(app) = self.apps.get_mut(&id) else { return };
        let intake = take_in(app, &request);
        keys.extend(intake.fresh);
        if !keys.is_empty() {
            let batch = request.batch;
            self.fresh.push_back(Pending { app: id, batch, answers: Some(batch), keys });
        }
        for key in intake.failed {
            self.repeat_failure(id, key);
        }
    }

    /// Places what the current event brought up; what finds no device waits in `stuck`.
    pub(super) fn place_pending(&mut self, now: Instant) {
        // Jobs that lost their place came before anything that is new.
        for ((app, batch), keys) in std::mem::take(&mut self.lost).into_iter().rev() {
            self.fresh.push_front(Pending { app, batch, answers: None, keys });
        }
        while let Some(pending) = self.fresh.pop_front() {
            self.place_batch(now, pending);
        }
    }

    /// Something changed that may give waiting jobs a device.
    pub(super) fn retry_stuck(&mut self) {
        while let Some(pending) = self.stuck.pop_back() {
            self.fresh.push_front(pending);
        }
    }

    pub(super) fn forget_pending(&mut self, gone: impl Fn(&Pending) -> bool) {
        self.fresh.retain(|pending| !gone(pending));
        self.stuck.retain(|pending| !gone(pending));
    }

    /// Takes the jobs of a task out of line.
    pub(super) fn forget_waiting(&mut self, id: AppId, task: TaskId) {
        for queue in [&mut self.fresh, &mut self.stuck] {
            for pending in queue.iter_mut().filter(|pending| pending.app == id) {
                pending.keys.retain(|key| key.task != task);
            }
            queue.retain(|pending| !pending.keys.is_empty());
        }
    }

    /// Says again where the application's jobs are.
    pub(super) fn repeat_placements(&mut self, id: AppId) {
        let Some(app) = self.apps.get(&id) else { return };
        // Executed ones too: an application that lost its memory must know of a result before it comes.
        let placed = |job: &Job| job.state.holder().is_some();
        let keys: Vec<JobKey> = app.jobs.iter().filter(|(_, job)| placed(job)).map(|(&key, _)| key).collect();
        for chunk in keys.chunks(MAX_REPEATED_JOBS) {
            self.repeat_plan(id, chunk);
        }
    }

    /// Says again where these jobs are, as far as they have a place.
    pub(super) fn repeat_plan(&mut self, id: AppId, keys: &[JobKey]) {
        let Some(app) = self.apps.get(&id) else { return };
        let mut grouped: BTreeMap<NodeId, BTreeMap<DeviceIndex, Vec<JobAttempt>>> = BTreeMap::new();
        for &key in keys {
            let (node, device, attempt) = match app.jobs.get(&key).map(|job| job.state) {
                Some(JobState::Placed(place)) => (place.node, place.device, place.attempt),
                Some(JobState::Executed { node, device, attempt }) => (node, device, attempt),
                Some(JobState::Waiting) | None => continue,
            };
            let attempt = JobAttempt { job: key.in_app(id), attempt };
            grouped.entry(node).or_default().entry(device).or_default().push(attempt);
        }
        let nodes: Vec<NodePlan> =
            grouped.into_iter().filter_map(|(node, devices)| self.node_plan(node, devices)).collect();
        if !nodes.is_empty() {
            self.tell_app(id, CoordinatorToApp::Plan(Plan { batch: None, nodes }));
        }
    }

    fn place_batch(&mut self, now: Instant, mut pending: Pending) {
        let Some(app) = self.apps.get(&pending.app) else { return };
        let Some(batch) = app.batches.get(&pending.batch) else { return };
        let wants = wanted(app, &pending);
        if wants.is_empty() {
            return;
        }
        // While its application is away a job could not be sent: it would only fill up a device's queue.
        let candidates =
            if app.link.is_some() { self.candidates(now, app, &batch.needs) } else { Candidates::default() };
        if candidates.queues.is_empty() {
            pending.keys = wants.into_iter().map(|want| want.key).collect();
            self.say_waiting(pending.app, pending.batch);
            self.stuck.push_back(pending);
            return;
        }
        let shares = self.list_schedule(now, pending.app, &wants, candidates);
        let nodes = self.enter_plan(shares);
        if pending.answers.is_none() {
            self.replanned_jobs += wants.len() as u64;
        }
        self.tell_app(pending.app, CoordinatorToApp::Plan(Plan { batch: pending.answers, nodes }));
    }

    /// Devices that may take jobs of these needs, by node and index.
    fn candidates(&self, now: Instant, app: &App, needs: &Requirements) -> Candidates {
        let mut candidates = Candidates::default();
        for (&id, node) in self.nodes.iter().filter(|(_, node)| node.takes_work()) {
            if app.unreachable.get(&id).is_some_and(|until| *until > now) {
                continue;
            }
            for (index, device) in (0_u16..).zip(&node.devices) {
                if device.lost || !needs.fulfilled_by(&device.info) {
                    continue;
                }
                let time_per_load = 1.0 / device.rate(&self.calibration);
                let free_at = device.queued_ns as f64 * time_per_load;
                candidates.queues.push(Queue { node: id, free_at, time_per_load });
                candidates.shares.push(Share {
                    node: id,
                    device: DeviceIndex(index),
                    jobs: Vec::new(),
                    load_ns: 0,
                });
            }
        }
        candidates
    }

    /// Gives each job to the device with the earliest estimated finish.
    fn list_schedule(
        &mut self,
        now: Instant,
        id: AppId,
        wants: &[Want],
        candidates: Candidates,
    ) -> Vec<Share> {
        let Candidates { mut queues, mut shares } = candidates;
        let Some(app) = self.apps.get_mut(&id) else { return shares };
        for want in wants {
            let Some(job) = app.jobs.get_mut(&want.key) else { continue };
            let load = want.load_ns as f64;
            let Some(index) = earliest_finish(&queues, load, want.avoid) else { continue };
            let (queue, chosen) = (&mut queues[index], &mut shares[index]);
            let attempt = Attempt { epoch: self.config.epoch, sequence: self.next_attempt };
            self.next_attempt += 1;
            queue.free_at += load * queue.time_per_load;
            chosen.load_ns += u128::from(want.load_ns);
            chosen.jobs.push(JobAttempt { job: want.key.in_app(id), attempt });
            job.state = JobState::Placed(Placement {
                node: chosen.node,
                device: chosen.device,
                attempt,
                planned_at: now,
                load_ns: want.load_ns,
                retracting: None,
            });
            app.waiting_jobs -= 1;
            if let Some(batch) = app.batches.get_mut(&job.batch) {
                batch.told = None;
            }
        }
        shares
    }

    /// Books the chosen places on their nodes, and groups them for the application.
    fn enter_plan(&mut self, shares: Vec<Share>) -> Vec<NodePlan> {
        let mut plans: Vec<NodePlan> = Vec::new();
        for share in shares.into_iter().filter(|share| !share.jobs.is_empty()) {
            let Some(node) = self.nodes.get_mut(&share.node) else { continue };
            node.jobs.extend(share.jobs.iter().map(|job| job.job));
            node.joining = false;
            if let Some(device) = node.device_mut(share.device) {
                device.queued_ns += share.load_ns;
                device.planned_jobs += share.jobs.len() as u64;
            }
            let id = share.node;
            let share = DevicePlan { device: share.device, jobs: share.jobs };
            match plans.last_mut() {
                Some(plan) if plan.node == id => plan.devices.push(share),
                Some(_) | None => plans.push(NodePlan {
                    node: id,
                    session: node.session,
                    contact: node.contact.clone(),
                    devices: vec![share],
                }),
            }
        }
        plans
    }

    fn node_plan(&self, id: NodeId, devices: BTreeMap<DeviceIndex, Vec<JobAttempt>>) -> Option<NodePlan> {
        let node = self.nodes.get(&id)?;
        let devices = devices.into_iter().map(|(device, jobs)| DevicePlan { device, jobs }).collect();
        Some(NodePlan { node: id, session: node.session, contact: node.contact.clone(), devices })
    }

    fn say_waiting(&mut self, id: AppId, batch: BatchId) {
        let reason = if self.nodes.is_empty() { WaitReason::NoNode } else { WaitReason::NoFittingDevice };
        let Some(app) = self.apps.get_mut(&id).filter(|app| app.link.is_some()) else { return };
        let Some(waiting) = app.batches.get_mut(&batch) else { return };
        if waiting.told.replace(reason) != Some(reason) {
            self.tell_app(id, CoordinatorToApp::Waiting { batch, reason });
        }
    }

    /// Takes the waiting jobs of a batch out of the queues.
    fn withdraw_pending(&mut self, id: AppId, batch: BatchId) -> Vec<JobKey> {
        let mut keys = Vec::new();
        if !self.apps.get(&id).is_some_and(|app| app.batches.contains_key(&batch)) {
            return keys;
        }
        for queue in [&mut self.fresh, &mut self.stuck] {
            queue.retain_mut(|pending| {
                let asked = pending.app == id && pending.batch == batch;
                if asked {
                    keys.append(&mut pending.keys);
                }
                !asked
            });
        }
        let Some(app) = self.apps.get_mut(&id) else { return Vec::new() };
        if let Some(waiting) = app.batches.get_mut(&batch) {
            waiting.told = None;
        }
        keys.retain(|key| app.waiting_job(*key, batch).is_some());
        keys
    }
}

/// A job to be placed.
struct Want {
    key: JobKey,
    load_ns: u64,
    avoid: Option<NodeId>,
}

/// Devices that may take jobs: `queues[i]` and `shares[i]` are one device's. Apart, because every job reads all the
/// queues and writes one share.
#[derive(Default)]
struct Candidates {
    queues: Vec<Queue>,
    shares: Vec<Share>,
}

/// How busy a device is. Times are in nanoseconds from now.
struct Queue {
    node: NodeId,
    free_at: f64,
    time_per_load: f64,
}

/// What a device got so far.
struct Share {
    node: NodeId,
    device: DeviceIndex,
    jobs: Vec<JobAttempt>,
    load_ns: u128,
}

/// What a plan request consists of, seen from what is known.
#[derive(Default)]
struct Intake {
    fresh: Vec<JobKey>,
    failed: Vec<JobKey>,
}

/// Enters the jobs of a request that are new; a repeated request (after a reconnect) changes nothing.
fn take_in(app: &mut App, request: &PlanRequest) -> Intake {
    let mut intake = Intake::default();
    for planned in &request.jobs {
        let key = JobKey { task: request.task, index: planned.index };
        if app.failed.contains_key(&key) {
            intake.failed.push(key);
            continue;
        }
        match app.jobs.get(&key) {
            // Its place was repeated when the application came back.
            Some(_) => {}
            None => {
                let (batch, cost) = (request.batch, planned.cost);
                let job = Job {
                    batch,
                    cost,
                    state: JobState::Waiting,
                    crashes: 0,
                    avoid: None,
                    stolen_from: Vec::new(),
                };
                app.jobs.insert(key, job);
                intake.fresh.push(key);
            }
        }
    }
    if let Ok(added @ 1..) = u32::try_from(intake.fresh.len()) {
        app.waiting_jobs += u64::from(added);
        let new = || Batch { needs: request.needs, open_jobs: 0, told: None };
        app.batches.entry(request.batch).or_insert_with(new).open_jobs += added;
    }
    intake
}

/// The jobs of a batch in line that still wait, with their loads: a job of unknown cost counts as much as the mean of the known ones.
fn wanted(app: &App, pending: &Pending) -> Vec<Want> {
    let mut wants = Vec::with_capacity(pending.keys.len());
    let mut known = 0_u64;
    let mut known_ns = 0_u128;
    for &key in &pending.keys {
        let Some(job) = app.waiting_job(key, pending.batch) else { continue };
        let load_ns = job.cost.0.min(MAX_LOAD_NS);
        if job.cost != CostNs(0) {
            known += 1;
            known_ns += u128::from(load_ns);
        }
        wants.push(Want { key, load_ns, avoid: job.avoid });
    }
    let mean_ns = known_ns.checked_div(u128::from(known)).and_then(|mean| u64::try_from(mean).ok());
    let unknown_ns = mean_ns.unwrap_or(UNIT_LOAD_NS);
    for want in wants.iter_mut().filter(|want| want.load_ns == 0) {
        want.load_ns = unknown_ns;
    }
    wants
}

/// The device that would finish a job first; one on another node than `avoid` wherever there is one.
///
/// A scan, not a heap: with unequal loads and rates the order of finishes differs from job to job. The scan reads two
/// numbers per device; see `farm-core/tests/placement_cost.rs` for what it costs at 1,000 devices.
fn earliest_finish(queues: &[Queue], load: f64, avoid: Option<NodeId>) -> Option<usize> {
    let elsewhere = earliest(queues.iter().enumerate().filter(|(_, queue)| avoid != Some(queue.node)), load);
    elsewhere.or_else(|| earliest(queues.iter().enumerate(), load))
}

fn earliest<'queue>(queues: impl Iterator<Item = (usize, &'queue Queue)>, load: f64) -> Option<usize> {
    let mut best = None;
    let mut best_finish = f64::INFINITY;
    for (index, queue) in queues {
        let finish = queue.free_at + load * queue.time_per_load;
        if best.is_none() || finish < best_finish {
            best = Some(index);
            best_finish = finish;
        }
    }
    best
}
