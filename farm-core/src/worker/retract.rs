//! Jobs that another node takes over: the victim's side of a steal between nodes (10-scheduling.md section 3).
//!
//! This node alone says what may leave it. It never learns where a job goes.

use super::{
    WorkerMachine,
    job::{HeldState, Phase},
};
use crate::{
    id::{JobAttempt, StealId},
    message::NodeToCoordinator,
};

/// What a retract order finds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Found {
    /// Held, and not begun.
    Waiting,
    /// On its device, or executed.
    Begun,
    /// Its ticket is still on the way.
    NotYet,
    /// Over here, or replaced by a later attempt.
    Over,
}

impl WorkerMachine {
    pub(super) fn retract(&mut self, steal: StealId, jobs: &[JobAttempt]) {
        let (mut retracted, mut running, mut unknown) = (Vec::new(), Vec::new(), Vec::new());
        for &job in jobs {
            match self.find(job) {
                // The tombstone stops a ticket that is slower than this order.
                Found::Waiting | Found::NotYet => {
                    self.cancel(job);
                    retracted.push(job);
                }
                Found::Begun => running.push(job),
                Found::Over => unknown.push(job),
            }
        }
        self.tell_coordinator(NodeToCoordinator::Retracted { steal, retracted, running, unknown });
    }

    /// Whether a job is here and its device has not had it yet, as far as is known.
    pub(super) fn waits_here(&self, job: JobAttempt) -> bool {
        self.find(job) == Found::Waiting
    }

    fn find(&self, job: JobAttempt) -> Found {
        match self.jobs.get(&job.job) {
            Some(held) if held.attempt == job.attempt => match held.state {
                HeldState::Fetching { .. } | HeldState::Queued => Found::Waiting,
                // The first one runs or is about to; one behind it is only staged, or goes on later.
                HeldState::HandedOver(handed) => {
                    let device = self.devices.get(usize::from(held.device.0));
                    let first = device.and_then(|device| device.handed_over.front());
                    let begun = first == Some(&job.job) || handed.phase != Phase::Staged;
                    if begun { Found::Begun } else { Found::Waiting }
                }
                HeldState::Executed(_) => Found::Begun,
            },
            Some(held) if held.attempt > job.attempt => Found::Over,
            Some(_) | None if self.tombstones.cover(job.job, job.attempt) => Found::Over,
            Some(_) | None => Found::NotYet,
        }
    }
}
