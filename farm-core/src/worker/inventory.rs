//! What is here, as it is told: to the coordinator with each hello, and in short now and then; to an application that would have it
//! otherwise (20-delivery.md, "Who owns the truth").

use super::{Effect, WorkerMachine, job::HeldState, session::Session};
use crate::{
    holding::Holding,
    id::{AppId, JobAttempt, JobId, LinkId},
    message::{NodeToApp, NodeToCoordinator},
    time::Instant,
};

impl WorkerMachine {
    /// Every attempt that is here, executed but undelivered ones too.
    pub(super) fn inventory(&self) -> Vec<JobAttempt> {
        self.jobs.iter().map(|(&job, held)| JobAttempt { job, attempt: held.attempt }).collect()
    }

    /// Those of one application.
    pub(super) fn inventory_of(&self, app: AppId) -> Vec<JobAttempt> {
        let held = self.jobs.range(JobId::range_of(app));
        held.map(|(&job, held)| JobAttempt { job, attempt: held.attempt }).collect()
    }

    /// Tells the coordinator in short what is here, if it is time.
    pub(super) fn tell_holding(&mut self, now: Instant) {
        let Session::Registered(pulse) = &self.session else { return };
        if self.compare_at > now {
            return;
        }
        self.compare_at = now.after(pulse.liveness().compare_every());
        let holding = self.inventory().into_iter().collect();
        self.tell_coordinator(NodeToCoordinator::Holding(holding));
    }

    /// An application says in short what should be here.
    pub(super) fn compare(&mut self, link: LinkId, app: AppId, theirs: Holding) {
        let held = self.inventory_of(app);
        if held.iter().copied().collect::<Holding>() != theirs {
            self.push(Effect::ToApp { link, message: NodeToApp::Inventory(held) });
        }
    }

    /// An application wants nothing more of an attempt. If it was executed the application has its result, or that of another.
    pub(super) fn cancelled_by_app(&mut self, now: Instant, job: JobAttempt) {
        let held = self.jobs.get(&job.job).filter(|held| held.attempt == job.attempt);
        if held.is_some_and(|held| matches!(held.state, HeldState::Executed(_))) {
            self.reports.delivered(now, job);
        }
        self.cancel(job);
    }
}
