//! The ledger's jobs: which are open, which attempt of each counts, which are over. It never says where a job goes.

use super::{Effect, Ledger, SubmittedJob, nodes::NodeLife};
use crate::{
    device::Requirements,
    id::{AppId, Attempt, BatchId, ContentHash, DeviceIndex, JobAttempt, JobId, JobIndex, JobKey, TaskId},
    message::{CostNs, JobFailure, LatencyClass, Plan, Priority, ResultHeader},
    program::Content,
    time::Instant,
};

/// Most jobs in one plan request; a larger submission becomes several.
pub(super) const MAX_BATCH_JOBS: usize = 4_096;

/// Which attempt of a job counts, and where it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Placement {
    pub(super) attempt: Attempt,
    pub(super) life: NodeLife,
    pub(super) device: DeviceIndex,
}

/// An open job.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) cost: CostNs,
    pub(super) class: LatencyClass,
    pub(super) priority: Priority,
    pub(super) contents: Vec<Content>,
    pub(super) batch: BatchId,
    /// `None` until the first plan.
    pub(super) place: Option<Placement>,
    /// A second attempt of a placed job beside the first: whichever result comes first counts.
    pub(super) backup: Option<Placement>,
}

impl Job {
    /// The attempts that may deliver.
    pub(super) fn placements(&self) -> impl Iterator<Item = Placement> + use<> {
        self.place.into_iter().chain(self.backup)
    }
}

/// What the jobs of one plan request share.
#[derive(Debug)]
pub(super) struct Batch {
    pub(super) task: TaskId,
    pub(super) needs: Requirements,
    pub(super) module: Option<ContentHash>,
    /// All of its jobs, in order of submission.
    pub(super) indices: Vec<JobIndex>,
    /// Jobs not over.
    pub(super) open_jobs: u32,
    /// Open jobs without a plan.
    pub(super) waiting_jobs: u32,
    /// The coordinator of this session has been asked.
    pub(super) requested: bool,
}

impl Ledger {
    pub(super) fn submitted(&mut self, task: TaskId, jobs: Vec<SubmittedJob>, needs: Requirements) {
        let mut indices = Vec::with_capacity(jobs.len().min(MAX_BATCH_JOBS));
        let mut batch_module = None;
        for job in jobs {
            let key = JobKey { task, index: job.index };
            if self.jobs.contains_key(&key) || self.over.contains(&key) {
                tracing::warn!(%task, job = %job.index, "submitted twice, the first one counts");
                continue;
            }
            let SubmittedJob { index, cost, class, priority, contents, module } = job;
            // A batch is of one module: its jobs are estimated by one rate of each device.
            if indices.len() == MAX_BATCH_JOBS || module != batch_module {
                self.add_batch(task, needs, batch_module, std::mem::take(&mut indices));
                batch_module = module;
            }
            let batch = BatchId(self.next_batch);
            self.jobs.insert(key, Job { cost, class, priority, contents, batch, place: None, backup: None });
            self.counts.waiting_jobs += 1;
            indices.push(index);
        }
        self.add_batch(task, needs, batch_module, indices);
    }

    pub(super) fn planned(&mut self, now: Instant, plan: Plan) {
        let Some(app) = self.app() else { return };
        for node_plan in plan.nodes {
            let life = NodeLife { node: node_plan.node, session: node_plan.session };
            let mut attempts = Vec::new();
            for device_plan in node_plan.devices {
                let device = device_plan.device;
                for job in device_plan.jobs.into_iter().filter(|job| job.job.app == app) {
                    let placement = Placement { attempt: job.attempt, life, device };
                    let key = JobKey::of(job.job);
                    let entered = match plan.speculative {
                        true => self.place_backup(key, placement),
                        false => self.place(key, placement),
                    };
                    attempts.extend(entered);
                }
            }
            if !attempts.is_empty() {
                self.send_attempts(now, life, node_plan.contact, attempts);
            }
        }
    }

