//! Leaving in good order: nothing new, queued and staged jobs go back, running ones finish, results are acknowledged, goodbye.

use std::time::Duration;

use super::{Effect, WorkerMachine};
use crate::{id::JobAttempt, message::NodeToCoordinator, time::Instant};

/// How long a drained node waits for acknowledgements after its last job ended, in milliseconds. Unacknowledged jobs
/// are planned again by the coordinator at our goodbye.
const ACKNOWLEDGE_MS: u64 = 10_000;

/// How far the worker is with leaving.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Drain {
    /// It stays.
    No,
    /// Jobs run.
    Finishing,
    /// Nothing runs; results wait for acknowledgement until then.
    Delivering(Instant),
    /// Goodbye said; nothing counts any more.
    Gone,
}

impl Drain {
    pub(super) const fn deadline(self) -> Option<Instant> {
        match self {
            Self::Delivering(deadline) => Some(deadline),
            Self::No | Self::Finishing | Self::Gone => None,
        }
    }
}

impl WorkerMachine {
    pub(super) fn start_drain(&mut self, now: Instant) {
        if self.drain != Drain::No {
            return;
        }
        self.drain = Drain::Finishing;
        // What is only staged too: it would double the time that running jobs take.
        let held =
            self.jobs.iter().map(|(&job, held)| (held.arrival, JobAttempt { job, attempt: held.attempt }));
        let mut waiting: Vec<(u64, JobAttempt)> = held.filter(|(_, job)| self.waits_here(*job)).collect();
        waiting.sort_unstable();
        for (_, job) in waiting {
            self.give_back(now, job);
        }
    }

    pub(super) fn advance_drain(&mut self, now: Instant) {
        if self.drain == Drain::Finishing && self.holds_only_results() {
            self.drain = Drain::Delivering(now.after(Duration::from_millis(ACKNOWLEDGE_MS)));
        }
        let Drain::Delivering(deadline) = self.drain else { return };
        if !self.jobs.is_empty() && deadline > now {
            return;
        }
        if self.session.is_registered() {
            self.flush_all_reports(now);
            self.tell_coordinator(NodeToCoordinator::Goodbye);
        }
        self.drain = Drain::Gone;
        self.push(Effect::Exit);
    }
}
