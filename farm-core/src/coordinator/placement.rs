//! Where jobs go: first come, first served over plan requests; inside one as the application's policy says
//! (10-scheduling.md section 1).
//!
//! It never moves a job that has a place; that is `replan`'s.

use std::collections::BTreeMap;

use super::{
    CoordinatorMachine, NodeState,
    model::{App, Batch, Job, JobState, Node, Pending, Placement},
    neighbours::Samples,
    policy::{Choice, Fcfs, LongestFirst, PlacementPolicy, Policy, Question, QuestionDevice, QuestionJob},
    rates::{Load, Module},
    reserve::Low,
};
use crate::{
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
const UNIT_LOAD: f64 = 1e6;

/// Costs count up to this, in nanoseconds (about 13 days): no hint can make a device's queue overflow.
const MAX_LOAD: u64 = 1 << 50;

/// What a byte that a node lacks takes to get there, in nanoseconds: gigabit Ethernet, 117 MB of payload a second. It
/// decides between a node that has a scene and one that does not; a faster network makes both ready sooner.
pub(super) const FETCH_NS_PER_BYTE: f64 = 1e9 / 117e6;

impl CoordinatorMachine {
    pub(super) fn plan_requested(&mut self, now: Instant, id: AppId, request: PlanRequest) {
        let Some(app) = self.apps.get_mut(&id) else { return };
        if let Some(reason) = app.breaker.reason(now) {
            let reason = reason.to_owned();
            return self.tell_app(id, CoordinatorToApp::Stopped { reason });
        }
        if request.jobs.len() > MAX_REQUEST_JOBS || app.jobs.len() + request.jobs.len() > MAX_APP_JOBS {
            let reason = format!(
                "a request holds at most {MAX_REQUEST_JOBS} jobs, an application at most {MAX_APP_JOBS} undelivered ones"
            );
            self.expel_app(id, reason);
            return;
        }
        if let Some(batch) = app.batches.get(&request.batch).filter(|batch| batch.task != request.task) {
            let reason = format!("{} is of {}, not of {}", request.batch, batch.task, request.task);
            self.expel_app(id, reason);
            return;
        }
        // Asked again: whoever waits is told again.
        let mut keys = self.withdraw_pending(id, request.batch);
        let Some(app) = self.apps.get_mut(&id) else { return };
        let module = self.modules.named(request.module);
        let intake = take_in(app, &request, module);
        keys.extend(self.keep_held(now, id, request.batch, intake.fresh, &request.held));
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
        self.serve_lines(now);
        // Jobs that lost their place came before anything that is new.
        for ((app, batch), keys) in std::mem::take(&mut self.lost).into_iter().rev() {
            self.fresh.push_front(Pending { app, batch, answers: None, keys });
        }
        while let Some(mut pending) = self.fresh.pop_front() {
            if pending.answers.is_none() || !self.waits_in_line(&mut pending) {
                self.place_batch(now, pending);
            }
        }
    }

    /// Something changed that may give waiting jobs a device.
    pub(super) fn retry_stuck(&mut self) {
        while let Some(pending) = self.stuck.pop_back() {
            self.fresh.push_front(pending);
        }
        self.projects.relieve_all();
        self.any_runs_dry();
    }

    pub(super) fn forget_pending(&mut self, gone: impl Fn(&Pending) -> bool) {
        self.fresh.retain(|pending| !gone(pending));
        self.stuck.retain(|pending| !gone(pending));
        self.projects.lines_mut().for_each(|line| line.retain(|pending| !gone(pending)));
        self.reserved.retain(|_, pending| !gone(pending));
        self.questions.retain(|_, asked| !gone(&asked.pending));
    }

    /// Takes the jobs of a task out of line.
    pub(super) fn forget_waiting(&mut self, id: AppId, task: TaskId) {
        for queue in [&mut self.fresh, &mut self.stuck].into_iter().chain(self.projects.lines_mut()) {
            for pending in queue.iter_mut().filter(|pending| pending.app == id) {
                pending.keys.retain(|key| key.task != task);
            }
            queue.retain(|pending| !pending.keys.is_empty());
        }
        self.reserved.retain(|_, pending| {
            pending.keys.retain(|key| pending.app != id || key.task != task);
            !pending.keys.is_empty()
        });
        self.questions.retain(|_, asked| (asked.pending.app, asked.task) != (id, task));
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
            self.tell_app(id, CoordinatorToApp::Plan(Plan { batch: None, speculative: false, nodes }));
        }
    }

    pub(super) fn place_batch(&mut self, now: Instant, pending: Pending) {
        let estimates = self.learn(&pending);
        let Some((pending, mut question)) = self.question(now, pending) else { return };
        let Some(app) = self.apps.get(&pending.app) else { return };
        let choices = match &app.policy {
            Policy::Fcfs => Fcfs.place(&question),
            Policy::History => {
                self.estimate(&pending, &mut question, None);
                LongestFirst.place(&question)
            }
            Policy::Neighbours => {
                self.estimate(&pending, &mut question, estimates.as_ref());
                // What lost its place does not wait for a part.
                if pending.answers.is_some() {
                    return self.place_part(now, &pending, question, estimates.is_some());
                }
                Fcfs.place(&question)
            }
            Policy::Plugin(name) if self.is_trusted(now, name) => {
                let name = name.clone();
                return self.ask(now, name, pending, question);
            }
            Policy::Plugin(_) => Fcfs.place(&question),
        };
        self.enter(now, &pending, &question, &choices);
    }

    /// Places a batch without asking its application's plug-in.
    pub(super) fn place_first_come(&mut self, now: Instant, pending: Pending) {
        if let Some((pending, question)) = self.question(now, pending) {
            let choices = Fcfs.place(&question);
            self.enter(now, &pending, &question, &choices);
        }
    }

    /// What is to be decided for a batch. `None` if nothing is: its jobs are gone, or wait in `stuck` or for their project.
    fn question(&mut self, now: Instant, mut pending: Pending) -> Option<(Pending, Question)> {
        if !self.has_room(&mut pending) {
            return None;
        }
        let app = self.apps.get(&pending.app)?;
        let batch = app.batches.get(&pending.batch)?;
        let jobs = wanted(app, &pending);
        if jobs.is_empty() {
            return None;
        }
        // While its application does not hear of it a job could not be sent: it would only fill up a device's queue.
        let devices =
            if app.link.is_some() && !app.deaf { self.candidates(now, app, batch) } else { Vec::new() };
        if devices.is_empty() {
            pending.keys =
                jobs.into_iter().map(|job| JobKey { task: batch.task, index: job.index }).collect();
            self.say_waiting(pending.app, pending.batch, self.why_stuck());
            self.stuck.push_back(pending);
            return None;
        }
        let question = Question { app: pending.app, task: batch.task, jobs, devices };
        let question = self.within_quota(&mut pending, question)?;
        Some((pending, question))
    }

    /// Gives the jobs of a batch their places, and tells the application.
    pub(super) fn enter(&mut self, now: Instant, pending: &Pending, question: &Question, choices: &[Choice]) {
        let shares = self.issue_attempts(now, pending, question, choices);
        self.count_contents(pending);
        let nodes = self.enter_plan(now, pending, shares);
        if pending.answers.is_none() {
            self.replanned_jobs += choices.len() as u64;
        }
        self.tell_app(
            pending.app,
            CoordinatorToApp::Plan(Plan { batch: pending.answers, speculative: false, nodes }),
        );
    }

    /// Devices that may take jobs of a batch, by node and index.
    fn candidates(&self, now: Instant, app: &App, batch: &Batch) -> Vec<QuestionDevice> {
        let mut candidates = Vec::new();
        for (&id, node) in self.nodes.iter().filter(|(_, node)| node.takes_work()) {
            if !app.can_reach(now, id) {
                continue;
            }
            let ready_at_ns = node.missing_bytes(&batch.contents) as f64 * FETCH_NS_PER_BYTE;
            for (index, device) in (0_u16..).zip(&node.devices) {
                if device.lost || !batch.needs.fulfilled_by(&device.info) {
                    continue;
                }
                candidates.push(QuestionDevice {
                    node: id,
                    device: DeviceIndex(index),
                    free_at_ns: device.free_at_ns(now, &self.modules),
                    time_per_load: 1.0 / device.throughput.rate(&self.modules, batch.module),
                    ready_at_ns,
                });
            }
        }
        candidates
    }

    /// A fresh attempt for each job, grouped by device in the order of the choices.
    fn issue_attempts(
        &mut self,
        now: Instant,
        pending: &Pending,
        question: &Question,
        choices: &[Choice],
    ) -> Vec<Share> {
        let share = |device: &QuestionDevice| Share {
            node: device.node,
            device: device.device,
            jobs: Vec::new(),
            loads: Vec::new(),
        };
        let mut shares: Vec<Share> = question.devices.iter().map(share).collect();
        let Some(app) = self.apps.get_mut(&pending.app) else { return shares };
        let Some(batch) = app.batches.get_mut(&pending.batch) else { return shares };
        // Of a quota it is told once: the jobs of a batch go out one by one there.
        batch.told = batch.told.filter(|told| *told == WaitReason::OverQuota);
        for choice in choices {
            let wanted = &question.jobs[choice.job as usize];
            let key = JobKey { task: question.task, index: wanted.index };
            let Some(job) = app.jobs.get_mut(&key) else { continue };
            let share = &mut shares[choice.device as usize];
            let attempt = Attempt { epoch: self.config.epoch, sequence: self.next_attempt };
            self.next_attempt += 1;
            let load = load_of(batch.module, wanted);
            batch.placed_jobs += 1;
            share.jobs.push(JobAttempt { job: key.in_app(pending.app), attempt });
            share.loads.push(load);
            self.projects.occupies(pending.app, (share.node, share.device));
            job.state = JobState::Placed(Placement {
                node: share.node,
                device: share.device,
                attempt,
                planned_at: now,
                stolen_from: None,
                load,
                retracting: None,
            });
            app.waiting_jobs -= 1;
        }
        shares
    }

    /// Books the chosen places on their nodes, and groups them for the application.
    fn enter_plan(&mut self, now: Instant, pending: &Pending, shares: Vec<Share>) -> Vec<NodePlan> {
        let mut plans: Vec<NodePlan> = Vec::new();
        let batch = self.apps.get(&pending.app).and_then(|app| app.batches.get(&pending.batch));
        let contents = batch.map_or(&[][..], |batch| &batch.contents);
        for share in shares.into_iter().filter(|share| !share.jobs.is_empty()) {
            let Some(node) = self.nodes.get_mut(&share.node) else { continue };
            node.jobs.extend(share.jobs.iter().map(|job| job.job));
            node.joining = false;
            if let Some(device) = node.device_mut(share.device) {
                share.loads.iter().for_each(|&load| device.add_load(now, load));
            }
            let id = share.node;
            let share = DevicePlan { device: share.device, jobs: share.jobs };
            match plans.last_mut() {
                Some(plan) if plan.node == id => plan.devices.push(share),
                Some(_) | None => {
                    node.will_hold(contents);
                    plans.push(NodePlan {
                        node: id,
                        session: node.session,
                        contact: node.contact.clone(),
                        devices: vec![share],
                    });
                }
            }
        }
        plans
    }

    pub(super) fn node_plan(
        &self,
        id: NodeId,
        devices: BTreeMap<DeviceIndex, Vec<JobAttempt>>,
    ) -> Option<NodePlan> {
        let node = self.nodes.get(&id)?;
        let devices = devices.into_iter().map(|(device, jobs)| DevicePlan { device, jobs }).collect();
        Some(NodePlan { node: id, session: node.session, contact: node.contact.clone(), devices })
    }

    /// Why jobs without any device for them wait.
    fn why_stuck(&self) -> WaitReason {
        // One that leaves is as good as gone.
        let stays = |node: &Node| node.state != NodeState::Draining;
        match self.nodes.values().any(stays) {
            true => WaitReason::NoFittingDevice,
            false => WaitReason::NoNode,
        }
    }

    pub(super) fn say_waiting(&mut self, id: AppId, batch: BatchId, reason: WaitReason) {
        let Some(app) = self.apps.get_mut(&id).filter(|app| app.link.is_some() && !app.deaf) else {
            return;
        };
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
        for queue in [&mut self.fresh, &mut self.stuck].into_iter().chain(self.projects.lines_mut()) {
            queue.retain_mut(|pending| {
                let asked = pending.app == id && pending.batch == batch;
                if asked {
                    keys.append(&mut pending.keys);
                }
                !asked
            });
        }
        self.questions.retain(|_, asked| {
            let again = asked.pending.app == id && asked.pending.batch == batch;
            if again {
                keys.append(&mut asked.pending.keys);
            }
            !again
        });
        keys.extend(self.reserved.remove(&(id, batch)).into_iter().flat_map(|pending| pending.keys));
        let Some(app) = self.apps.get_mut(&id) else { return Vec::new() };
        if let Some(waiting) = app.batches.get_mut(&batch) {
            waiting.told = None;
        }
        keys.retain(|key| app.waiting_job(*key, batch).is_some());
        keys
    }
}