    /// A result's way: the current attempt from the planned node is delivered, what came too late is acknowledged (so that the
    /// node frees it) and dropped, and an attempt that the plan gave to another node is refused.
    pub(super) fn result(&mut self, life: NodeLife, header: ResultHeader) {
        if self.waits_to_be_kept(&header) {
            self.push(Effect::DropPayload { job: header.job, digest: header.digest });
            return;
        }
        let ResultHeader { job, device: _, device_time_ns, outcome, digest } = header;
        let key = JobKey::of(job.job);
        let placements: Vec<Placement> = match self.jobs.get(&key) {
            Some(known) if self.app() == Some(job.job.app) => known.placements().collect(),
            Some(_) | None => Vec::new(),
        };
        let is_attempt = |place: &&Placement| place.attempt == job.attempt;
        if let Some(planned) = placements.iter().find(is_attempt).filter(|place| place.life != life) {
            // Never an honest node's: attempts are sent to the node of their plan alone.
            tracing::warn!(%job, node = %life.node, planned = %planned.life.node, "a result of a node that the plan does not name");
            self.push(Effect::DropPayload { job, digest });
            return;
        }
        let is_this = |place: &Placement| place.attempt == job.attempt && place.life == life;
        let counts = placements.iter().any(is_this);
        if counts && outcome.is_ok() {
            self.acknowledge_delivered(life, job, digest);
        } else {
            self.acknowledge(life, job, digest);
        }
        if !counts {
            self.push(Effect::DropPayload { job, digest });
            return;
        }
        match outcome {
            Ok(sections) => {
                self.stop(job.job, placements.into_iter().filter(|place| !is_this(place)));
                self.close(key);
                self.counts.delivered_jobs += 1;
                self.push(Effect::Deliver { job, sections, device_time_ns, node: life.node });
                self.push(Effect::ForgetProgram(job.job));
            }
            // The coordinator knows of it and will plan a further attempt.
            Err(failure) if failure.can_be_retried() => self.push(Effect::DropPayload { job, digest }),
            Err(failure) => {
                self.push(Effect::DropPayload { job, digest });
                self.stop(job.job, placements.into_iter().filter(|place| !is_this(place)));
                self.fail(key, job.job, failure);
            }
        }
    }

    /// The coordinator gave a job up.
    pub(super) fn given_up(&mut self, job: JobId, failure: JobFailure) {
        let key = JobKey::of(job);
        if self.app() == Some(job.app) && self.jobs.contains_key(&key) {
            self.fail(key, job, failure);
        }
    }

    pub(super) fn cancelled(&mut self, task: TaskId) {
        self.keep_no_longer(task);
        let keys: Vec<JobKey> = self.jobs.range(JobKey::range_of(task)).map(|(&key, _)| key).collect();
        if keys.is_empty() {
            return;
        }
        self.fail_all(keys, &JobFailure::Cancelled);
        self.cancel_at_coordinator(task);
    }

    /// The coordinator gave every job up.
    pub(super) fn stopped(&mut self, reason: &str) {
        let keys: Vec<JobKey> = self.jobs.keys().copied().collect();
        self.fail_all(keys, &JobFailure::PoisonApplication(reason.to_owned()));
    }

    /// Forgets every placement: the attempts can never be answered.
    pub(super) fn unplace_all(&mut self) {
        self.unkept.clear();
        let keys: Vec<JobKey> =
            self.jobs.iter().filter(|(_, job)| job.place.is_some()).map(|(&key, _)| key).collect();
        for key in keys {
            let Some(job) = self.jobs.get_mut(&key) else { continue };
            let Some(place) = job.place.take() else { continue };
            if let Some(batch) = self.batches.get_mut(&job.batch) {
                batch.waiting_jobs += 1;
            }
            self.counts.outstanding_jobs -= 1;
            self.counts.waiting_jobs += 1;
            let backup = job.backup.take();
            self.leaves_node(place);
            backup.into_iter().for_each(|backup| self.leaves_node(backup));
        }
    }

    pub(super) fn drop_open_jobs(&mut self) {
        self.journalled.clear();
        self.unkept.clear();
        self.jobs.clear();
        self.batches.clear();
        self.counts.waiting_jobs = 0;
        self.counts.outstanding_jobs = 0;
    }

    fn add_batch(
        &mut self,
        task: TaskId,
        needs: Requirements,
        module: Option<ContentHash>,
        indices: Vec<JobIndex>,
    ) {
        if indices.is_empty() {
            return;
        }
        let id = BatchId(self.next_batch);
        self.next_batch += 1;
        let open_jobs = u32::try_from(indices.len()).expect("a batch holds at most MAX_BATCH_JOBS");
        let batch =
            Batch { task, needs, module, indices, open_jobs, waiting_jobs: open_jobs, requested: false };
        self.batches.insert(id, batch);
        self.to_request.push_back(id);
    }

