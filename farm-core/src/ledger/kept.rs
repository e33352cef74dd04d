//! Results whose acknowledgement waits until the application has put them where a crash does not reach. It never decides whether
//! a result counts.

use super::{Ledger, nodes::NodeLife};
use crate::{
    id::{ContentHash, JobAttempt, JobKey, TaskId},
    message::ResultHeader,
};

/// A delivered result that its node still keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Unkept {
    life: NodeLife,
    job: JobAttempt,
    digest: ContentHash,
}

impl Ledger {
    /// From now on results of the task are acknowledged when they are kept.
    pub(super) fn journalled(&mut self, task: TaskId) {
        self.journalled.insert(task);
    }

    /// A delivered result is safe: its node may forget it.
    pub(super) fn kept(&mut self, key: JobKey) {
        if let Some(Unkept { life, job, digest }) = self.unkept.remove(&key) {
            self.acknowledge(life, job, digest);
        }
    }

    /// Acknowledges a result that is delivered now, or has that wait.
    pub(super) fn acknowledge_delivered(&mut self, life: NodeLife, job: JobAttempt, digest: ContentHash) {
        let key = JobKey::of(job.job);
        if self.journalled.contains(&key.task) {
            self.unkept.insert(key, Unkept { life, job, digest });
        } else {
            self.acknowledge(life, job, digest);
        }
    }

    /// Whether this is a repetition (on a new link, say) of a result that was delivered and is not kept yet.
    pub(super) fn waits_to_be_kept(&self, header: &ResultHeader) -> bool {
        self.unkept.get(&JobKey::of(header.job.job)).is_some_and(|unkept| unkept.job == header.job)
    }

    /// The task is over: nobody will ask for its results again.
    pub(super) fn keep_no_longer(&mut self, task: TaskId) {
        self.journalled.remove(&task);
        let keys: Vec<JobKey> = self.unkept.range(JobKey::range_of(task)).map(|(&key, _)| key).collect();
        keys.into_iter().for_each(|key| self.kept(key));
    }

