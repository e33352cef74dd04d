//! Judges the whole farm by what is said and done in it: the global invariants of the design (20-delivery.md) that one
//! machine alone cannot check.
//!
//! It believes no machine's books: it counts plans, executions and endings itself. It never changes anything.

use std::collections::{BTreeMap, BTreeSet};

use farm_core::{
    coordinator::{Event, ProjectStatus},
    id::{AppId, Attempt, JobAttempt, JobId, NodeId},
    message::{CoordinatorToApp, JobFailure, NodeToCoordinator, Plan},
    time::Instant,
    worker::WorkerMachine,
};

use super::{
    hosts::Ending,
    network::{Message, Proc},
    world::World,
};

/// Most steals of one job (I9).
const MAX_STEALS: u32 = 3;

/// Most lag of a backlogged application, in largest charges (I7).
const MAX_LAG: f64 = 5.0;

/// And where interactive jobs interrupt others, which are charged when they end: 5.25 at most in 6,000 seeds.
const INTERRUPTED_LAG: f64 = 1.0;

/// Open jobs for which the machines check their own books after every event; with more of them they do after every so
/// many events more, so that the work per event stays the same.
const JOBS_PER_CHECK: usize = 32;

/// Fewest crashes in a row for which an application is stopped.
const STOPPING_CRASHES: u32 = 8;

/// Checks that something was there to be judged: a run in which an invariant was never looked at proves nothing of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Checks {
    /// Plans whose attempts were compared with earlier ones (I4).
    pub plans: u64,
    /// Executions counted against what went wrong (I5).
    pub executions: u64,
    /// Idle devices that were held against queued work (I6).
    pub idle_devices: u64,
    /// Lags of backlogged applications (I7).
    pub lags: u64,
    /// Steals (I9).
    pub steals: u64,
    /// Second attempts beside running ones (I5).
    pub speculations: u64,
    /// Jobs looked for in all three tiers at once (I1).
    pub whereabouts: u64,
    /// Rounds of the machines' own checks (I1, I2, I8).
    pub books: u64,
    /// Batch jobs that made way for interactive ones.
    pub yields: u64,
    /// Contents that a node took from another one.
    pub peer_fetches: u64,
    /// Batches that a plug-in had answered for.
    pub plugin_answers: u64,
    /// Projects with as much as they may have, held against their quotas (I8).
    pub full_projects: u64,
}

impl Checks {
    /// Those of two runs together.
    #[must_use]
    pub const fn plus(self, other: Self) -> Self {
        Self {
            plans: self.plans + other.plans,
            executions: self.executions + other.executions,
            idle_devices: self.idle_devices + other.idle_devices,
            lags: self.lags + other.lags,
            steals: self.steals + other.steals,
            speculations: self.speculations + other.speculations,
            whereabouts: self.whereabouts + other.whereabouts,
            books: self.books + other.books,
            yields: self.yields + other.yields,
            peer_fetches: self.peer_fetches + other.peer_fetches,
            plugin_answers: self.plugin_answers + other.plugin_answers,
            full_projects: self.full_projects + other.full_projects,
        }
    }
}

/// What is known of one job.
#[derive(Debug, Default)]
struct Record {
    executions: u32,
    /// Executions that ended with a failure that is the job's own.
    crashes: u32,
    /// Workers that it was planned on.
    workers: Vec<usize>,
    /// The last attempt, and the node it was planned on.
    newest: Option<(Attempt, NodeId)>,
    /// Attempts beside another one.
    speculations: u32,
    /// Steals under one registration of its application with one coordinator.
    steals: u32,
    /// Nodes that it was stolen from since it last started.
    left: Vec<NodeId>,
}

impl Record {
    fn worked_on(&mut self, worker: usize) {
        if !self.workers.contains(&worker) {
            self.workers.push(worker);
        }
    }
}

/// An answer to a retract order.
#[derive(Debug)]
pub(super) struct StealAnswer {
    given_up: BTreeSet<JobId>,
}

