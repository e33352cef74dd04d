//! A node of equal devices with applications on it, driven by hand.

use std::time::Duration;

use farm_core::{
    device::{DeviceInfo, DeviceKind, Features, Limits},
    id::{
        AppId, AppIncarnation, Attempt, ContentHash, DeviceIndex, Epoch, JobAttempt, JobId, JobIndex, LinkId,
        NodeId, NodeSession, TaskId,
    },
    message::{
        AppToNode, Contact, CoordinatorToNode, CostNs, JobFailure, JobTicket, LatencyClass, Liveness,
        NodeToApp, NodeToCoordinator, PROTOCOL_VERSION, Priority, ResultAck,
    },
    program::Content,
    project::AppTerms,
    time::Instant,
    worker::{Effect, Event, Provider, Share, WorkerConfig, WorkerMachine},
};

pub(crate) const MILLISECOND_NS: u64 = 1_000_000;

pub(crate) struct Node {
    pub(crate) machine: WorkerMachine,
    pub(crate) now: Instant,
    next_job: u32,
    /// Orders to the executors, in order: what begins with `true` was handed over, else taken back.
    pub(crate) orders: Vec<(bool, u16, JobAttempt)>,
    pub(crate) said: Vec<NodeToCoordinator>,
    /// What applications were told to be here.
    pub(crate) inventories: Vec<(u64, Vec<JobAttempt>)>,
    /// What the driver was asked to bring, and from whom.
    pub(crate) fetches: Vec<(Content, Provider)>,
}

impl Node {
    pub(crate) fn new(devices: usize, local_stealing: bool, apps: u64) -> Self {
        let device = DeviceInfo {
            name: "sim".to_owned(),
            kind: DeviceKind::Simulated,
            score: 1_000.0,
            features: Features::default(),
            limits: Limits::UNBOUNDED,
        };
        let machine = WorkerMachine::new(WorkerConfig {
            name: "node".to_owned(),
            session: NodeSession(1),
            devices: vec![device; devices],
            contact: Contact { addresses: Vec::new(), certificate_der: Vec::new() },
            max_jobs: 1_000,
            spool_quota_bytes: 1_000,
            local_stealing,
            share: Share::DEFAULT,
            cached: Vec::new(),
            seed: 1,
        });
        let mut node = Self {
            machine,
            now: Instant::ZERO,
            next_job: 0,
            orders: Vec::new(),
            said: Vec::new(),
            inventories: Vec::new(),
            fetches: Vec::new(),
        };
        node.tell(Event::CoordinatorConnected);
        let (id, epoch, liveness) = (NodeId(1), Epoch(1), Liveness::default());
        node.tell(Event::FromCoordinator(CoordinatorToNode::Welcome { node: id, epoch, liveness }));
        for app in 1..=apps {
            node.joined(app, AppTerms::unlimited(1.0));
            node.hello(app);
        }
        node
    }

    /// An application dials.
    pub(crate) fn hello(&mut self, app: u64) {
        let (protocol, incarnation) = (PROTOCOL_VERSION, AppIncarnation(1));
        let message = AppToNode::Hello { protocol, app: AppId(app), incarnation };
        self.tell(Event::FromApp { link: LinkId(app), message });
    }

    /// The coordinator says what an application may have.
    pub(crate) fn joined(&mut self, app: u64, terms: AppTerms) {
        self.tell(Event::FromCoordinator(CoordinatorToNode::AppsJoined(vec![(AppId(app), terms)])));
    }

    pub(crate) fn tell(&mut self, event: Event) {
        self.machine.handle(self.now, event);
        self.settle();
    }

    /// Acts on the timers that are due.
    pub(crate) fn timers(&mut self) {
        self.machine.handle_timeout(self.now);
        self.settle();
    }