    pub(super) fn check_unkept(&self) {
        for key in self.unkept.keys() {
            assert!(self.over.contains(key), "I1: {key} was not delivered and waits to be kept");
            assert!(self.journalled.contains(&key.task), "I8: {key} waits to be kept by nobody");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        device::Requirements,
        id::{AppId, AppIncarnation, Attempt, DeviceIndex, Epoch, JobId, JobIndex, NodeId, NodeSession},
        ledger::{Effect, Event, SubmittedJob},
        message::{
            AppHello, AppToNode, Contact, CoordinatorToApp, CostNs, DevicePlan, LatencyClass, Liveness,
            NodePlan, NodeToApp, PROTOCOL_VERSION, Plan, Priority,
        },
        time::Instant,
    };

    const NODE: NodeId = NodeId(1);
    const SESSION: NodeSession = NodeSession(7);

    fn attempt(index: u32) -> JobAttempt {
        let job = JobId { app: AppId(1), task: TaskId(0), index: JobIndex(index) };
        JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence: u64::from(index) + 1 } }
    }

    /// Everything said to the node as acknowledgement, and how many results were delivered and dropped.
    fn drain(ledger: &mut Ledger) -> (Vec<JobAttempt>, usize, usize) {
        let (mut acks, mut delivered, mut dropped) = (Vec::new(), 0, 0);
        while let Some(effect) = ledger.poll_effect() {
            match effect {
                Effect::ToNode { message: AppToNode::Acks(said), .. } => {
                    acks.extend(said.into_iter().map(|ack| ack.job));
                }
                Effect::Deliver { .. } => delivered += 1,
                Effect::DropPayload { .. } => dropped += 1,
                _ => {}
            }
        }
        ledger.check_invariants();
        (acks, delivered, dropped)
    }

    /// A ledger of two jobs that are on a node; the task is journalled or not.
    fn ledger(journalled: bool) -> Ledger {
        let mut ledger = Ledger::new(AppHello {
            protocol: PROTOCOL_VERSION,
            name: "test".to_owned(),
            weight: 1.0,
            global_stealing: false,
            policy: String::new(),
            resume: None,
        });
        let job = |index| SubmittedJob {
            index: JobIndex(index),
            cost: CostNs(1),
            class: LatencyClass::Batch,
            priority: Priority(0),
            contents: Vec::new(),
            module: None,
        };
        let welcome = CoordinatorToApp::Welcome {
            app: AppId(1),
            incarnation: AppIncarnation(1),
            epoch: Epoch(1),
            liveness: Liveness::default(),
        };
        let devices = vec![DevicePlan { device: DeviceIndex(0), jobs: vec![attempt(0), attempt(1)] }];
        let contact = Contact { addresses: vec!["127.0.0.1:1".to_owned()], certificate_der: Vec::new() };
        let plan = NodePlan { node: NODE, session: SESSION, contact, devices };
        let plan = Plan { batch: None, speculative: false, nodes: vec![plan] };
        let mut events = vec![Event::CoordinatorConnected, Event::FromCoordinator(welcome)];
        events.extend(journalled.then_some(Event::Journalled(TaskId(0))));
        events.extend([
            Event::Submitted { task: TaskId(0), jobs: vec![job(0), job(1)], needs: Requirements::ANY },
            Event::FromCoordinator(CoordinatorToApp::Plan(plan)),
        ]);
        for event in events {
            ledger.handle(Instant::ZERO, event);
            drain(&mut ledger);
        }
        connect(&mut ledger);
        ledger
    }

    fn connect(ledger: &mut Ledger) {
        ledger.handle(Instant::ZERO, Event::NodeConnected { node: NODE, session: SESSION });
        hears(ledger, NodeToApp::Welcome { node: NODE, session: SESSION });
        drain(ledger);
    }

    fn hears(ledger: &mut Ledger, message: NodeToApp) {
        ledger.handle(Instant::ZERO, Event::FromNode { node: NODE, session: SESSION, message });
    }

    fn result(index: u32) -> NodeToApp {
        NodeToApp::Result(ResultHeader {
            job: attempt(index),
            device: DeviceIndex(0),
            device_time_ns: 1,
            outcome: Ok(vec![4]),
            digest: ContentHash([2; 32]),
        })
    }

    fn kept(index: u32) -> Event {
        Event::Kept { task: TaskId(0), index: JobIndex(index) }
    }

    #[test]
    fn a_journalled_result_is_acknowledged_once_it_is_kept() {
        let mut ledger = ledger(true);
        hears(&mut ledger, result(0));
        assert_eq!(drain(&mut ledger), (vec![], 1, 0));
        ledger.handle(Instant::ZERO, kept(0));
        assert_eq!(drain(&mut ledger), (vec![attempt(0)], 0, 0));
        ledger.handle(Instant::ZERO, kept(0));
        assert_eq!(drain(&mut ledger), (vec![], 0, 0), "once");
    }

    #[test]
    fn without_a_journal_it_is_acknowledged_at_once() {
        let mut ledger = ledger(false);
        hears(&mut ledger, result(0));
        assert_eq!(drain(&mut ledger), (vec![attempt(0)], 1, 0));
    }

    /// The node repeats what it has no acknowledgement for; an answer then would lose what is not on disk yet.
    #[test]
    fn a_repeated_result_waits_like_the_first() {
        let mut ledger = ledger(true);
        hears(&mut ledger, result(0));
        drain(&mut ledger);
        ledger.handle(Instant::ZERO, Event::NodeLost { node: NODE, session: SESSION });
        drain(&mut ledger);
        let due = ledger.poll_timeout().expect("the other job is there: the link is tried again");
        ledger.handle_timeout(due);
        drain(&mut ledger);
        connect(&mut ledger);
        hears(&mut ledger, result(0));
        assert_eq!(drain(&mut ledger), (vec![], 0, 1));
        ledger.handle(Instant::ZERO, kept(0));
        assert_eq!(drain(&mut ledger), (vec![attempt(0)], 0, 0));
        hears(&mut ledger, result(0));
        assert_eq!(drain(&mut ledger), (vec![attempt(0)], 0, 1), "now the node hears it again");
    }

    #[test]
    fn the_end_of_a_task_frees_what_waits() {
        let mut ledger = ledger(true);
        hears(&mut ledger, result(0));
        drain(&mut ledger);
        ledger.handle(Instant::ZERO, Event::Cancelled(TaskId(0)));
        assert_eq!(drain(&mut ledger).0, [attempt(0)]);
        hears(&mut ledger, result(1));
        assert_eq!(drain(&mut ledger), (vec![attempt(1)], 0, 1), "nobody wants it");
    }
}