/// Jobs that a coordinator is moving while it handles one event.
#[derive(Debug, Default)]
struct Moving {
    /// What their victim gave up.
    jobs: BTreeSet<JobId>,
    /// How many of them are still to be planned elsewhere.
    left: u64,
}

/// The auditor of one run.
#[derive(Debug, Default)]
pub struct Auditor {
    jobs: BTreeMap<JobId, Record>,
    over: usize,
    /// Which application each id was given to.
    names: BTreeMap<AppId, usize>,
    /// Executions of each application's jobs that ended so.
    crashes: BTreeMap<AppId, u32>,
    /// What went wrong, by whom it can have cost an execution: a process, or an application and a worker.
    disturbances: BTreeMap<(Proc, Proc), u32>,
    last_disturbance: Option<Instant>,
    moving: Moving,
    /// Workers whose applications have all been backlogged since a moment when their lags were small.
    fair: BTreeSet<usize>,
    thorough: bool,
    settled: usize,
    /// Of the coordinator that speaks.
    epoch: u32,
    /// Devices and planned jobs that each project had when a quota was changed, or fewer since.
    had: BTreeMap<String, (u64, u64)>,
    /// What was there to be judged.
    pub checks: Checks,
}

impl Auditor {
    /// Another coordinator speaks.
    pub(super) fn coordinator_began(&mut self, epoch: u32) {
        self.epoch = epoch;
    }

    /// A quota may be less now than what a project has.
    pub(super) fn quotas_changed(&mut self, projects: &[ProjectStatus]) {
        let has = |project: &ProjectStatus| (project.devices, project.queued_jobs);
        self.had = projects.iter().map(|project| (project.project.clone(), has(project))).collect();
    }

    /// I8: what a project has is within its quota, or goes down.
    pub(super) fn projects_have(&mut self, projects: &[ProjectStatus]) {
        for ProjectStatus { project, quota, devices, queued_jobs, .. } in projects {
            let had = self.had.entry(project.clone()).or_default();
            let quotas = (quota.devices.map_or(u64::MAX, u64::from), quota.queued_jobs.unwrap_or(u64::MAX));
            assert!(*devices <= quotas.0.max(had.0), "I8: {project} is on {devices} devices: {quota:?}");
            assert!(*queued_jobs <= quotas.1.max(had.1), "I8: {project} has {queued_jobs} jobs: {quota:?}");
            *had = (had.0.min(*devices), had.1.min(*queued_jobs));
            self.checks.full_projects += u64::from(*devices == quotas.0 || *queued_jobs == quotas.1);
        }
    }

    /// Has the machines check their own books after every single event.
    pub fn be_thorough(&mut self) {
        self.thorough = true;
    }

    /// Whether a machine that just settled should check its own books.
    pub(super) fn is_due(&mut self) -> bool {
        self.settled += 1;
        let open = self.jobs.len() - self.over;
        let due = self.thorough || self.settled.is_multiple_of(1 + open / JOBS_PER_CHECK);
        self.checks.books += u64::from(due);
        due
    }

    /// Something goes wrong, until then, between two processes, or with one (then both are the same).
    pub(super) fn disturbed(&mut self, until: Instant, one: Proc, other: Proc) {
        self.last_disturbance = self.last_disturbance.max(Some(until));
        *self.disturbances.entry(blame(one, other)).or_default() += 1;
    }

    pub(super) const fn last_disturbance(&self) -> Option<Instant> {
        self.last_disturbance
    }

    /// An application was told its name.
    pub(super) fn named(&mut self, index: usize, app: AppId) {
        let before = *self.names.entry(app).or_insert(index);
        assert_eq!(before, index, "I11: {app} was given to a second application");
    }

    /// A coordinator forgot what it knew of an application's jobs: how often they were stolen, too.
    pub(super) fn forgotten(&mut self, app: AppId) {
        for record in self.jobs.iter_mut().filter(|(job, _)| job.app == app).map(|(_, record)| record) {
            record.steals = 0;
            record.left.clear();
        }
    }

