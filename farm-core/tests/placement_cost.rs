//! What a job costs the coordinator. Prints figures, asserts none: run with
//! `cargo test --release -p farm-core --test placement_cost -- --ignored --nocapture`.

use std::time::Duration;

use farm_core::{
    coordinator::{CoordinatorConfig, CoordinatorMachine, Effect, Event},
    device::{DeviceInfo, DeviceKind, Features, Limits, Requirements},
    id::{BatchId, Epoch, JobIndex, LinkId, NodeSession, TaskId},
    message::{
        AppHello, AppToCoordinator, Contact, CoordinatorToApp, CostNs, Executed, JobTrace, NodeHello,
        NodeToCoordinator, PROTOCOL_VERSION, PlanJob, PlanRequest,
    },
    time::Instant,
};

const NODES: u64 = 125;
const DEVICES_PER_NODE: usize = 8;
const BATCHES: u32 = 5;
const JOBS_PER_BATCH: u32 = 4_000;
const APP: LinkId = LinkId(0);

fn farm() -> CoordinatorMachine {
    let mut machine = CoordinatorMachine::new(CoordinatorConfig::new(Epoch(1), 1));
    for node in 1..=NODES {
        let device = |index: usize| DeviceInfo {
            name: "sim".to_owned(),
            kind: DeviceKind::Simulated,
            score: 100.0 + (index * 37 % 11) as f64,
            features: Features::default(),
            limits: Limits::UNBOUNDED,
        };
        let hello = NodeHello {
            protocol: PROTOCOL_VERSION,
            node: None,
            name: format!("node-{node}"),
            session: NodeSession(node),
            devices: (0..DEVICES_PER_NODE).map(device).collect(),
            contact: Contact { addresses: vec!["127.0.0.1:1".to_owned()], certificate_der: vec![0; 500] },
            inventory: Vec::new(),
        };
        machine.handle(
            Instant::ZERO,
            Event::FromNode { link: LinkId(node), message: NodeToCoordinator::Hello(hello) },
        );
    }
    let hello = AppHello {
        protocol: PROTOCOL_VERSION,
        name: "app".to_owned(),
        weight: 1.0,
        global_stealing: false,
        policy: String::new(),
        resume: None,
    };
    machine.handle(Instant::ZERO, Event::FromApp { link: APP, message: AppToCoordinator::Hello(hello) });
    machine
}

fn request(batch: u32) -> Event {
    let jobs = (0..JOBS_PER_BATCH).map(|index| PlanJob {
        index: JobIndex(batch * JOBS_PER_BATCH + index),
        cost: CostNs(1_000_000 + u64::from(index % 1_000) * 1_000),
    });
    let request = PlanRequest {
        batch: BatchId(batch.into()),
        task: TaskId(0),
        jobs: jobs.collect(),
        needs: Requirements::ANY,
        module: None,
        contents: Vec::new(),
        held: Vec::new(),
    };
    Event::FromApp { link: APP, message: AppToCoordinator::Plan(request) }
}

#[expect(clippy::disallowed_methods, clippy::disallowed_types, reason = "a measurement needs a clock")]
fn timed<T>(what: &str, work: impl FnOnce() -> T) -> T {
    let begin = std::time::Instant::now();
    let result = work();
    let per_job = begin.elapsed() / (BATCHES * JOBS_PER_BATCH);
    println!("{what}: {per_job:?} per job");
    assert!(per_job > Duration::ZERO, "the clock runs");
    result
}

#[test]
#[ignore = "prints figures for people"]
fn twenty_thousand_jobs_on_a_thousand_devices() {
    let mut machine = farm();
    while machine.poll_effect().is_some() {}
    timed("placement (bar: 20 us)", || {
        (0..BATCHES).for_each(|batch| machine.handle(Instant::ZERO, request(batch)));
    });
    let mut attempts = Vec::new();
    while let Some(effect) = machine.poll_effect() {
        if let Effect::ToApp { message: CoordinatorToApp::Plan(plan), .. } = effect {
            for node in plan.nodes {
                for device in node.devices {
                    attempts.extend(device.jobs.into_iter().map(|job| (node.node, device.device, job)));
                }
            }
        }
    }
    assert_eq!(attempts.len(), usize::try_from(BATCHES * JOBS_PER_BATCH).unwrap(), "every job has a place");
    attempts.sort_unstable();
    timed("completion", || {
        for chunk in attempts.chunk_by(|one, other| one.0 == other.0) {
            for report in chunk.chunks(32) {
                let executed = report.iter().map(|&(_, device, job)| Executed {
                    job,
                    device,
                    device_time_ns: 1_000_000,
                    trace: JobTrace::default(),
                    failure: None,
                });
                let message = NodeToCoordinator::Report {
                    sent_at: Instant::ZERO,
                    executed: executed.collect(),
                    delivered: report.iter().map(|(_, _, job)| *job).collect(),
                };
                let link = LinkId(chunk[0].0.0);
                machine.handle(Instant::ZERO, Event::FromNode { link, message });
            }
        }
    });
    machine.check_invariants();
    assert_eq!(machine.status().delivered_jobs, u64::from(BATCHES * JOBS_PER_BATCH), "all of them");
}
