//! The runs that listen: which tasks are whose, what arrived for them, and how long their jobs wait for a device.
//! It never touches a job.

use std::{
    collections::BTreeMap,
    ops::{Range, RangeInclusive},
    sync::mpsc,
    time::Duration,
};

use farm_core::{
    id::{BatchId, JobId, TaskId},
    message::{Plan, PlanRequest, WaitReason},
};
use tokio::time::Instant;

use crate::{
    error::FarmError,
    run::{Arrival, RunEnd, RunEvent},
};

pub(super) struct Runs {
    /// By the first task's id.
    runs: BTreeMap<u32, Listener>,
    patience: Duration,
    /// Which jobs were asked for together, first and last index: a plan that comes unasked names jobs, not batches.
    batches: BTreeMap<BatchId, (TaskId, RangeInclusive<u32>)>,
    waits: BTreeMap<BatchId, Waiting>,
    out_of_reach: Option<OutOfReach>,
    stopped: bool,
}

struct Listener {
    tasks: Range<u32>,
    events: mpsc::Sender<RunEvent>,
    /// Arrived in this turn.
    arrivals: Vec<Arrival>,
}

struct Waiting {
    task: TaskId,
    reason: WaitReason,
    since: Instant,
}

/// What the application's own project has in use it will have done with: that is no reason to give up.
const fn tires(reason: WaitReason) -> bool {
    match reason {
        WaitReason::NoNode | WaitReason::NoFittingDevice => true,
        WaitReason::OverQuota => false,
    }
}

/// Nodes were named, and none lets us in.
struct OutOfReach {
    since: Instant,
    /// Of the node that was tried last.
    reason: String,
}

impl Runs {
    pub(super) const fn new(patience: Duration) -> Self {
        Self {
            runs: BTreeMap::new(),
            patience,
            batches: BTreeMap::new(),
            waits: BTreeMap::new(),
            out_of_reach: None,
            stopped: false,
        }
    }

    /// Takes a run in; `refused` says why it cannot go on.
    pub(super) fn start(
        &mut self,
        tasks: Range<u32>,
        events: mpsc::Sender<RunEvent>,
        refused: Option<RunEnd>,
    ) {
        let listener = Listener { tasks, events, arrivals: Vec::new() };
        match refused {
            Some(end) => listener.tell(RunEvent::Ended(end)),
            None if self.stopped => listener.tell(RunEvent::Ended(RunEnd::Stopped)),
            None => {}
        }
        self.runs.insert(listener.tasks.start, listener);
    }

    pub(super) fn over(&mut self, tasks: &Range<u32>) {
        self.runs.remove(&tasks.start);
        self.batches.retain(|_, (task, _)| !tasks.contains(&task.0));
        self.waits.retain(|_, wait| !tasks.contains(&wait.task.0));
        if self.runs.is_empty() {
            self.out_of_reach = None;
        }
    }

    /// A node was tried in vain, and no other one lets us in.
    pub(super) fn not_reached(&mut self, reason: String, now: Instant) {
        if !self.runs.is_empty() {
            self.out_of_reach.get_or_insert(OutOfReach { since: now, reason: String::new() }).reason = reason;
        }
    }

    /// A node has let us in.
    pub(super) fn reached(&mut self) {
        self.out_of_reach = None;
    }

    /// Whether no node lets us in.
    pub(super) const fn is_out_of_reach(&self) -> bool {
        self.out_of_reach.is_some()
    }

    pub(super) fn is_running(&self, task: TaskId) -> bool {
        self.runs.range(..=task.0).next_back().is_some_and(|(_, run)| run.tasks.contains(&task.0))
    }

    /// Keeps what arrived for the job's run until [`Self::flush`]; a run that is over does not want it.
    pub(super) fn arrived(&mut self, job: JobId, arrival: Arrival) {
        let run = self.runs.range_mut(..=job.task.0).next_back().map(|(_, run)| run);
        if let Some(run) = run.filter(|run| run.tasks.contains(&job.task.0)) {
            run.arrivals.push(arrival);
        }
    }

