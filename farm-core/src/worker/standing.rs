//! How a node stands, for operators and auditors. It reads, and changes nothing.

use super::{WorkerMachine, job::HeldState};
use crate::id::{AppId, DeviceIndex, JobAttempt};

/// How an application stands with a node's fair share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Standing {
    /// Which.
    pub app: AppId,
    /// What it is owed (if positive), in largest single charges so far.
    pub lag: f64,
    /// It has a job in the queue of every device: only then it is owed its share of all of them.
    pub backlogged: bool,
}

impl WorkerMachine {
    /// The applications with jobs that could be staged, are staged or run, and that take their results.
    pub fn standings(&self) -> impl Iterator<Item = Standing> {
        self.apps.iter().filter(|(_, app)| app.awake).map(|(&app, _)| {
            let mut devices = self.devices.iter().filter(|device| !device.lost);
            let backlogged = devices.all(|device| device.queues().contains_key(&app));
            Standing { app, lag: self.lags.lag(app), backlogged }
        })
    }

    /// Jobs held, executed and unacknowledged ones too.
    #[must_use]
    pub fn held_jobs(&self) -> usize {
        self.jobs.len()
    }

    /// Where an attempt ran whose result waits here for its application.
    #[must_use]
    pub fn executed_on(&self, job: JobAttempt) -> Option<DeviceIndex> {
        let held = self.jobs.get(&job.job).filter(|held| held.attempt == job.attempt)?;
        matches!(held.state, HeldState::Executed(_)).then_some(held.device)
    }

    /// Whether an attempt is here, in whatever state.
    #[must_use]
    pub fn holds(&self, job: JobAttempt) -> bool {
        self.jobs.get(&job.job).is_some_and(|held| held.attempt == job.attempt)
    }
}
