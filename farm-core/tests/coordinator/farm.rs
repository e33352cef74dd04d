//! A coordinator with one application and its nodes, driven by hand.

use std::{collections::BTreeMap, time::Duration};

use farm_core::{
    coordinator::{
        CoordinatorConfig, CoordinatorMachine, Effect, Event, NodeState,
        durable::{Keep, Restored},
        policy::{Question, QuestionId},
    },
    device::{DeviceInfo, DeviceKind, Features, Limits, Requirements},
    id::{
        AppId, AppIncarnation, BatchId, ContentHash, DeviceIndex, Epoch, JobAttempt, JobIndex, LinkId,
        NodeSession, TaskId,
    },
    message::{
        AppHello, AppToCoordinator, CacheFigures, Contact, CoordinatorToApp, CoordinatorToNode, CostNs,
        DeviceLoad, Executed, JobFailure, JobTrace, NodeHello, NodeToCoordinator, PROTOCOL_VERSION, Plan,
        PlanJob, PlanRequest, RunningJob, WaitReason,
    },
    program::Content,
    project::AppTerms,
    time::Instant,
};

pub(crate) const APP: LinkId = LinkId(0);
pub(crate) const MILLISECOND_NS: u64 = 1_000_000;

/// A coordinator with one application and nodes of one device each unless said otherwise.
pub(crate) struct Farm {
    pub(crate) machine: CoordinatorMachine,
    pub(crate) now: Instant,
    batches: u64,
    pub(crate) questions: Vec<(QuestionId, String, Question)>,
    pub(crate) refused: Option<String>,
    /// Why the application was stopped, each time that it was told.
    pub(crate) stopped: Vec<String>,
    /// Whether the last plan was of second attempts.
    pub(crate) speculative: bool,
    /// By node, in order.
    pub(crate) cancelled: Vec<(u64, JobAttempt)>,
    /// Nodes that were asked what they hold.
    pub(crate) asked: Vec<u64>,
    /// Nodes that were told where to fetch, and from which address; none is the application.
    pub(crate) located: Vec<(u64, Option<String>)>,
    /// What is to outlive the coordinator, in order.
    pub(crate) kept: Vec<Keep>,
    /// Nodes that were told that an application left, in order.
    pub(crate) left: Vec<(u64, AppId)>,
    /// Why the application's batches wait, in the order that it was told.
    pub(crate) waits: Vec<WaitReason>,
    /// The jobs that were given up.
    pub(crate) given_up: Vec<JobFailure>,
    /// What node 1 was told last of what each application may have.
    pub(crate) terms: BTreeMap<AppId, AppTerms>,
    /// How often it was told of some.
    pub(crate) announcements: u32,
}

impl Farm {
    pub(crate) fn new(policy: &str, scores: &[f64]) -> Self {
        let config = CoordinatorConfig {
            plugins: ["spread".to_owned()].into(),
            ..CoordinatorConfig::new(Epoch(1), 1)
        };
        let machine = CoordinatorMachine::new(config);
        let mut farm = Self {
            machine,
            now: Instant::ZERO,
            batches: 0,
            questions: Vec::new(),
            refused: None,
            stopped: Vec::new(),
            speculative: false,
            cancelled: Vec::new(),
            asked: Vec::new(),
            located: Vec::new(),
            kept: Vec::new(),
            left: Vec::new(),
            waits: Vec::new(),
            given_up: Vec::new(),
            terms: BTreeMap::new(),
            announcements: 0,
        };
        for (node, &score) in (1..).zip(scores) {
            farm.node_joins(node, score);
        }
        farm.say(AppToCoordinator::Hello(AppHello { policy: policy.to_owned(), ..hello() }));
        farm
    }

    /// Another coordinator takes over a minute at most after this one's time zero, with what this one kept; the application
    /// resumes, the nodes are still away.
    pub(crate) fn coordinator_restarts(&mut self) {
        let app = self.machine.status().apps[0].app;
        let mut restored = Restored::default();
        for keep in std::mem::take(&mut self.kept) {
            match keep {
                Keep::Stopped(stopped) => restored.stopped.push(stopped),
                Keep::Speeds(speeds) => restored.speeds.push(speeds),
            }
        }
        let config = CoordinatorConfig { restored, ..CoordinatorConfig::new(Epoch(2), 2) };
        self.machine = CoordinatorMachine::new(config);
        self.stopped.clear();
        let resume = Some((app, AppIncarnation(1)));
        self.say(AppToCoordinator::Hello(AppHello { resume, ..hello() }));
    }

    /// The application dials again.
    pub(crate) fn app_comes_back(&mut self) -> BTreeMap<u64, Vec<JobAttempt>> {
        let resume = Some((self.machine.status().apps[0].app, AppIncarnation(1)));
        let message = AppToCoordinator::Hello(AppHello { resume, ..hello() });
        self.handle(Event::FromApp { link: LinkId(1_000), message })
    }

    pub(crate) fn node_joins(&mut self, node: u64, score: f64) {
        self.node_of_devices_joins(node, &[score]);
    }