    /// Takes a planned attempt in. Returns it if it must be sent.
    fn place(&mut self, key: JobKey, placement: Placement) -> Option<Attempt> {
        let app = self.app()?;
        let Some(job) = self.jobs.get_mut(&key) else {
            // Over, or never ours: in both cases the coordinator may forget it.
            self.say_already_delivered(key.in_app(app));
            return None;
        };
        match job.place {
            // The other attempt ended badly; this one goes on alone.
            Some(current) if job.backup == Some(placement) => {
                job.place = job.backup.take();
                self.leaves_node(current);
                return None;
            }
            Some(current) if current.attempt > placement.attempt => return None,
            // The same plan again (the coordinator repeats what it holds after a reconnect).
            Some(current) if current == placement => return None,
            Some(current) => {
                job.place = Some(placement);
                if current.attempt < placement.attempt {
                    self.counts.replanned_jobs += 1;
                }
                let backup = job.backup.take();
                self.leaves_node(current);
                backup.into_iter().for_each(|backup| self.leaves_node(backup));
            }
            None => {
                job.place = Some(placement);
                if let Some(batch) = self.batches.get_mut(&job.batch) {
                    batch.waiting_jobs -= 1;
                }
                self.counts.waiting_jobs -= 1;
                self.counts.outstanding_jobs += 1;
            }
        }
        Some(placement.attempt).inspect(|&attempt| self.enters_node(placement.life, attempt, key))
    }

    /// Takes an attempt in that runs beside the one there is. Returns it if it must be sent.
    fn place_backup(&mut self, key: JobKey, placement: Placement) -> Option<Attempt> {
        let Some(job) = self.jobs.get_mut(&key) else { return self.place(key, placement) };
        let Some(place) = job.place else { return self.place(key, placement) };
        let newest = job.backup.map_or(place.attempt, |backup| backup.attempt.max(place.attempt));
        if placement.attempt <= newest {
            return None;
        }
        let before = job.backup.replace(placement);
        before.into_iter().for_each(|before| self.leaves_node(before));
        self.enters_node(placement.life, placement.attempt, key);
        Some(placement.attempt)
    }

    /// Tells nodes that attempts of a job are of no use any more.
    fn stop(&mut self, job: JobId, placements: impl Iterator<Item = Placement>) {
        for place in placements {
            self.cancel_on_node(place.life, JobAttempt { job, attempt: place.attempt });
        }
    }

    /// Open jobs fail, wherever they are.
    fn fail_all(&mut self, keys: Vec<JobKey>, failure: &JobFailure) {
        // Before the first registration there is no application id yet; the driver keys programs by task and index.
        let app = self.app().unwrap_or(AppId(0));
        for key in keys {
            if let Some(placements) = self.jobs.get(&key).map(Job::placements) {
                self.stop(key.in_app(app), placements);
            }
            self.fail(key, key.in_app(app), failure.clone());
        }
    }

    fn fail(&mut self, key: JobKey, job: JobId, failure: JobFailure) {
        self.close(key);
        self.counts.failed_jobs += 1;
        self.push(Effect::Fail { job, failure });
        self.push(Effect::ForgetProgram(job));
    }

    /// An open job is over: exactly one `Deliver` or `Fail` goes with each call.
    fn close(&mut self, key: JobKey) {
        let job = self.jobs.remove(&key).expect("only open jobs are closed");
        assert!(self.over.insert(key), "I2: job {key} ended twice");
        if let Some(batch) = self.batches.get_mut(&job.batch) {
            batch.open_jobs -= 1;
            if batch.requested {
                self.requested_jobs -= 1;
            }
            if job.place.is_none() {
                batch.waiting_jobs -= 1;
            }
            if batch.open_jobs == 0 {
                self.batches.remove(&job.batch);
            }
        }
        match job.place {
            Some(place) => {
                self.counts.outstanding_jobs -= 1;
                self.leaves_node(place);
            }
            None => self.counts.waiting_jobs -= 1,
        }
        job.backup.into_iter().for_each(|backup| self.leaves_node(backup));
    }
}
