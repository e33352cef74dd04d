//! What a job costs the coordinator when there are very many: time to plan it, and memory to keep it.
//!
//! Four applications ask for a million jobs on a thousand nodes, in requests of the size that ledgers make; none runs.

use std::{fs, time::Instant as Clock};

use farm_core::{
    coordinator::{CoordinatorConfig, CoordinatorMachine, Effect, Event},
    device::{DeviceInfo, DeviceKind, Features, Limits, Requirements},
    id::{BatchId, ContentHash, Epoch, JobIndex, LinkId, NodeSession, TaskId},
    message::{
        AppHello, AppToCoordinator, Contact, CoordinatorToApp, CostNs, NodeHello, NodeToCoordinator,
        PROTOCOL_VERSION, PlanJob, PlanRequest,
    },
    time::Instant,
};

/// Nodes of the farm.
const NODES: u64 = 1_000;

/// Applications, each with as many jobs as its ledger asks for at once at most, less a little.
const APPS: u64 = 4;

/// Jobs of each application.
const JOBS_PER_APP: u32 = 250_000;

/// Most jobs of one request, as ledgers make them.
const JOBS_PER_REQUEST: u32 = 4_096;

/// Most that planning a job may take, in microseconds (10-scheduling.md).
pub const PLANNING_BAR_US: f64 = 20.0;

/// Most that a queued job may take in the coordinator, in bytes (10-scheduling.md).
pub const MEMORY_BAR_BYTES: f64 = 1_024.0;

/// What was measured.
#[derive(Clone, Copy, Debug)]
pub struct Figures {
    /// Queued jobs.
    pub jobs: u64,
    /// Devices on all nodes.
    pub devices: u64,
    /// Wall time in the coordinator for each job, in microseconds.
    pub planning_us: f64,
    /// Growth of the process for each job, in bytes.
    pub memory_bytes: f64,
}

impl Figures {
    /// Whether both are below their bars.
    #[must_use]
    pub fn pass(&self) -> bool {
        self.planning_us <= PLANNING_BAR_US && self.memory_bytes < MEMORY_BAR_BYTES
    }
}

/// Plans a million jobs on nodes of so many devices.
///
/// # Panics
/// A job gets no place, or the system does not say how large the process is.
#[must_use]
pub fn measure(devices_per_node: u16) -> Figures {
    let mut coordinator = farm(devices_per_node);
    let mut planned = 0;
    let mut seconds = 0.0;
    let before = resident_bytes();
    for request in 0..JOBS_PER_APP.div_ceil(JOBS_PER_REQUEST) {
        for app in 0..APPS {
            let event = request_event(app, request);
            let begin = Clock::now();
            coordinator.handle(Instant::ZERO, event);
            seconds += begin.elapsed().as_secs_f64();
            planned += take_plans(&mut coordinator);
        }
    }
    let after = resident_bytes();
    let jobs = APPS * u64::from(JOBS_PER_APP);
    assert_eq!(planned, jobs, "every job has a place");
    coordinator.check_invariants();
    Figures {
        jobs,
        devices: NODES * u64::from(devices_per_node),
        planning_us: seconds * 1e6 / jobs as f64,
        memory_bytes: after.saturating_sub(before) as f64 / jobs as f64,
    }
}

fn farm(devices_per_node: u16) -> CoordinatorMachine {
    let mut coordinator = CoordinatorMachine::new(CoordinatorConfig::new(Epoch(1), 1));
    for node in 0..NODES {
        let device = |index: u16| DeviceInfo {
            name: "sim".to_owned(),
            kind: DeviceKind::Simulated,
            // Unequal, as real ones are: 100 to 110.
            score: 100.0 + ((node + u64::from(index)) * 37 % 11) as f64,
            features: Features::default(),
            limits: Limits::UNBOUNDED,
        };
        let hello = NodeHello {
            protocol: PROTOCOL_VERSION,
            node: None,
            name: format!("node-{node}"),
            session: NodeSession(node),
            devices: (0..devices_per_node).map(device).collect(),
            // As large as a real certificate.
            contact: Contact { addresses: vec!["10.0.0.1:7000".to_owned()], certificate_der: vec![0; 500] },
            inventory: Vec::new(),
        };
        let message = NodeToCoordinator::Hello(hello);
        coordinator.handle(Instant::ZERO, Event::FromNode { link: LinkId(APPS + node), message });
    }
    for app in 0..APPS {
        let hello = AppHello {
            protocol: PROTOCOL_VERSION,
            name: format!("app-{app}"),
            weight: 1.0,
            global_stealing: true,
            policy: String::new(),
            resume: None,
        };
        let message = AppToCoordinator::Hello(hello);
        coordinator.handle(Instant::ZERO, Event::FromApp { link: LinkId(app), message });
    }
    take_plans(&mut coordinator);
    coordinator
}

fn request_event(app: u64, request: u32) -> Event {
    let first = request * JOBS_PER_REQUEST;
    let jobs = (first..JOBS_PER_APP.min(first + JOBS_PER_REQUEST)).map(|index| PlanJob {
        index: JobIndex(index),
        cost: CostNs(1_000_000 + u64::from(index % 1_000) * 1_000),
    });
    let request = PlanRequest {
        batch: BatchId(request.into()),
        task: TaskId(0),
        jobs: jobs.collect(),
        needs: Requirements::ANY,
        contents: Vec::new(),
        held: Vec::new(),
        module: Some(ContentHash([1; 32])),
    };
    Event::FromApp { link: LinkId(app), message: AppToCoordinator::Plan(request) }
}

/// Takes what the coordinator says, as its driver does. Returns the number of places in it.
fn take_plans(coordinator: &mut CoordinatorMachine) -> u64 {
    let mut jobs = 0;
    while let Some(effect) = coordinator.poll_effect() {
        if let Effect::ToApp { message: CoordinatorToApp::Plan(plan), .. } = effect {
            let devices = plan.nodes.iter().flat_map(|node| &node.devices);
            jobs += devices.map(|device| device.jobs.len() as u64).sum::<u64>();
        }
    }
    jobs
}

/// Memory of this process that is in RAM.
fn resident_bytes() -> u64 {
    let status = fs::read_to_string("/proc/self/status").expect("Linux says how large a process is");
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("it has a resident size");
    let kibibytes: u64 = line.trim().trim_end_matches(" kB").parse().expect("in kB");
    kibibytes * 1_024
}