    /// A plan leaves the coordinator.
    fn planned(&mut self, plan: &Plan) {
        self.checks.plans += 1;
        for node in &plan.nodes {
            let worker = worker_at(&node.contact.addresses[0]);
            for &job in node.devices.iter().flat_map(|device| &device.jobs) {
                if plan.speculative {
                    self.speculated(job, worker);
                } else {
                    self.placed(job, node.node, worker);
                }
            }
        }
    }

    fn placed(&mut self, job: JobAttempt, node: NodeId, worker: usize) {
        let record = self.jobs.entry(job.job).or_default();
        let before = record.newest.replace((job.attempt, node));
        // Not planned but taken over, as node and application say it is: of later attempts, which never left the coordinator
        // before this one, nobody knows, nor of earlier steals.
        let taken_over = job.attempt.epoch.0 < self.epoch;
        if taken_over || before.is_some_and(|(newest, _)| newest.epoch < job.attempt.epoch) {
            record.steals = 0;
            record.left.clear();
        }
        if let Some((newest, _)) = before {
            assert!(taken_over || newest <= job.attempt, "I4: {job} is planned after {newest}");
        }
        record.worked_on(worker);
        if self.moving.left > 0 && self.moving.jobs.remove(&job.job) {
            self.moving.left -= 1;
            self.checks.steals += 1;
            record.steals += 1;
            record.left.extend(before.map(|(_, victim)| victim));
            assert!(record.steals <= MAX_STEALS, "I9: {} was stolen {} times", job.job, record.steals);
            assert!(!record.left.contains(&node), "I9: {} is stolen back to {node}, unstarted", job.job);
        }
    }

    /// A second attempt beside the first: that one stays the one that others are compared with.
    fn speculated(&mut self, job: JobAttempt, worker: usize) {
        self.checks.speculations += 1;
        let record = self.jobs.entry(job.job).or_default();
        let first = record.newest.map(|(attempt, _)| attempt);
        assert!(first.is_some_and(|first| first < job.attempt), "I4: {job} is planned beside {first:?}");
        record.speculations += 1;
        record.worked_on(worker);
    }

    /// The answer to a retract order in an event, if it is one.
    pub(super) fn steal_answer(event: &Event) -> Option<StealAnswer> {
        match event {
            Event::FromNode { message: NodeToCoordinator::Retracted { retracted, .. }, .. } => {
                Some(StealAnswer { given_up: retracted.iter().map(|job| job.job).collect() })
            }
            _ => None,
        }
    }

    /// The coordinator took an answer in and moved this many of its jobs; their plan follows.
    pub(super) fn moved(&mut self, answer: Option<StealAnswer>, moved: u64) {
        let Some(answer) = answer else {
            assert_eq!(moved, 0, "I9: {moved} jobs were stolen without their victim's word");
            self.moving = Moving::default();
            return;
        };
        self.moving = Moving { jobs: answer.given_up, left: moved };
    }

    /// A job begins to run (I5).
    pub(super) fn begins(&mut self, worker: usize, job: JobId) {
        self.checks.executions += 1;
        let record = self.jobs.entry(job).or_default();
        record.executions += 1;
        record.left.clear();
        let (executions, own) = (record.executions, record.crashes + record.speculations);
        if executions == 1 {
            return;
        }
        let most = 1 + own + self.disturbances_of(job) + self.count(Proc::Worker(worker));
        assert!(
            executions <= most,
            "I5: {job} is executed {executions} times, now on worker {worker}, though only {most} are accounted for"
        );
    }

    /// It was taken back in the instant in which it began: its machine could not know yet.
    pub(super) fn did_not_begin(&mut self, job: JobId) {
        if let Some(record) = self.jobs.get_mut(&job) {
            record.executions -= 1;
        }
    }

