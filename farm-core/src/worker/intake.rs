//! Jobs that arrive, and jobs that leave before they ran: fencing by attempt, duplicates, cancellation, giving back.

use super::{
    Effect, WorkerMachine,
    content::Misnamed,
    drain::Drain,
    job::{HeldJob, HeldState, Spooled},
};
use crate::{
    id::{AppId, DeviceIndex, JobAttempt, JobId, LinkId},
    message::{Executed, JobFailure, JobTicket, JobTrace},
    program::Content,
    time::Instant,
};

/// Most contents of one job; a job that names more is wrong.
const MAX_JOB_CONTENTS: usize = 1_024;

impl WorkerMachine {
    pub(super) fn take_in(&mut self, now: Instant, link: LinkId, ticket: JobTicket) {
        let JobAttempt { job: id, attempt } = ticket.job;
        if self.tombstones.cover(id, attempt) {
            self.push(Effect::Discard(ticket.job));
            return;
        }
        if let Some(held) = self.jobs.get(&id) {
            if held.attempt == attempt {
                // A repetition after a reconnect. The driver's program is the same one.
                return;
            }
            if held.attempt > attempt {
                self.push(Effect::Discard(ticket.job));
                return;
            }
            let older = JobAttempt { job: id, attempt: held.attempt };
            self.drop_job(older);
        }
        let full = self.jobs.len() >= self.config.max_jobs;
        let device = self.standing_device(ticket.device, id.app);
        let device = device.filter(|_| !full && self.drain == Drain::No);
        let Some(device) = device else {
            self.give_back_ticket(now, ticket.job, ticket.device);
            return;
        };
        if ticket.contents.len() > MAX_JOB_CONTENTS {
            let failure = JobFailure::InvalidProgram(format!("more than {MAX_JOB_CONTENTS} contents"));
            self.refuse(now, device, &ticket, failure);
            return;
        }
        match self.misnamed(&ticket.contents) {
            None => self.hold(now, link, device, ticket),
            Some(Misnamed::Certainly(content)) => {
                let Content { hash, size_bytes } = content;
                let reason = format!("content {hash} has not the {size_bytes} B that it is said to have");
                self.refuse(now, device, &ticket, JobFailure::InvalidProgram(reason));
            }
            // Who is right will show when it comes; elsewhere it may be known.
            Some(Misnamed::Perhaps) => self.give_back_ticket(now, ticket.job, ticket.device),
        }
    }

    /// Takes a job out, whatever it is doing, without a word to anybody but the driver.
    pub(super) fn drop_job(&mut self, job: JobAttempt) {
        let Some(held) = self.jobs.get(&job.job).filter(|held| held.attempt == job.attempt) else { return };
        let device = held.device;
        if matches!(held.state, HeldState::HandedOver(_)) {
            self.push(Effect::Abort { job, device });
        }
        self.remove(job);
        self.push(Effect::Discard(job));
    }

    pub(super) fn cancel(&mut self, job: JobAttempt) {
        self.drop_job(job);
        // Also when it is not here (yet): the message that brings it may be slower than the one that cancels it.
        self.tombstones.insert(job.job, job.attempt);
    }

    /// Gives a job back to the coordinator, which will plan it elsewhere.
    pub(super) fn give_back(&mut self, now: Instant, job: JobAttempt) {
        let Some(device) = self.jobs.get(&job.job).map(|held| held.device) else { return };
        self.drop_job(job);
        self.report_failure(now, job, device, JobFailure::Returned);
    }

    pub(super) fn drop_jobs_of(&mut self, app: AppId) {
        self.inventory_of(app).into_iter().for_each(|job| self.drop_job(job));
    }

    pub(super) fn drop_everything(&mut self) {
        self.inventory().into_iter().for_each(|job| self.drop_job(job));
    }

    pub(super) fn report_failure(
        &mut self,
        now: Instant,
        job: JobAttempt,
        device: DeviceIndex,
        failure: JobFailure,
    ) {
        let trace = JobTrace { staged_at: now, started_at: now, ended_at: now, stolen_from: None };
        self.reports
            .executed(now, Executed { job, device, device_time_ns: 0, trace, failure: Some(failure) });
    }

