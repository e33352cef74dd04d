//! The ledger's talk with the coordinator: registration, resumption, heartbeats, plan requests. It never touches a
//! node's link.

use std::collections::BTreeSet;

use super::{Effect, Ledger};
use crate::{
    id::{AppId, AppIncarnation, BatchId, JobId, JobKey},
    message::{AppHello, AppToCoordinator, CoordinatorToApp, HeldJob, Liveness, PlanJob, PlanRequest},
    program::Content,
    pulse::{Answers, Pulse},
    time::Instant,
};

/// Most open jobs asked for at once, in jobs; further batches wait here, in the application's own memory. A quarter of
/// what the coordinator holds for one application before it refuses it.
const MAX_REQUESTED_JOBS: u64 = 262_144;

/// Most contents named in one plan request: they are a hint for placement, not a promise.
const MAX_REQUEST_CONTENTS: usize = 64;

/// Most jobs in one `AlreadyDelivered`.
const MAX_ALREADY_DELIVERED: usize = 4_096;

/// How the ledger stands with the coordinator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Session {
    /// No connection.
    Offline,
    /// Hello said, no welcome yet.
    Greeting,
    /// Welcome.
    Registered(Pulse),
    /// The coordinator wants nothing of us.
    Refused,
    /// Goodbye said.
    Finished,
}

impl Session {
    /// The timer of this state.
    pub(super) fn next_heartbeat(self) -> Option<Instant> {
        match self {
            Self::Registered(pulse) => Some(pulse.due()),
            Self::Offline | Self::Greeting | Self::Refused | Self::Finished => None,
        }
    }
}

/// Who the coordinator says we are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Identity {
    pub(super) app: AppId,
    pub(super) incarnation: AppIncarnation,
}

impl Ledger {
    pub(super) fn coordinator_connected(&mut self) {
        match self.session {
            Session::Offline | Session::Greeting | Session::Registered(_) => {}
            Session::Refused | Session::Finished => return,
        }
        self.session = Session::Greeting;
        let resume = self.identity.map(|identity| (identity.app, identity.incarnation));
        let hello = AppHello { resume, ..self.hello.clone() };
        self.tell_coordinator(AppToCoordinator::Hello(hello));
    }

    pub(super) fn coordinator_lost(&mut self) {
        match self.session {
            Session::Offline | Session::Greeting | Session::Registered(_) => self.session = Session::Offline,
            Session::Refused | Session::Finished => {}
        }
        // Results keep coming over the data links; what the coordinator missed is said again after the welcome.
        self.already_delivered.clear();
    }

    pub(super) fn coordinator_said(&mut self, now: Instant, message: CoordinatorToApp) {
        match message {
            CoordinatorToApp::Welcome { app, incarnation, epoch: _, liveness } => {
                self.welcomed(now, Identity { app, incarnation }, liveness);
            }
            CoordinatorToApp::Refused { reason } => {
                self.session = Session::Refused;
                self.push(Effect::Refused { reason });
            }
            CoordinatorToApp::Plan(plan) => self.planned(now, plan),
            CoordinatorToApp::Waiting { batch, reason } => {
                if let Some(waiting) = self.batches.get(&batch) {
                    let task = waiting.task;
                    self.push(Effect::Waiting { batch, task, reason });
                }
            }
            CoordinatorToApp::JobFailed { job, failure } => self.given_up(job, failure),
            CoordinatorToApp::Stopped { reason } => self.stopped(&reason),
            CoordinatorToApp::HeartbeatAck { sequence: _ } => {
                if let Session::Registered(pulse) = &mut self.session {
                    pulse.answered(now);
                }
            }
            CoordinatorToApp::Capability(_) => {}
        }
    }