    /// Hands over what arrived, each run's in one piece.
    pub(super) fn flush(&mut self) {
        for run in self.runs.values_mut() {
            run.flush();
        }
    }

    /// Jobs of one submission are asked for; a batch's jobs have ascending indices, those between belong to no other batch.
    pub(super) fn asked(&mut self, request: &PlanRequest) {
        if let (Some(first), Some(last)) = (request.jobs.first(), request.jobs.last()) {
            // What is asked again after a reconnect is a part of what was asked first.
            let indices = first.index.0..=last.index.0;
            self.batches.entry(request.batch).or_insert((request.task, indices));
        }
    }

    /// A batch waits for a device.
    pub(super) fn waits(&mut self, batch: BatchId, task: TaskId, reason: WaitReason, now: Instant) {
        let wait = self.waits.entry(batch).or_insert(Waiting { task, reason, since: now });
        if tires(wait.reason) != tires(reason) {
            // Only what tires counts for patience.
            wait.since = now;
        }
        wait.reason = reason;
    }

    /// The batches of the planned jobs wait no longer.
    pub(super) fn planned(&mut self, plan: &Plan) {
        if self.waits.is_empty() {
            return;
        }
        let planned = || plan.nodes.iter().flat_map(|node| &node.devices).flat_map(|device| &device.jobs);
        self.waits.retain(|batch, _| {
            let known = self.batches.get(batch);
            let names = |(task, indices): &(TaskId, RangeInclusive<u32>)| {
                planned().any(|job| job.job.task == *task && indices.contains(&job.job.index.0))
            };
            plan.batch != Some(*batch) && !known.is_some_and(names)
        });
    }

    /// Why jobs wait, if some do.
    pub(super) fn waiting(&self) -> Option<WaitReason> {
        self.waits.values().next().map(|wait| wait.reason)
    }

    pub(super) fn next_wake(&self) -> Option<Instant> {
        let waits = self.waits.values().filter(|wait| tires(wait.reason)).map(|wait| wait.since);
        let since = waits.chain(self.out_of_reach.as_ref().map(|out| out.since));
        since.filter_map(|since| since.checked_add(self.patience)).min()
    }

    /// Ends the runs whose patience is at its end.
    pub(super) fn act_on_timers(&mut self, now: Instant) {
        let patience = self.patience;
        let mut tired = Vec::new();
        self.waits.retain(|_, wait| {
            let waited = now.saturating_duration_since(wait.since);
            let waits_on = waited < patience || !tires(wait.reason);
            if !waits_on {
                tired.push((wait.task, wait.reason, waited));
            }
            waits_on
        });
        for (task, reason, waited) in tired {
            let run = self.runs.range_mut(..=task.0).next_back().map(|(_, run)| run);
            if let Some(run) = run.filter(|run| run.tasks.contains(&task.0)) {
                run.end(RunEnd::NoFittingDevice { task, reason, waited });
            }
        }
        let waited = |out: &OutOfReach| now.saturating_duration_since(out.since);
        if let Some(out) = self.out_of_reach.take_if(|out| waited(out) >= patience) {
            let (waited, reason) = (waited(&out), out.reason);
            self.end_all(|| RunEnd::Farm(FarmError::NoNodeReached { waited, reason: reason.clone() }));
        }
    }

    /// Ends every run, now and later.
    pub(super) fn stop(&mut self) {
        self.stopped = true;
        self.end_all(|| RunEnd::Stopped);
    }

    pub(super) fn end_all(&mut self, end: impl Fn() -> RunEnd) {
        for run in self.runs.values_mut() {
            run.end(end());
        }
    }
}

impl Listener {
    fn tell(&self, event: RunEvent) {
        // A run that has ended says so with `RunOver`; until that is heard, what it would get is dropped here.
        let _ = self.events.send(event);
    }