    fn settle(&mut self) {
        while let Some(effect) = self.machine.poll_effect() {
            match effect {
                Effect::Execute { job, device, .. } => self.orders.push((true, device.0, job)),
                Effect::Abort { job, device } => self.orders.push((false, device.0, job)),
                Effect::ToCoordinator(message) => self.said.push(message),
                Effect::ToApp { link, message: NodeToApp::Inventory(held) } => {
                    self.inventories.push((link.0, held));
                }
                Effect::Fetch { content, from } => self.fetches.push((content, from)),
                _ => {}
            }
        }
        self.machine.check_invariants();
    }

    /// One job of application 1 that needs contents.
    pub(crate) fn job_with(&mut self, contents: Vec<Content>) -> JobAttempt {
        let mut ticket = self.ticket(1, 0, LatencyClass::Batch, Priority(0));
        ticket.contents = contents;
        let job = ticket.job;
        self.tell(Event::FromApp { link: LinkId(1), message: AppToNode::Jobs(vec![ticket]) });
        job
    }

    /// Jobs of 10 ms arrive together, planned for one device.
    pub(crate) fn jobs(&mut self, app: u64, device: u16, count: u32, class: LatencyClass) -> Vec<JobAttempt> {
        self.tickets(app, device, count, class, |_| Priority(0))
    }

    pub(crate) fn tickets(
        &mut self,
        app: u64,
        device: u16,
        count: u32,
        class: LatencyClass,
        priority: impl Fn(u32) -> Priority,
    ) -> Vec<JobAttempt> {
        let tickets: Vec<JobTicket> =
            (0..count).map(|nth| self.ticket(app, device, class, priority(nth))).collect();
        let jobs = tickets.iter().map(|ticket| ticket.job).collect();
        self.tell(Event::FromApp { link: LinkId(app), message: AppToNode::Jobs(tickets) });
        jobs
    }

    fn ticket(&mut self, app: u64, device: u16, class: LatencyClass, priority: Priority) -> JobTicket {
        self.next_job += 1;
        let job = JobId { app: AppId(app), task: TaskId(0), index: JobIndex(self.next_job) };
        let attempt = Attempt { epoch: Epoch(1), sequence: self.next_job.into() };
        JobTicket {
            job: JobAttempt { job, attempt },
            device: DeviceIndex(device),
            class,
            priority,
            cost: CostNs(10 * MILLISECOND_NS),
            contents: Vec::new(),
        }
    }

    pub(crate) fn pass_ms(&mut self, ms: u64) {
        self.now = self.now.after(Duration::from_millis(ms));
    }

    pub(crate) fn started(&mut self, job: JobAttempt, device: u16) {
        self.tell(Event::Started { job, device: DeviceIndex(device) });
    }

    pub(crate) fn done(&mut self, job: JobAttempt, device: u16) {
        let outcome = Ok((Vec::new(), ContentHash::EMPTY));
        self.ended(job, device, 10 * MILLISECOND_NS, outcome);
    }

    /// A job ends with so many bytes of result.
    pub(crate) fn done_with(&mut self, job: JobAttempt, device: u16, bytes: u64) {
        self.ended(job, device, 10 * MILLISECOND_NS, Ok((vec![bytes], ContentHash::EMPTY)));
    }

    /// The application has the result.
    pub(crate) fn acknowledge(&mut self, job: JobAttempt) {
        let acks = vec![ResultAck { job, digest: ContentHash::EMPTY }];
        self.tell(Event::FromApp { link: LinkId(job.job.app.0), message: AppToNode::Acks(acks) });
    }

    pub(crate) fn cancelled(&mut self, job: JobAttempt, device: u16) {
        self.ended(job, device, 0, Err(JobFailure::Cancelled));
    }

    /// Orders given since the last call.
    pub(crate) fn orders(&mut self) -> Vec<(bool, u16, JobAttempt)> {
        std::mem::take(&mut self.orders)
    }

    fn ended(
        &mut self,
        job: JobAttempt,
        device: u16,
        device_time_ns: u64,
        outcome: Result<(Vec<u64>, ContentHash), JobFailure>,
    ) {
        self.tell(Event::Executed { job, device: DeviceIndex(device), device_time_ns, outcome });
    }
}