    pub(crate) fn node_of_devices_joins(&mut self, node: u64, scores: &[f64]) {
        let device = |&score: &f64| DeviceInfo {
            name: "sim".to_owned(),
            kind: DeviceKind::Simulated,
            score,
            features: Features::default(),
            limits: Limits::UNBOUNDED,
        };
        let message = NodeToCoordinator::Hello(NodeHello {
            protocol: PROTOCOL_VERSION,
            node: None,
            name: format!("node {node}"),
            session: NodeSession(node),
            devices: scores.iter().map(device).collect(),
            contact: Contact { addresses: vec![format!("node {node}")], certificate_der: Vec::new() },
            inventory: Vec::new(),
        });
        self.handle(Event::FromNode { link: LinkId(node), message });
    }

    fn say(&mut self, message: AppToCoordinator) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.handle(Event::FromApp { link: APP, message })
    }

    /// Takes an event in; gives the jobs planned in answer, by node.
    pub(crate) fn handle(&mut self, event: Event) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.machine.handle(self.now, event);
        self.settle()
    }

    pub(crate) fn settle(&mut self) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.machine.check_invariants();
        let mut planned: BTreeMap<u64, Vec<JobAttempt>> = BTreeMap::new();
        while let Some(effect) = self.machine.poll_effect() {
            match effect {
                Effect::ToApp {
                    message: CoordinatorToApp::Plan(Plan { nodes, speculative, .. }), ..
                } => {
                    self.speculative = speculative;
                    for node in nodes {
                        let jobs = node.devices.into_iter().flat_map(|device| device.jobs);
                        planned.entry(node.session.0).or_default().extend(jobs);
                    }
                }
                Effect::ToApp { message: CoordinatorToApp::Refused { reason }, .. } => {
                    self.refused = Some(reason);
                }
                Effect::ToApp { message: CoordinatorToApp::Stopped { reason }, .. } => {
                    self.stopped.push(reason);
                }
                Effect::ToNode { link, message: CoordinatorToNode::Cancel { jobs } } => {
                    self.cancelled.extend(jobs.into_iter().map(|job| (link.0, job)));
                }
                Effect::ToApp { message: CoordinatorToApp::Waiting { reason, .. }, .. } => {
                    self.waits.push(reason);
                }
                Effect::ToApp { message: CoordinatorToApp::JobFailed { failure, .. }, .. } => {
                    self.given_up.push(failure);
                }
                Effect::ToNode { link: LinkId(1), message: CoordinatorToNode::AppsJoined(apps) } => {
                    self.announcements += 1;
                    self.terms.extend(apps);
                }
                Effect::ToNode { link, message: CoordinatorToNode::AppLeft { app } } => {
                    self.left.push((link.0, app));
                }
                Effect::ToNode { link, message: CoordinatorToNode::SayInventory } => self.asked.push(link.0),
                Effect::ToNode { link, message: CoordinatorToNode::Located { peer, .. } } => {
                    self.located.push((link.0, peer.map(|peer| peer.addresses.concat())));
                }
                Effect::AskPolicy { id, plugin, question } => self.questions.push((id, plugin, question)),
                Effect::Keep(keep) => self.kept.push(keep),
                Effect::ToApp { .. } | Effect::ToNode { .. } | Effect::Close { .. } => {}
            }
        }
        planned
    }

    pub(crate) fn plan(
        &mut self,
        costs_ms: &[u64],
        module: u8,
        contents: &[Content],
    ) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.batches += 1;
        let jobs = (0..).zip(costs_ms).map(|(index, cost_ms)| PlanJob {
            index: JobIndex(index),
            cost: CostNs(cost_ms * MILLISECOND_NS),
        });
        let request = PlanRequest {
            batch: BatchId(self.batches),
            task: TaskId(u32::try_from(self.batches).unwrap()),
            jobs: jobs.collect(),
            needs: Requirements::ANY,
            module: Some(ContentHash([module; 32])),
            contents: contents.to_vec(),
            held: Vec::new(),
        };
        self.say(AppToCoordinator::Plan(request))
    }

    /// A node or the application says whether its heartbeats are answered; 0 is the application.
    pub(crate) fn says_unanswered(&mut self, who: u64, unanswered: bool) -> BTreeMap<u64, Vec<JobAttempt>> {
        if who == APP.0 {
            return self.say(AppToCoordinator::Heartbeat { sequence: 2, unanswered });
        }
        let message = NodeToCoordinator::Heartbeat {
            sequence: 2,
            unanswered,
            devices: Vec::new(),
            spool_bytes: 0,
            cache: None,
        };
        self.handle(Event::FromNode { link: LinkId(who), message })
    }

    /// A node says that it lives, and what its device has run for how many nanoseconds.
    pub(crate) fn heartbeat(
        &mut self,
        node: u64,
        running: Option<(JobAttempt, u64)>,
    ) -> BTreeMap<u64, Vec<JobAttempt>> {
        let running = running.map(|(job, for_ns)| RunningJob { job, for_ns });
        let devices = vec![DeviceLoad { queued_jobs: 0, running }];
        let message = NodeToCoordinator::Heartbeat {
            sequence: 1,
            unanswered: false,
            devices,
            spool_bytes: 0,
            cache: Some(CacheFigures::default()),
        };
        self.handle(Event::FromNode { link: LinkId(node), message })
    }

    /// A node says all that it holds; gives the jobs that are planned because of it.
    pub(crate) fn inventory(&mut self, node: u64, held: &[JobAttempt]) -> Vec<JobAttempt> {
        let message = NodeToCoordinator::Inventory(held.to_vec());
        let planned = self.handle(Event::FromNode { link: LinkId(node), message });
        planned.into_values().flatten().collect()
    }

    pub(crate) fn leaves(&mut self, node: u64) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.handle(Event::FromNode { link: LinkId(node), message: NodeToCoordinator::Goodbye })
    }

    /// A node's connection is gone: it gets nothing new.
    pub(crate) fn stop_taking(&mut self, node: u64) {
        self.handle(Event::LinkClosed { link: LinkId(node) });
    }

    pub(crate) fn failed(
        &mut self,
        node: u64,
        job: JobAttempt,
        failure: JobFailure,
    ) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.failed_on(node, DeviceIndex(0), job, failure)
    }

    pub(crate) fn failed_on(
        &mut self,
        node: u64,
        device: DeviceIndex,
        job: JobAttempt,
        failure: JobFailure,
    ) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.report(node, device, job, 0, Some(failure))
    }

    pub(crate) fn open_jobs(&self) -> u64 {
        self.machine.status().apps.iter().map(|app| app.waiting_jobs + app.outstanding_jobs).sum()
    }

    /// Lets time pass, the remaining nodes and the application alive, until something is planned.
    pub(crate) fn wait_for_plan(&mut self) -> BTreeMap<u64, Vec<JobAttempt>> {
        for _ in 0..1_000 {
            let due = self.machine.poll_timeout().unwrap();
            let planned = self.advance_to(due);
            if !planned.is_empty() {
                return planned;
            }
        }
        panic!("nothing is planned any more")
    }

    pub(crate) fn advance_to_ms(&mut self, at_ms: u64) {
        while self.machine.poll_timeout().is_some_and(|due| due.0 <= at_ms * MILLISECOND_NS) {
            let due = self.machine.poll_timeout().unwrap();
            assert!(self.advance_to(due).is_empty(), "nothing is planned before");
        }
        self.now = Instant(at_ms * MILLISECOND_NS);
    }

    fn advance_to(&mut self, due: Instant) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.now = self.now.max(due);
        self.say(AppToCoordinator::Heartbeat { sequence: 1, unanswered: false });
        let connected = self.machine.status().nodes;
        for node in connected.iter().filter(|node| node.state == NodeState::Alive) {
            let link: u64 = node.name.trim_start_matches("node ").parse().unwrap();
            self.heartbeat(link, None);
        }
        self.machine.handle_timeout(self.now);
        self.settle()
    }

    fn report(
        &mut self,
        node: u64,
        device: DeviceIndex,
        job: JobAttempt,
        device_time_ns: u64,
        failure: Option<JobFailure>,
    ) -> BTreeMap<u64, Vec<JobAttempt>> {
        let delivered = if failure.is_none() { vec![job] } else { Vec::new() };
        let trace = JobTrace::default();
        let executed = vec![Executed { job, device, device_time_ns, trace, failure }];
        let message = NodeToCoordinator::Report { sent_at: self.now, executed, delivered };
        self.handle(Event::FromNode { link: LinkId(node), message })
    }

    /// A node says that it has nothing to report.
    pub(crate) fn ended_nothing(&mut self, node: u64) {
        let message =
            NodeToCoordinator::Report { sent_at: self.now, executed: Vec::new(), delivered: Vec::new() };
        self.handle(Event::FromNode { link: LinkId(node), message });
    }

    /// A node has executed and delivered a job just now, in so many milliseconds.
    pub(crate) fn ended(
        &mut self,
        node: u64,
        job: JobAttempt,
        took_ms: u64,
    ) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.report(node, DeviceIndex(0), job, took_ms * MILLISECOND_NS, None)
    }

    /// A node has executed and delivered jobs, each in the time that `took_ms` says.
    pub(crate) fn done(&mut self, node: u64, jobs: &[JobAttempt], took_ms: impl Fn(JobAttempt) -> u64) {
        for &job in jobs {
            let device_time_ns = took_ms(job) * MILLISECOND_NS;
            self.now = self.now.after(Duration::from_nanos(device_time_ns));
            self.report(node, DeviceIndex(0), job, device_time_ns, None);
        }
    }
}

pub(crate) fn hello() -> AppHello {
    AppHello {
        protocol: PROTOCOL_VERSION,
        name: "app".to_owned(),
        weight: 1.0,
        global_stealing: true,
        policy: String::new(),
        resume: None,
    }
}

pub(crate) fn count(planned: &BTreeMap<u64, Vec<JobAttempt>>, node: u64) -> usize {
    planned.get(&node).map_or(0, Vec::len)
}