    fn flush(&mut self) {
        if !self.arrivals.is_empty() {
            let arrivals = std::mem::take(&mut self.arrivals);
            self.tell(RunEvent::Arrivals(arrivals));
        }
    }

    /// What arrived comes before the end.
    fn end(&mut self, end: RunEnd) {
        self.flush();
        self.tell(RunEvent::Ended(end));
    }
}

impl Drop for Listener {
    /// An owner task that ends without a word (a panic, a runtime shut down) must not leave a run waiting.
    fn drop(&mut self) {
        self.end(RunEnd::Farm(FarmError::Closed));
    }
}

#[cfg(test)]
mod tests {
    use farm_core::{
        device::Requirements,
        id::{AppId, Attempt, DeviceIndex, Epoch, JobAttempt, JobIndex, NodeId, NodeSession},
        message::{Contact, CostNs, DevicePlan, JobFailure, NodePlan, PlanJob},
    };

    use super::*;

    fn failed(task: u32) -> (JobId, Arrival) {
        let job = JobId { app: AppId(1), task: TaskId(task), index: JobIndex(0) };
        (job, Arrival::Failed { job, failure: JobFailure::Timeout })
    }

    #[test]
    fn arrivals_go_to_their_run_before_its_end() {
        let mut runs = Runs::new(Duration::from_secs(60));
        let (first, first_events) = mpsc::channel();
        let (second, second_events) = mpsc::channel();
        runs.start(0..2, first, None);
        runs.start(2..3, second, None);
        assert!(runs.is_running(TaskId(1)) && runs.is_running(TaskId(2)) && !runs.is_running(TaskId(3)));
        for task in [2, 0, 1, 3] {
            let (job, arrival) = failed(task);
            runs.arrived(job, arrival);
        }
        runs.stop();
        assert!(matches!(first_events.try_recv(), Ok(RunEvent::Arrivals(arrivals)) if arrivals.len() == 2));
        assert!(matches!(first_events.try_recv(), Ok(RunEvent::Ended(RunEnd::Stopped))));
        assert!(matches!(second_events.try_recv(), Ok(RunEvent::Arrivals(arrivals)) if arrivals.len() == 1));
        let (late, late_events) = mpsc::channel();
        runs.start(3..4, late, None);
        assert!(
            matches!(late_events.try_recv(), Ok(RunEvent::Ended(RunEnd::Stopped))),
            "stopped stays stopped"
        );
    }

    #[test]
    fn patience_ends_only_what_still_waits() {
        let mut runs = Runs::new(Duration::from_secs(60));
        let (sender, events) = mpsc::channel();
        runs.start(0..2, sender, None);
        let start = Instant::now();
        assert_eq!(runs.next_wake(), None);
        runs.waits(BatchId(1), TaskId(0), WaitReason::NoNode, start);
        runs.waits(BatchId(2), TaskId(1), WaitReason::NoNode, start);
        runs.waits(BatchId(2), TaskId(1), WaitReason::NoFittingDevice, start + Duration::from_secs(30));
        runs.planned(&Plan { batch: Some(BatchId(1)), speculative: false, nodes: Vec::new() });
        assert_eq!(runs.waiting(), Some(WaitReason::NoFittingDevice));
        assert_eq!(
            runs.next_wake(),
            Some(start + Duration::from_secs(60)),
            "the wait began with the first word of it"
        );
        runs.act_on_timers(start + Duration::from_secs(59));
        assert!(events.try_recv().is_err());
        runs.act_on_timers(start + Duration::from_secs(60));
        let Ok(RunEvent::Ended(RunEnd::NoFittingDevice { task, reason, .. })) = events.try_recv() else {
            panic!("the run must end")
        };
        assert_eq!((task, reason), (TaskId(1), WaitReason::NoFittingDevice));
        assert_eq!(runs.waiting(), None);
        drop(runs);
        assert!(matches!(events.try_recv(), Ok(RunEvent::Ended(RunEnd::Farm(FarmError::Closed)))));
    }