    pub(super) fn session_timeout(&mut self, now: Instant) {
        let Session::Registered(pulse) = &mut self.session else { return };
        let Some(answers) = pulse.beat(now) else { return };
        self.heartbeat_sequence += 1;
        let (sequence, unanswered) = (self.heartbeat_sequence, answers == Answers::Missing);
        self.tell_coordinator(AppToCoordinator::Heartbeat { sequence, unanswered });
    }

    /// Puts what is to be said to the coordinator into messages.
    pub(super) fn flush_session(&mut self) {
        if !matches!(self.session, Session::Registered(_)) {
            return;
        }
        // First: what they hold makes room for what is asked for next.
        for app in std::mem::take(&mut self.predecessors) {
            self.tell_coordinator(AppToCoordinator::Supersede(app));
        }
        while !self.already_delivered.is_empty() {
            let rest =
                self.already_delivered.split_off(self.already_delivered.len().min(MAX_ALREADY_DELIVERED));
            let jobs = std::mem::replace(&mut self.already_delivered, rest);
            self.tell_coordinator(AppToCoordinator::AlreadyDelivered(jobs));
        }
        while self.requested_jobs < MAX_REQUESTED_JOBS {
            let Some(batch) = self.to_request.pop_front() else { break };
            self.request(batch);
        }
    }

    pub(super) fn finished(&mut self) {
        // Acknowledgements first: a worker that gets them keeps no result of ours.
        self.flush_session();
        self.flush_nodes();
        if matches!(self.session, Session::Registered(_) | Session::Greeting) {
            self.tell_coordinator(AppToCoordinator::Goodbye);
        }
        self.session = Session::Finished;
        self.close_all_nodes();
        self.drop_open_jobs();
        self.to_request.clear();
        self.predecessors.clear();
        self.already_delivered.clear();
        self.requested_jobs = 0;
    }

    fn welcomed(&mut self, now: Instant, identity: Identity, liveness: Liveness) {
        if self.session != Session::Greeting {
            return;
        }
        self.session = Session::Registered(Pulse::new(now, liveness));
        self.compare_every = liveness.compare_every();
        let before = self.identity.replace(identity);
        if before.is_some_and(|before| before.app != identity.app) {
            // Attempts of another application id can never be answered: nodes hold them under the old id.
            self.unplace_all();
        }
        // Whatever was asked before may have got lost, or the coordinator may be another one: ask for every open job
        // (again). What it knows stays as it is; attempts stay valid until larger ones come, so no result is lost.
        self.to_request = self.batches.keys().copied().collect();
        self.requested_jobs = 0;
        for batch in self.batches.values_mut() {
            batch.requested = false;
        }
        self.say_unreachable_again();
    }

    fn request(&mut self, id: BatchId) {
        let Some(batch) = self.batches.get_mut(&id) else { return };
        if !batch.requested {
            batch.requested = true;
            self.requested_jobs += u64::from(batch.open_jobs);
        }
        let mut jobs = Vec::with_capacity(batch.indices.len());
        let mut held = Vec::new();
        let mut contents: BTreeSet<Content> = BTreeSet::new();
        for &index in &batch.indices {
            let Some(job) = self.jobs.get(&JobKey { task: batch.task, index }) else { continue };
            jobs.push(PlanJob { index, cost: job.cost });
            held.extend(job.place.map(|place| HeldJob {
                index,
                session: place.life.session,
                device: place.device,
                attempt: place.attempt,
            }));
            if contents.len() < MAX_REQUEST_CONTENTS {
                contents.extend(&job.contents);
            }
        }
        if jobs.is_empty() {
            return;
        }
        let contents = contents.into_iter().take(MAX_REQUEST_CONTENTS).collect();
        let (task, needs, module) = (batch.task, batch.needs, batch.module);
        let request = PlanRequest { batch: id, task, jobs, needs, module, contents, held };
        self.tell_coordinator(AppToCoordinator::Plan(request));
    }

    /// Tells the coordinator that a job it planned is over.
    pub(super) fn say_already_delivered(&mut self, job: JobId) {
        self.already_delivered.push(job);
    }
}