/// What a device got.
struct Share {
    node: NodeId,
    device: DeviceIndex,
    jobs: Vec<JobAttempt>,
    loads: Vec<Load>,
}

/// What a plan request consists of, seen from what is known.
#[derive(Default)]
struct Intake {
    fresh: Vec<JobKey>,
    failed: Vec<JobKey>,
}

/// Enters the jobs of a request that are new; a repeated request (after a reconnect) changes nothing.
fn take_in(app: &mut App, request: &PlanRequest, module: Module) -> Intake {
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
                    starved: 0,
                    starved_since: None,
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
        let new = || Batch {
            task: request.task,
            needs: request.needs,
            module,
            contents: request.contents.clone(),
            open_jobs: 0,
            counted: false,
            told: None,
            placed_jobs: 0,
            samples: Samples::default(),
            low: Low::default(),
        };
        app.batches.entry(request.batch).or_insert_with(new).open_jobs += added;
    }
    intake
}

/// What a job adds to the queue of its device.
pub(super) fn load_of(module: Module, job: &QuestionJob) -> Load {
    Load { module, amount: load_amount(job.load) }
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a float cast saturates")]
pub(super) const fn load_amount(load: f64) -> u64 {
    let amount = load as u64;
    if amount > MAX_LOAD {
        MAX_LOAD
    } else if amount == 0 {
        1
    } else {
        amount
    }
}

/// What an application told of a job's cost, by itself; see [`wanted`] for what it counts as in a batch.
pub(super) fn told_load(cost: CostNs) -> f64 {
    if cost == CostNs(0) { UNIT_LOAD } else { cost.0.min(MAX_LOAD) as f64 }
}

/// The jobs of a batch in line that still wait, with their loads: a job of unknown cost counts as much as the mean of
/// the known ones.
pub(super) fn wanted(app: &App, pending: &Pending) -> Vec<QuestionJob> {
    let mut jobs = Vec::with_capacity(pending.keys.len());
    let mut known = 0_u32;
    let mut sum = 0.0;
    for &key in &pending.keys {
        let Some(job) = app.waiting_job(key, pending.batch) else { continue };
        let load = job.cost.0.min(MAX_LOAD) as f64;
        if job.cost != CostNs(0) {
            known += 1;
            sum += load;
        }
        jobs.push(QuestionJob { index: key.index, load, avoid: job.avoid });
    }
    let unknown = if known > 0 { sum / f64::from(known) } else { UNIT_LOAD };
    for job in jobs.iter_mut().filter(|job| job.load == 0.0) {
        job.load = unknown;
    }
    jobs
}