    /// Takes a job off every book. Its state says which books those are.
    pub(super) fn remove(&mut self, job: JobAttempt) -> Option<HeldJob> {
        let held = self.jobs.remove(&job.job)?;
        self.tombstones.insert(job.job, job.attempt);
        let rank = held.rank(job.job);
        match &held.state {
            HeldState::Fetching { .. } => self.device_mut(held.device).waiting_jobs -= 1,
            HeldState::Queued => {
                self.device_mut(held.device).dequeue(rank, held.cost);
                self.became_inactive(job.job.app);
            }
            HeldState::HandedOver(_) => {
                self.leave_executor(held.device, job.job);
            }
            HeldState::Executed(spooled) => {
                let size_bytes = spooled.size_bytes;
                self.spool_changed(job.job.app, |bytes| bytes - size_bytes);
            }
        }
        self.release_contents(job, &held.contents);
        if let Some(app) = self.apps.get_mut(&job.job.app) {
            app.held_jobs -= 1;
        }
        self.forget_if_idle(job.job.app);
        Some(held)
    }

    /// A job that was handed over is with its executor no more.
    pub(super) fn leave_executor(&mut self, device: DeviceIndex, job: JobId) {
        self.device_mut(device).handed_over.retain(|other| *other != job);
        self.lags.unstage(job.app);
        self.became_inactive(job.app);
    }

    pub(super) fn became_active(&mut self, id: AppId) {
        let Some(app) = self.apps.get_mut(&id) else { return };
        app.active_jobs += 1;
        self.settle_share(id);
    }

    pub(super) fn became_inactive(&mut self, id: AppId) {
        let Some(app) = self.apps.get_mut(&id) else { return };
        app.active_jobs -= 1;
        self.settle_share(id);
    }

    /// A job whose contents are all here gets into its device's queue.
    pub(super) fn enqueue(&mut self, id: JobId) {
        let Some(held) = self.jobs.get_mut(&id) else { return };
        held.state = HeldState::Queued;
        let (device, rank, cost) = (held.device, held.rank(id), held.cost);
        let device = self.device_mut(device);
        device.waiting_jobs -= 1;
        device.enqueue(rank, cost);
        self.became_active(id.app);
    }

    fn hold(&mut self, now: Instant, link: LinkId, device: DeviceIndex, ticket: JobTicket) {
        let JobTicket { job, device: _, class, priority, cost, mut contents } = ticket;
        contents.sort_unstable();
        contents.dedup_by_key(|content| content.hash);
        let missing = self.hold_contents(now, link, job, &contents);
        let held = HeldJob {
            attempt: job.attempt,
            device,
            class,
            priority,
            cost,
            contents,
            arrival: self.next_arrival,
            state: HeldState::Fetching { missing },
        };
        self.next_arrival += 1;
        self.jobs.insert(job.job, held);
        self.device_mut(device).waiting_jobs += 1;
        if let Some(app) = self.apps.get_mut(&job.job.app) {
            app.held_jobs += 1;
        }
        if missing == 0 {
            self.enqueue(job.job);
        }
    }

    fn give_back_ticket(&mut self, now: Instant, job: JobAttempt, device: DeviceIndex) {
        self.tombstones.insert(job.job, job.attempt);
        self.push(Effect::Discard(job));
        self.report_failure(now, job, device, JobFailure::Returned);
    }

    /// A job that is wrong by its ticket fails as if it had run: its application is told until it acknowledges.
    fn refuse(&mut self, now: Instant, device: DeviceIndex, ticket: &JobTicket, failure: JobFailure) {
        let JobTicket { job, class, priority, cost, .. } = *ticket;
        let state = HeldState::Executed(Spooled::failed(job, device, 0, failure.clone()));
        let arrival = self.next_arrival;
        self.next_arrival += 1;
        let held = HeldJob {
            attempt: job.attempt,
            device,
            class,
            priority,
            cost,
            contents: Vec::new(),
            arrival,
            state,
        };
        self.jobs.insert(job.job, held);
        if let Some(app) = self.apps.get_mut(&job.job.app) {
            app.held_jobs += 1;
        }
        self.report_failure(now, job, device, failure);
        self.send_result(job.job);
    }
}