    /// An execution ended with a failure that is the job's own (I10).
    pub(super) fn crashed(&mut self, job: JobId, max_crashes: u32) {
        let record = self.jobs.entry(job).or_default();
        record.crashes += 1;
        let crashes = record.crashes;
        *self.crashes.entry(job.app).or_default() += 1;
        // Crashes are soft state: a new coordinator, or one that forgot the application, counts anew; a report can get
        // lost with whatever else goes wrong.
        let counts = 1 + self.count(Proc::Coordinator) + self.app_of(job).map_or(0, |app| self.count(app));
        let most = max_crashes.saturating_mul(counts) + self.disturbances_of(job);
        assert!(crashes <= most, "I10: {job} crashed {crashes} executors, {most} are allowed");
    }

    /// A job is over for its application.
    pub(super) fn ends(&mut self, job: JobId, ending: &Ending, max_crashes: u32) {
        if let Some(record) = self.jobs.get_mut(&job) {
            self.over += 1;
            // A plan request repeated meanwhile has the coordinator plan it anew, as a job that was never stolen.
            record.steals = 0;
            record.left.clear();
        }
        if let Ending::Failed(JobFailure::Poison(reason)) = ending {
            let crashes = self.jobs.get(&job).map_or(0, |record| record.crashes);
            // Each loss of a worker it was on can have been held against it, once for its own crash there.
            let suspicions = crashes + self.disturbances_of(job);
            assert!(suspicions >= max_crashes, "I10: {job} is no poison: {reason}");
        }
        if let Ending::Failed(JobFailure::PoisonApplication(reason)) = ending {
            let crashes = self.crashes(job.app);
            assert!(crashes >= STOPPING_CRASHES, "I10: {} is no poison: {reason}", job.app);
        }
    }

    /// How a worker's applications stand with its fair share (I7).
    pub(super) fn shares(&mut self, worker: usize, machine: &WorkerMachine, interactive: bool) {
        let (mut count, mut backlogged, mut worst) = (0_usize, true, 0.0_f64);
        for standing in machine.standings() {
            count += 1;
            backlogged &= standing.backlogged;
            worst = worst.max(standing.lag.abs());
        }
        if count < 2 || !backlogged {
            self.fair.remove(&worker);
        } else if self.fair.contains(&worker) {
            self.checks.lags += 1;
            let most = if interactive { MAX_LAG + INTERRUPTED_LAG } else { MAX_LAG };
            assert!(worst <= most, "I7: worker {worker} owes {worst} of its largest charges");
        } else if worst <= 1.0 {
            self.fair.insert(worker);
        }
    }

    /// Executions of an application's jobs that ended with a failure that is the job's own.
    #[must_use]
    pub fn crashes(&self, app: AppId) -> u32 {
        self.crashes.get(&app).copied().unwrap_or(0)
    }

    /// Executions of each job.
    pub fn executions(&self) -> impl Iterator<Item = (JobId, u32)> {
        self.jobs.iter().map(|(&job, record)| (job, record.executions))
    }

    /// Whether an attempt is its job's last one, and may leave the node it is on: a stolen job may have to stay, and of a
    /// superseded attempt nobody knows.
    pub(super) fn may_move(&self, job: JobAttempt) -> bool {
        self.jobs.get(&job.job).is_some_and(|record| {
            record.steals == 0 && record.newest.is_some_and(|(newest, _)| newest == job.attempt)
        })
    }

    fn app_of(&self, job: JobId) -> Option<Proc> {
        self.names.get(&job.app).map(|&app| Proc::App(app))
    }

    fn count(&self, proc: Proc) -> u32 {
        self.disturbances.get(&(proc, proc)).copied().unwrap_or(0)
    }

    /// How often something went wrong that can have cost a job an execution: with its application, with a worker that it
    /// was planned on, between the two, or with the coordinator.
    fn disturbances_of(&self, job: JobId) -> u32 {
        let Some(app) = self.app_of(job) else { return u32::MAX / 2 };
        let workers = self.jobs.get(&job).map_or(&[][..], |record| &record.workers[..]);
        let of_worker = |worker: &usize| {
            let worker = Proc::Worker(*worker);
            self.count(worker) + self.disturbances.get(&(app, worker)).copied().unwrap_or(0)
        };
        self.count(Proc::Coordinator) + self.count(app) + workers.iter().map(of_worker).sum::<u32>()
    }
}