    /// The review of 2026-11-29: a suspended project must not use up the patience for nodes.
    #[test]
    fn waiting_for_the_own_project_costs_no_patience() {
        let mut runs = Runs::new(Duration::from_secs(60));
        let (sender, events) = mpsc::channel();
        runs.start(0..1, sender, None);
        let start = Instant::now();
        let hour = Duration::from_secs(3_600);
        runs.waits(BatchId(1), TaskId(0), WaitReason::OverQuota, start);
        runs.act_on_timers(start + hour);
        runs.waits(BatchId(1), TaskId(0), WaitReason::NoNode, start + hour);
        runs.act_on_timers(start + hour + Duration::from_secs(59));
        assert!(events.try_recv().is_err(), "nodes may be away for a minute");
        runs.act_on_timers(start + hour + Duration::from_secs(60));
        assert!(matches!(events.try_recv(), Ok(RunEvent::Ended(RunEnd::NoFittingDevice { .. }))));
    }

    #[test]
    fn patience_ends_runs_that_no_node_lets_in() {
        let mut runs = Runs::new(Duration::from_secs(60));
        let (sender, events) = mpsc::channel();
        let start = Instant::now();
        runs.not_reached("nobody runs".to_owned(), start);
        assert!(!runs.is_out_of_reach(), "without a run nobody waits");
        runs.start(0..1, sender, None);
        runs.not_reached("first".to_owned(), start);
        runs.reached();
        assert_eq!(runs.next_wake(), None);
        let again = start + Duration::from_secs(5);
        runs.not_reached("second".to_owned(), again);
        runs.not_reached("third".to_owned(), start + Duration::from_secs(50));
        assert_eq!(runs.next_wake(), Some(again + Duration::from_secs(60)));
        runs.act_on_timers(again + Duration::from_secs(59));
        assert!(events.try_recv().is_err());
        runs.act_on_timers(again + Duration::from_secs(60));
        let Ok(RunEvent::Ended(RunEnd::Farm(FarmError::NoNodeReached { reason, .. }))) = events.try_recv()
        else {
            panic!("the run must end")
        };
        assert_eq!(reason, "third", "what was tried last");
        assert!(!runs.is_out_of_reach());
    }

    /// After a node is lost the coordinator plans on its own: such a plan answers no request.
    #[test]
    fn an_unasked_plan_ends_the_wait_of_its_jobs_alone() {
        let mut runs = Runs::new(Duration::from_secs(60));
        for (batch, indices) in [(1, 0..10), (2, 10..20)] {
            let jobs = indices.map(|index| PlanJob { index: JobIndex(index), cost: CostNs(0) }).collect();
            let (needs, contents) = (Requirements::ANY, Vec::new());
            runs.asked(&PlanRequest {
                batch: BatchId(batch),
                task: TaskId(0),
                jobs,
                needs,
                module: None,
                contents,
                held: Vec::new(),
            });
            runs.waits(BatchId(batch), TaskId(0), WaitReason::NoNode, Instant::now());
        }
        let unasked = |task, index| {
            let job = JobId { app: AppId(1), task: TaskId(task), index: JobIndex(index) };
            let job = JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence: 9 } };
            let devices = vec![DevicePlan { device: DeviceIndex(0), jobs: vec![job] }];
            let contact = Contact { addresses: Vec::new(), certificate_der: Vec::new() };
            let node = NodePlan { node: NodeId(1), session: NodeSession(1), contact, devices };
            Plan { batch: None, speculative: false, nodes: vec![node] }
        };
        runs.planned(&unasked(1, 3));
        assert_eq!(runs.waits.len(), 2, "another task's plan says nothing");
        runs.planned(&unasked(0, 10));
        assert_eq!(runs.waits.keys().copied().collect::<Vec<_>>(), [BatchId(1)]);
        runs.over(&(0..1));
        assert!(runs.waits.is_empty() && runs.batches.is_empty());
    }
}
