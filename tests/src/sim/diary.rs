//! What happened when, for whoever measures a run: executions, deliveries, plans, registrations. It judges nothing; that is
//! the auditor's.

use std::{collections::BTreeMap, time::Duration};

use farm_core::{
    id::{AppId, DeviceIndex, JobAttempt, JobId},
    message::Plan,
    time::Instant,
};

use super::auditor::worker_at;

/// An attempt on a device.
#[derive(Clone, Copy, Debug)]
pub struct Run {
    /// Which attempt.
    pub job: JobAttempt,
    /// On whose device.
    pub worker: usize,
    /// Which device.
    pub device: DeviceIndex,
    /// When it began.
    pub began: Instant,
    /// When it was off the device, for whatever reason.
    pub ended: Option<Instant>,
}

impl Run {
    /// How long it was on its device between two moments.
    #[must_use]
    pub fn between(&self, from: Instant, to: Instant) -> Duration {
        self.ended.unwrap_or(to).min(to).since(self.began.max(from))
    }
}

/// A job ends for its application.
#[derive(Clone, Copy, Debug)]
pub struct Ended {
    /// When.
    pub at: Instant,
    /// Which job.
    pub job: JobId,
}

/// A place for an attempt, as an application is told of it; again after each reconnect.
#[derive(Clone, Copy, Debug)]
pub struct Planned {
    /// When the plan leaves the coordinator.
    pub at: Instant,
    /// Which attempt.
    pub job: JobAttempt,
    /// Where.
    pub worker: usize,
}

/// A result arrives at an application.
#[derive(Clone, Copy, Debug)]
pub struct Arrived {
    /// When.
    pub at: Instant,
    /// Whose result.
    pub job: JobAttempt,
    /// Whether another attempt of the job had been planned by then.
    pub superseded: bool,
}

/// What happened so far, in order.
#[derive(Debug, Default)]
pub struct Diary {
    /// Executions.
    pub runs: Vec<Run>,
    /// Deliveries and failures.
    pub endings: Vec<Ended>,
    /// Places.
    pub plans: Vec<Planned>,
    /// Results that arrive.
    pub results: Vec<Arrived>,
    /// When the coordinator welcomed which worker.
    pub registrations: Vec<(Instant, usize)>,
    /// Results that counted.
    pub delivered: Vec<JobAttempt>,
    /// Runs that are not over, by attempt.
    open: BTreeMap<JobAttempt, usize>,
    /// What each job's application was told last, second attempts aside.
    newest: BTreeMap<JobId, JobAttempt>,
}

impl Diary {
    pub(super) fn begins(&mut self, began: Instant, worker: usize, device: DeviceIndex, job: JobAttempt) {
        self.open.insert(job, self.runs.len());
        self.runs.push(Run { job, worker, device, began, ended: None });
    }

    pub(super) fn is_off(&mut self, now: Instant, job: JobAttempt) {
        if let Some(run) = self.open.remove(&job) {
            self.runs[run].ended = Some(now);
        }
    }

    /// Everything on these devices is gone: of one device, or of all of a worker.
    pub(super) fn cut_off(&mut self, now: Instant, worker: usize, device: Option<DeviceIndex>) {
        let runs = &mut self.runs;
        self.open.retain(|_, run| {
            let run = &mut runs[*run];
            let gone = run.worker == worker && device.is_none_or(|device| run.device == device);
            if gone {
                run.ended = Some(now);
            }
            !gone
        });
    }

    pub(super) fn ends(&mut self, at: Instant, job: JobId) {
        self.endings.push(Ended { at, job });
    }

    pub(super) fn counts(&mut self, job: JobAttempt) {
        self.delivered.push(job);
    }

    pub(super) fn planned(&mut self, at: Instant, plan: &Plan) {
        for node in &plan.nodes {
            let worker = worker_at(&node.contact.addresses[0]);
            for &job in node.devices.iter().flat_map(|device| &device.jobs) {
                self.plans.push(Planned { at, job, worker });
            }
        }
    }

    /// An application takes a plan in.
    pub(super) fn told(&mut self, plan: &Plan) {
        if plan.speculative {
            return;
        }
        for &job in plan.nodes.iter().flat_map(|node| &node.devices).flat_map(|device| &device.jobs) {
            self.newest.insert(job.job, job);
        }
    }

    pub(super) fn arrives(&mut self, at: Instant, job: JobAttempt) {
        let superseded = self.newest.get(&job.job).is_some_and(|newest| newest.attempt > job.attempt);
        self.results.push(Arrived { at, job, superseded });
    }

    pub(super) fn registers(&mut self, at: Instant, worker: usize) {
        self.registrations.push((at, worker));
    }

    /// Executions beyond the first of each job.
    #[must_use]
    pub fn executed_again(&self) -> usize {
        // Taken back in the instant in which it began: its machine could not know yet.
        let counts = |run: &&Run| run.ended != Some(run.began);
        let mut jobs: Vec<JobId> = self.runs.iter().filter(counts).map(|run| run.job.job).collect();
        let runs = jobs.len();
        jobs.sort_unstable();
        jobs.dedup();
        runs - jobs.len()
    }

    /// Device time between two moments of the runs that `count`.
    pub fn busy(&self, from: Instant, to: Instant, count: impl Fn(&Run) -> bool) -> Duration {
        self.runs.iter().filter(|run| count(run)).map(|run| run.between(from, to)).sum()
    }

    /// Device time between two moments of an application's runs.
    #[must_use]
    pub fn busy_for(&self, app: AppId, from: Instant, to: Instant) -> Duration {
        self.busy(from, to, |run| run.job.job.app == app)
    }
}