/// Whom a disturbance between two processes can have cost something: the one that is not the coordinator, or both.
const fn blame(one: Proc, other: Proc) -> (Proc, Proc) {
    match (one, other) {
        (Proc::Coordinator, proc) | (proc, Proc::Coordinator) => (proc, proc),
        (Proc::Worker(worker), Proc::App(app)) | (Proc::App(app), Proc::Worker(worker)) => {
            (Proc::App(app), Proc::Worker(worker))
        }
        (Proc::Worker(_), Proc::Worker(_)) | (Proc::App(_), Proc::App(_)) => (one, one),
    }
}

/// The worker that answers at an address.
pub(super) fn worker_at(address: &str) -> usize {
    address.trim_start_matches("worker-").parse().expect("addresses are ours")
}

impl World {
    /// A message is put on a connection.
    pub(super) fn audit_said(&mut self, message: &Message) {
        if let Message::CoordinatorToApp(CoordinatorToApp::Plan(plan)) = message {
            self.audit.planned(plan);
            self.diary.planned(self.now, plan);
        }
    }
}

#[cfg(test)]
mod tests {
    use farm_core::id::{Epoch, JobIndex, TaskId};

    use super::*;

    const APP: AppId = AppId(1);

    fn job() -> JobId {
        JobId { app: APP, task: TaskId(0), index: JobIndex(0) }
    }

    fn attempt(sequence: u64) -> JobAttempt {
        JobAttempt { job: job(), attempt: Attempt { epoch: Epoch(1), sequence } }
    }

    /// An auditor that saw one job planned on worker 0.
    fn auditor() -> Auditor {
        let mut auditor = Auditor::default();
        auditor.named(0, APP);
        auditor.placed(attempt(5), NodeId(1), 0);
        auditor
    }

    #[test]
    fn an_execution_more_is_accounted_for_by_what_went_wrong() {
        let mut auditor = auditor();
        auditor.begins(0, job());
        auditor.disturbed(Instant::ZERO, Proc::Worker(0), Proc::Coordinator);
        auditor.begins(1, job());
        auditor.crashed(job(), 3);
        auditor.begins(1, job());
    }

    #[test]
    #[should_panic(expected = "I5")]
    fn a_second_execution_without_a_reason_is_seen() {
        let mut auditor = auditor();
        auditor.begins(0, job());
        // Of another worker, which never had the job.
        auditor.disturbed(Instant::ZERO, Proc::Worker(7), Proc::Coordinator);
        auditor.begins(0, job());
    }

    #[test]
    #[should_panic(expected = "I4")]
    fn an_older_attempt_is_seen() {
        auditor().placed(attempt(4), NodeId(1), 0);
    }

    #[test]
    #[should_panic(expected = "I9")]
    fn a_way_back_is_seen() {
        let mut auditor = auditor();
        for (sequence, thief) in [(6, 2), (7, 1)] {
            auditor.moved(Some(StealAnswer { given_up: BTreeSet::from([job()]) }), 1);
            auditor.placed(attempt(sequence), NodeId(thief), 0);
        }
    }

    #[test]
    #[should_panic(expected = "I9")]
    fn a_theft_is_seen() {
        auditor().moved(None, 1);
    }

    #[test]
    #[should_panic(expected = "I10")]
    fn one_crash_too_many_is_seen() {
        let mut auditor = auditor();
        (0..4).for_each(|_| auditor.crashed(job(), 3));
    }

    #[test]
    #[should_panic(expected = "I10")]
    fn an_innocent_job_is_seen() {
        auditor().ends(job(), &Ending::Failed(JobFailure::Poison("?".to_owned())), 3);
    }

    #[test]
    #[should_panic(expected = "I11")]
    fn a_second_owner_of_a_name_is_seen() {
        auditor().named(1, APP);
    }
}
