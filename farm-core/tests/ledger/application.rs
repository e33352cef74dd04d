//! An application of two jobs that are on one node, driven by hand.

use std::time::Duration;

use farm_core::{
    device::Requirements,
    id::{
        AppId, AppIncarnation, Attempt, ContentHash, DeviceIndex, Epoch, JobAttempt, JobId, JobIndex, NodeId,
        NodeSession, TaskId,
    },
    ledger::{Effect, Event, Ledger, SubmittedJob},
    message::{
        AppHello, AppToCoordinator, AppToNode, Contact, CoordinatorToApp, CostNs, DevicePlan, LatencyClass,
        Liveness, NodePlan, NodeToApp, PROTOCOL_VERSION, Plan, Priority, ResultHeader,
    },
    time::Instant,
};

pub(crate) const NODE: NodeId = NodeId(1);
pub(crate) const SESSION: NodeSession = NodeSession(7);

pub(crate) struct Application {
    ledger: Ledger,
    now: Instant,
    /// Acknowledged to the node.
    pub(crate) acknowledged: Vec<JobAttempt>,
    pub(crate) cancelled: Vec<JobAttempt>,
    /// Sent to the node.
    pub(crate) sent: Vec<JobAttempt>,
    /// What should be at the node, as it was told.
    pub(crate) compared: Vec<farm_core::holding::Holding>,
    /// Applications that the coordinator was told it goes on for.
    pub(crate) superseded: Vec<AppId>,
    pub(crate) delivered: usize,
    pub(crate) dropped: usize,
    /// Times that the driver was asked to connect.
    pub(crate) dialled: usize,
}

impl Application {
    /// Its task is journalled or not.
    pub(crate) fn new(journalled: bool) -> Self {
        let ledger = Ledger::new(AppHello {
            protocol: PROTOCOL_VERSION,
            name: "test".to_owned(),
            weight: 1.0,
            global_stealing: false,
            policy: String::new(),
            resume: None,
        });
        let mut app = Self {
            ledger,
            now: Instant::ZERO,
            acknowledged: Vec::new(),
            cancelled: Vec::new(),
            sent: Vec::new(),
            compared: Vec::new(),
            superseded: Vec::new(),
            delivered: 0,
            dropped: 0,
            dialled: 0,
        };
        let job = |index| SubmittedJob {
            index: JobIndex(index),
            cost: CostNs(1),
            class: LatencyClass::Batch,
            priority: Priority(0),
            contents: Vec::new(),
            module: None,
        };
        app.registers();
        if journalled {
            app.handle(Event::Journalled(TaskId(0)));
        }
        let jobs = vec![job(0), job(1)];
        app.handle(Event::Submitted { task: TaskId(0), jobs, needs: Requirements::ANY });
        app.planned(NODE, SESSION, vec![attempt(0), attempt(1)]);
        app
    }

    /// Attempts are planned on a node, which is linked with.
    pub(crate) fn planned(&mut self, node: NodeId, session: NodeSession, jobs: Vec<JobAttempt>) {
        let devices = vec![DevicePlan { device: DeviceIndex(0), jobs }];
        let contact = Contact { addresses: vec!["127.0.0.1:1".to_owned()], certificate_der: Vec::new() };
        let nodes = vec![NodePlan { node, session, contact, devices }];
        let plan = Plan { batch: None, speculative: false, nodes };
        self.handle(Event::FromCoordinator(CoordinatorToApp::Plan(plan)));
        self.connect_with(node, session);
    }

    pub(crate) fn handle(&mut self, event: Event) {
        self.ledger.handle(self.now, event);
        self.settle();
    }

    /// The coordinator is there (again).
    pub(crate) fn registers(&mut self) {
        self.handle(Event::CoordinatorConnected);
        self.handle(Event::FromCoordinator(CoordinatorToApp::Welcome {
            app: AppId(1),
            incarnation: AppIncarnation(1),
            epoch: Epoch(1),
            liveness: Liveness::default(),
        }));
    }

    pub(crate) fn connect(&mut self) {
        self.connect_with(NODE, SESSION);
    }

    fn connect_with(&mut self, node: NodeId, session: NodeSession) {
        self.handle(Event::NodeConnected { node, session });
        self.handle(Event::FromNode { node, session, message: NodeToApp::Welcome { node, session } });
    }

    pub(crate) fn loses_link(&mut self) {
        self.handle(Event::NodeLost { node: NODE, session: SESSION });
    }

    /// Another link stands, as soon as the ledger wants one.
    pub(crate) fn connect_again(&mut self) {
        let dialled = self.dialled;
        self.pass(Duration::from_secs(1));
        assert_eq!(self.dialled, dialled + 1, "a link is wanted");
        self.connect();
    }

    /// Lets time pass; the coordinator answers.
    pub(crate) fn pass(&mut self, time: Duration) {
        let end = self.now.after(time);
        while let Some(due) = self.ledger.poll_timeout().filter(|due| *due <= end) {
            self.now = self.now.max(due);
            self.ledger.handle_timeout(self.now);
            self.settle();
            self.handle(Event::FromCoordinator(CoordinatorToApp::HeartbeatAck { sequence: 1 }));
        }
        self.now = end;
    }

    pub(crate) fn hears(&mut self, message: NodeToApp) {
        self.handle(Event::FromNode { node: NODE, session: SESSION, message });
    }

    pub(crate) fn result(&mut self, index: u32) {
        self.hears(result(index));
    }

    pub(crate) fn kept(&mut self, index: u32) {
        self.handle(Event::Kept { task: TaskId(0), index: JobIndex(index) });
    }

    fn settle(&mut self) {
        while let Some(effect) = self.ledger.poll_effect() {
            match effect {
                Effect::ToNode { message: AppToNode::Acks(said), .. } => {
                    self.acknowledged.extend(said.into_iter().map(|ack| ack.job));
                }
                Effect::ToNode { message: AppToNode::Cancel(jobs), .. } => self.cancelled.extend(jobs),
                Effect::ToNode { message: AppToNode::Jobs(tickets), .. } => {
                    self.sent.extend(tickets.into_iter().map(|ticket| ticket.job));
                }
                Effect::ToNode { message: AppToNode::Holding(holding), .. } => self.compared.push(holding),
                Effect::ToCoordinator(AppToCoordinator::Supersede(app)) => self.superseded.push(app),
                Effect::Deliver { .. } => self.delivered += 1,
                Effect::DropPayload { .. } => self.dropped += 1,
                Effect::Connect { .. } => self.dialled += 1,
                _ => {}
            }
        }
        self.ledger.check_invariants();
    }
}

pub(crate) fn result(index: u32) -> NodeToApp {
    NodeToApp::Result(ResultHeader {
        job: attempt(index),
        device: DeviceIndex(0),
        device_time_ns: 1,
        outcome: Ok(vec![4]),
        digest: ContentHash([2; 32]),
    })
}

pub(crate) fn attempt(index: u32) -> JobAttempt {
    let job = JobId { app: AppId(1), task: TaskId(0), index: JobIndex(index) };
    JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence: u64::from(index) + 1 } }
}
