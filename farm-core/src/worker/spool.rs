//! Results from execution to acknowledgement: sent on the application's current link, kept while there is none, sent
//! again on the next one. Bytes are the driver's; the number of results is bounded by `max_jobs`, their size by each
//! application's quota and what is on the devices when it is reached.

use super::{
    Effect, WorkerMachine,
    job::{HeldState, Spooled},
};
use crate::{
    id::{AppId, JobAttempt, JobId, LinkId},
    message::{NodeToApp, ResultAck},
    time::Instant,
};

/// Most times that a result is sent again because it was acknowledged with another digest; then the payload here must
/// be the broken one, and the job is given back.
const MAX_MISMATCHES: u32 = 3;

impl WorkerMachine {
    /// An attempt ended with something for its application.
    pub(super) fn spool(&mut self, job: JobAttempt, spooled: Spooled) {
        let Some(held) = self.jobs.get_mut(&job.job) else { return };
        let size_bytes = spooled.size_bytes;
        held.state = HeldState::Executed(spooled);
        let contents = std::mem::take(&mut held.contents);
        let device = held.device;
        self.leave_executor(device, job.job);
        self.release_contents(job, &contents);
        self.spool_changed(job.job.app, |bytes| bytes + size_bytes);
        self.send_result(job.job);
    }

    /// Sends a job's result, if there is a link to send it on.
    pub(super) fn send_result(&mut self, job: JobId) {
        let Some(HeldState::Executed(spooled)) = self.jobs.get(&job).map(|held| &held.state) else { return };
        let Some(link) = self.apps.get(&job.app).and_then(|app| app.link) else { return };
        let message = NodeToApp::Result(spooled.header.clone());
        self.push(Effect::ToApp { link, message });
    }

    pub(super) fn acknowledged(&mut self, now: Instant, ack: ResultAck) {
        let Some(held) = self.jobs.get_mut(&ack.job.job).filter(|held| held.attempt == ack.job.attempt)
        else {
            return;
        };
        let HeldState::Executed(spooled) = &mut held.state else { return };
        if spooled.header.digest == ack.digest {
            self.remove(ack.job);
            self.push(Effect::Discard(ack.job));
            self.reports.delivered(now, ack.job);
            return;
        }
        spooled.mismatches += 1;
        if spooled.mismatches > MAX_MISMATCHES {
            self.give_back(now, ack.job);
            return;
        }
        self.send_result(ack.job.job);
    }

    /// What an application may leave unacknowledged before it gets no further job, in bytes.
    pub(super) const fn spool_quota_bytes(&self) -> u64 {
        if self.spool_full { 1 } else { self.config.spool_quota_bytes }
    }

    /// The driver has no room for further results, or has again.
    pub(super) fn spool_filled(&mut self, full: bool) {
        self.spool_full = full;
        let apps: Vec<AppId> = self.apps.keys().copied().collect();
        apps.into_iter().for_each(|app| self.settle_share(app));
    }

    /// A result cannot be sent any more: it is made again elsewhere.
    pub(super) fn result_lost(&mut self, now: Instant, job: JobAttempt) {
        let held = self.jobs.get(&job.job).filter(|held| held.attempt == job.attempt);
        if held.is_some_and(|held| matches!(held.state, HeldState::Executed(_))) {
            self.give_back(now, job);
        }
    }

    /// Sends everything unacknowledged on a new link.
    pub(super) fn resend_results(&mut self, app: AppId, link: LinkId) {
        for held in self.jobs.range(JobId::range_of(app)).map(|(_, held)| held) {
            if let HeldState::Executed(spooled) = &held.state {
                let message = NodeToApp::Result(spooled.header.clone());
                self.effects.push_back(Effect::ToApp { link, message });
            }
        }
    }
}
