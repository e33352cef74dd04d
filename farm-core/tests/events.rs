//! Any sequence of events, also ones that no honest peer would cause, leaves each machine with its invariants.

use std::collections::BTreeMap;

use farm_core::{
    coordinator::{self, CoordinatorConfig, CoordinatorMachine},
    device::{DeviceInfo, DeviceKind, Features, Limits, Requirements},
    id::{
        AppId, AppIncarnation, Attempt, BatchId, ContentHash, DeviceIndex, Epoch, JobAttempt, JobId,
        JobIndex, LinkId, NodeId, NodeSession, StealId, TaskId,
    },
    ledger::{self, Ledger, SubmittedJob},
    message::{
        AppHello, AppToCoordinator, AppToNode, CacheFigures, Contact, CoordinatorToApp, CoordinatorToNode,
        CostNs, DevicePlan, Executed, HeldJob, JobFailure, JobTicket, JobTrace, LatencyClass, Liveness,
        NodeHello, NodePlan, NodeToApp, NodeToCoordinator, PROTOCOL_VERSION, Plan, PlanJob, PlanRequest,
        Priority, ResultAck, ResultHeader, WaitReason,
    },
    program::Content,
    project::{AppTerms, Quota},
    time::Instant,
    worker::{self, WorkerConfig, WorkerMachine},
};
use proptest::prelude::*;

/// One step: which event, four small numbers to fill it with, and how many milliseconds pass before it.
#[derive(Clone, Copy, Debug)]
struct Step {
    kind: u8,
    one: u8,
    two: u8,
    three: u8,
    four: u8,
    pause_ms: u16,
}

fn steps(kinds: u8) -> impl Strategy<Value = Vec<Step>> {
    let pause = prop_oneof![6 => 0_u16..20, 1 => 0_u16..3_000, 1 => 0_u16..40_000];
    let step = (0..kinds, 0_u8..4, 0_u8..4, 0_u8..4, 0_u8..6, pause)
        .prop_map(|(kind, one, two, three, four, pause_ms)| Step { kind, one, two, three, four, pause_ms });
    prop::collection::vec(step, 1..150)
}

fn job(step: Step) -> JobAttempt {
    attempt(step.two, step.three, step.four)
}

fn attempt(app: u8, index: u8, sequence: u8) -> JobAttempt {
    JobAttempt {
        job: JobId { app: AppId(app.into()), task: TaskId(0), index: JobIndex(index.into()) },
        attempt: Attempt { epoch: Epoch(1), sequence: sequence.into() },
    }
}

fn inventory(step: Step) -> Vec<JobAttempt> {
    (0..step.four).map(|sequence| attempt(1, sequence, sequence * 2)).collect()
}

fn content(tag: u8) -> Content {
    Content { hash: ContentHash([tag; 32]), size_bytes: if tag.is_multiple_of(2) { 4 } else { 4 << 20 } }
}

fn device(speed: u8) -> DeviceInfo {
    DeviceInfo {
        name: "sim".to_owned(),
        kind: DeviceKind::Simulated,
        score: f64::from(speed) + 1.0,
        features: Features::default(),
        limits: Limits { memory_bytes: 1 << (20 + speed), ..Limits::UNBOUNDED },
    }
}

fn contact() -> Contact {
    Contact { addresses: vec!["somewhere:1".to_owned()], certificate_der: Vec::new() }
}

fn failure(choice: u8) -> Option<JobFailure> {
    match choice {
        0 => None,
        1 => Some(JobFailure::Timeout),
        2 => Some(JobFailure::Returned),
        3 => Some(JobFailure::InvalidProgram("test".to_owned())),
        4 => Some(JobFailure::ContentUnavailable(ContentHash([1; 32]))),
        _ => Some(JobFailure::Cancelled),
    }
}

fn app_hello(step: Step) -> AppHello {
    AppHello {
        protocol: PROTOCOL_VERSION + u32::from(step.four == 5),
        name: "app".to_owned(),
        weight: f64::from(step.three),
        global_stealing: step.three != 1,
        policy: match step.four % 3 {
            0 => "neighbours",
            _ => ["", "history", "plugin", "unknown"][usize::from(step.one)],
        }
        .to_owned(),
        resume: (step.two > 1).then(|| (AppId(step.two.into()), AppIncarnation(u32::from(step.four)))),
    }
}

// -------------------------------------------------------------------------------------------------- coordinator

fn project(step: Step) -> String {
    ["default", "a", "b", "c"][usize::from(step.two) % 4].to_owned()
}

fn coordinator_event(step: Step) -> coordinator::Event {
    let link = LinkId(u64::from(step.one) * 2 + u64::from(step.kind % 2));
    let from_app = |message| coordinator::Event::FromApp { link, message };
    let from_node = |message| coordinator::Event::FromNode { link, message };
    match step.kind {
        0 | 2 => from_app(AppToCoordinator::Hello(app_hello(step))),
        4 | 6 => from_app(AppToCoordinator::Plan(PlanRequest {
            batch: BatchId(step.two.into()),
            task: TaskId(step.three.into()),
            jobs: (0..step.four * 3)
                .map(|index| PlanJob { index: JobIndex(index.into()), cost: CostNs(u64::from(index % 3)) })
                .collect(),
            needs: Requirements {
                limits: Limits { memory_bytes: 1 << (20 + step.three), ..Limits::NONE },
                ..Requirements::ANY
            },
            module: step.one.is_multiple_of(2).then_some(ContentHash([step.two; 32])),
            contents: vec![content(1)],
            held: (0..step.four)
                .map(|index| HeldJob {
                    index: JobIndex(index.into()),
                    session: NodeSession(u64::from(step.one / 2)),
                    device: DeviceIndex((step.three / 2).into()),
                    attempt: attempt(0, index, index * 2).attempt,
                })
                .collect(),
        })),
        8 => from_app(AppToCoordinator::AlreadyDelivered(vec![
            attempt(step.two, step.three, 0).job,
            attempt(step.two, step.four, 0).job,
        ])),
        10 => from_app(AppToCoordinator::Unreachable {
            node: NodeId(step.two.into()),
            session: NodeSession(step.three.into()),
        }),
        12 => from_app(AppToCoordinator::Cancel(TaskId(step.three.into()))),
        14 => from_app(AppToCoordinator::Heartbeat { sequence: 1, unanswered: step.four == 0 }),
        16 if step.four == 0 => from_app(AppToCoordinator::Goodbye),
        16 => from_app(AppToCoordinator::Supersede(AppId(step.two.into()))),
        1 | 3 => from_node(NodeToCoordinator::Hello(NodeHello {
            protocol: PROTOCOL_VERSION,
            node: step.one.is_multiple_of(2).then(|| NodeId(step.one.into())),
            name: format!("node-{}", step.two),
            session: NodeSession(u64::from(step.three / 2)),
            devices: (0..=step.two).map(device).collect(),
            contact: contact(),
            inventory: inventory(step),
        })),
        5 => from_node(NodeToCoordinator::Heartbeat {
            sequence: 1,
            unanswered: step.four == 0,
            devices: vec![farm_core::message::DeviceLoad::default(); step.two.into()],
            spool_bytes: 0,
            cache: Some(CacheFigures::default()),
        }),
        7 | 9 => from_node(NodeToCoordinator::Report {
            sent_at: Instant(u64::from(step.four)),
            executed: (0..12)
                .map(|sequence| Executed {
                    job: attempt(step.two, sequence, sequence * (step.three + 1)),
                    device: DeviceIndex(step.three.into()),
                    device_time_ns: u64::from(step.four) * 1_000,
                    trace: JobTrace::default(),
                    failure: failure(step.four),
                })
                .collect(),
            delivered: (0..12)
                .map(|sequence| attempt(step.two, sequence, sequence * (step.four + 1)))
                .collect(),
        }),
        11 if step.four == 0 => from_node(NodeToCoordinator::Holding(inventory(step).into_iter().collect())),
        11 if step.four < 4 => from_node(NodeToCoordinator::Inventory(inventory(step))),
        11 => from_node(NodeToCoordinator::DeviceLost {
            device: DeviceIndex(step.two.into()),
            reason: "test".to_owned(),
        }),
        17 => from_node(NodeToCoordinator::Retracted {
            steal: StealId(u64::from(step.three) + 1),
            retracted: (0..12)
                .map(|sequence| attempt(step.two, sequence, sequence * (step.four + 1)))
                .collect(),
            running: Vec::new(),
            unknown: Vec::new(),
        }),
        18 => from_node(NodeToCoordinator::Locate(content(step.three))),
        19 => from_node(NodeToCoordinator::CacheChanged {
            held: (0..step.three).map(content).collect(),
            gone: (0..step.four).map(|tag| content(tag).hash).collect(),
        }),
        13 if step.four == 0 => from_node(NodeToCoordinator::Goodbye),
        15 => coordinator::Event::DrainRequested { node: NodeId(step.two.into()) },
        20 => coordinator::Event::EvictRequested {
            node: step.three.is_multiple_of(2).then_some(NodeId(step.two.into())),
            contents: (0..step.four).map(|tag| content(tag).hash).collect(),
        },
        21 | 23 => coordinator::Event::AppIntroduced { link, project: project(step) },
        25 => coordinator::Event::QuotaSet {
            project: project(step),
            quota: Quota {
                devices: step.three.checked_sub(1).map(u32::from),
                queued_jobs: step.four.checked_sub(1).map(u64::from),
                bytes: step.one.checked_sub(1).map(|most| u64::from(most) * 3),
                weight: step.two.checked_sub(1).map(|most| f64::from(most) + 0.25),
            },
        },
        27 if step.four == 0 => coordinator::Event::ProjectRemoved { project: project(step) },
        _ => coordinator::Event::LinkClosed { link },
    }
}

// -------------------------------------------------------------------------------------------------- worker

fn worker_machine() -> WorkerMachine {
    WorkerMachine::new(WorkerConfig {
        name: "worker".to_owned(),
        session: NodeSession(1),
        devices: vec![device(1), device(1), device(2)],
        contact: contact(),
        max_jobs: 8,
        spool_quota_bytes: 20,
        local_stealing: true,
        share: worker::Share::DEFAULT,
        cached: vec![content(1)],
        seed: 1,
    })
}

fn worker_event(step: Step) -> worker::Event {
    let link = LinkId(step.one.into());
    let from_app = |message| worker::Event::FromApp { link, message };
    let device = DeviceIndex(u16::from(step.one));
    match step.kind {
        0 => worker::Event::CoordinatorConnected,
        1 => worker::Event::FromCoordinator(CoordinatorToNode::Welcome {
            node: NodeId(1),
            epoch: Epoch(1),
            liveness: Liveness::default(),
        }),
        2 => worker::Event::CoordinatorLost,
        3 | 4 => from_app(AppToNode::Hello {
            protocol: PROTOCOL_VERSION,
            app: AppId(u64::from(step.one) % 2),
            incarnation: AppIncarnation(u32::from(step.four / 4)),
        }),
        5..=8 => from_app(AppToNode::Jobs(
            (0..=step.three)
                .map(|index| JobTicket {
                    job: attempt(step.one % 2, index + step.two, step.four),
                    device: DeviceIndex(u16::from(step.two)),
                    class: if step.one.is_multiple_of(3) {
                        LatencyClass::Interactive
                    } else {
                        LatencyClass::Batch
                    },
                    priority: Priority(step.three.into()),
                    cost: CostNs(step.two.into()),
                    contents: (0..step.three).map(content).collect(),
                })
                .collect(),
        )),
        9 => from_app(AppToNode::Acks(vec![ResultAck {
            job: attempt(step.one % 2, step.three, step.four),
            digest: ContentHash([u8::from(step.two == 0); 32]),
        }])),
        10 if step.two == 0 => from_app(AppToNode::Holding(inventory(step).into_iter().collect())),
        10 => from_app(AppToNode::Cancel(vec![attempt(step.one % 2, step.three, step.four)])),
        11 => worker::Event::AppLinkClosed { link },
        12 | 13 => worker::Event::ContentReady(ContentHash([step.two; 32])),
        14 => {
            worker::Event::ContentFailed { content: ContentHash([step.two; 32]), reason: "test".to_owned() }
        }
        15 => worker::Event::Started { job: job(step), device },
        16..=19 => worker::Event::Executed {
            job: attempt(step.two % 2, step.three, step.four),
            device,
            device_time_ns: u64::from(step.four) * 1_000_000,
            outcome: failure(step.one + u8::from(step.two == 3))
                .map_or_else(|| Ok((vec![4, 8], ContentHash([1; 32]))), Err),
        },
        20 if step.four == 1 => worker::Event::SpoolFull(step.one.is_multiple_of(2)),
        20 if step.four == 2 => worker::Event::ResultLost(job(step)),
        20 if step.four == 0 => worker::Event::DeviceLost { device, reason: "test".to_owned() },
        21 => {
            let terms = AppTerms {
                project: ["a", "b"][usize::from(step.three.is_multiple_of(2))].to_owned(),
                result_bytes: step.four.checked_sub(1).map(|most| u64::from(most) * 8),
                stays: step.four == 2,
                ..AppTerms::unlimited(f64::from(step.two) + 0.5)
            };
            let apps = vec![(AppId(u64::from(step.one) % 2), terms)];
            worker::Event::FromCoordinator(CoordinatorToNode::AppsJoined(apps))
        }
        22 if step.four < 2 => {
            worker::Event::FromCoordinator(CoordinatorToNode::AppLeft { app: AppId(u64::from(step.one) % 2) })
        }
        23 => worker::Event::FromCoordinator(CoordinatorToNode::Cancel { jobs: vec![job(step)] }),
        26 => worker::Event::FromCoordinator(CoordinatorToNode::Retract {
            steal: StealId(step.one.into()),
            jobs: (0..=step.three).map(|index| attempt(step.one % 2, index + step.two, step.four)).collect(),
        }),
        24 => worker::Event::FromCoordinator(CoordinatorToNode::HeartbeatAck { sequence: step.four.into() }),
        25 if step.three == 0 && step.four == 0 => worker::Event::DrainRequested,
        27 => worker::Event::Yielded { job: job(step), device },
        28 => worker::Event::Resumed { job: job(step), device },
        29 => worker::Event::ContentsEvicted(vec![ContentHash([step.two; 32])]),
        30 => worker::Event::FromCoordinator(CoordinatorToNode::Located {
            content: ContentHash([step.two; 32]),
            peer: step.three.is_multiple_of(2).then(contact),
        }),
        _ => worker::Event::CoordinatorConnected,
    }
}

/// Executors as the effects see them: what is handed over comes out, once, sometimes failed.
fn run_executors(
    machine: &mut WorkerMachine,
    now: Instant,
    step: Step,
    handed: &mut Vec<(JobAttempt, DeviceIndex)>,
) {
    if step.kind.is_multiple_of(2) || handed.is_empty() {
        return;
    }
    let (job, device) = handed.remove(usize::from(step.two) % handed.len());
    let outcome = failure(step.four).map_or_else(|| Ok((vec![4], ContentHash([1; 32]))), Err);
    machine.handle(now, worker::Event::Executed { job, device, device_time_ns: 1_000, outcome });
}

fn drain_worker(machine: &mut WorkerMachine, handed: &mut Vec<(JobAttempt, DeviceIndex)>) {
    while let Some(effect) = machine.poll_effect() {
        match effect {
            worker::Effect::Execute { job, device, class } => {
                handed.push((job, device));
                let there = handed.iter().filter(|(_, other)| *other == device).count();
                let most = if class == LatencyClass::Interactive { 3 } else { 2 };
                assert!(there <= most, "{device} has {there} jobs");
            }
            worker::Effect::Abort { job, .. } => handed.retain(|(other, _)| *other != job),
            worker::Effect::Discard(job) => handed.retain(|(other, _)| *other != job),
            worker::Effect::ToCoordinator(_)
            | worker::Effect::ToApp { .. }
            | worker::Effect::CloseApp { .. }
            | worker::Effect::Fetch { .. }
            | worker::Effect::Release(_)
            | worker::Effect::Evict(_)
            | worker::Effect::Exit => {}
        }
    }
}

// -------------------------------------------------------------------------------------------------- ledger

fn ledger_event(step: Step) -> ledger::Event {
    let node = NodeId(u64::from(step.one) % 2);
    let session = NodeSession(u64::from(step.two) % 2);
    let from_node = |message| ledger::Event::FromNode { node, session, message };
    match step.kind {
        0 => ledger::Event::CoordinatorConnected,
        1 | 2 => ledger::Event::FromCoordinator(CoordinatorToApp::Welcome {
            app: AppId(u64::from(step.three == 3) + 1),
            incarnation: AppIncarnation(u32::from(step.four / 3)),
            epoch: Epoch(1),
            liveness: Liveness::default(),
        }),
        3 => ledger::Event::CoordinatorLost,
        4 | 5 => ledger::Event::Submitted {
            task: TaskId(step.one.into()),
            jobs: (0..=step.three)
                .map(|index| SubmittedJob {
                    index: JobIndex(u32::from(index + step.two)),
                    cost: CostNs(1),
                    class: LatencyClass::Batch,
                    priority: Priority(0),
                    contents: vec![content(1)],
                    module: (index.is_multiple_of(2)).then_some(ContentHash([1; 32])),
                })
                .collect(),
            needs: Requirements::ANY,
        },
        6..=9 => ledger::Event::FromCoordinator(CoordinatorToApp::Plan(Plan {
            batch: None,
            speculative: step.four == 3,
            nodes: vec![NodePlan {
                node,
                session,
                contact: contact(),
                devices: vec![DevicePlan {
                    device: DeviceIndex(step.two.into()),
                    jobs: (0..5)
                        .map(|index| JobAttempt {
                            job: JobId {
                                app: AppId(1),
                                task: TaskId(step.three.into()),
                                index: JobIndex(index),
                            },
                            attempt: Attempt {
                                epoch: Epoch(1),
                                // The coordinator issues each attempt once.
                                sequence: (u64::from(step.four) * 4 + u64::from(step.three)) * 5
                                    + u64::from(index),
                            },
                        })
                        .collect(),
                }],
            }],
        })),
        10 | 11 => ledger::Event::NodeConnected { node, session },
        12 => ledger::Event::NodeLost { node, session },
        13 | 14 => from_node(NodeToApp::Welcome { node, session }),
        15 if step.four == 0 => from_node(NodeToApp::Refused { reason: "test".to_owned() }),
        15 => from_node(NodeToApp::Inventory(inventory(step))),
        16..=19 => from_node(NodeToApp::Result(ResultHeader {
            job: JobAttempt {
                job: JobId {
                    app: AppId(1),
                    task: TaskId(step.three.into()),
                    index: JobIndex(step.one.into()),
                },
                attempt: Attempt {
                    epoch: Epoch(1),
                    sequence: (u64::from(step.four) * 4 + u64::from(step.three)) * 5 + u64::from(step.one),
                },
            },
            device: DeviceIndex(0),
            device_time_ns: 1,
            outcome: if step.kind == 19 {
                failure(step.four).map_or_else(|| Ok(vec![4]), Err)
            } else {
                Ok(vec![4])
            },
            digest: ContentHash([2; 32]),
        })),
        20 => ledger::Event::FromCoordinator(CoordinatorToApp::JobFailed {
            job: JobId { app: AppId(1), task: TaskId(step.three.into()), index: JobIndex(step.one.into()) },
            failure: JobFailure::Poison("test".to_owned()),
        }),
        21 if step.one == 0 => {
            ledger::Event::FromCoordinator(CoordinatorToApp::Stopped { reason: "test".to_owned() })
        }
        21 => ledger::Event::FromCoordinator(CoordinatorToApp::Waiting {
            batch: BatchId(step.one.into()),
            reason: WaitReason::NoNode,
        }),
        22 if step.four == 0 => ledger::Event::Cancelled(TaskId(step.three.into())),
        23 if step.four == 0 && step.three == 0 => ledger::Event::Finished,
        24 if step.four == 0 => ledger::Event::Journalled(TaskId(step.three.into())),
        24 => ledger::Event::Kept { task: TaskId(step.three.into()), index: JobIndex(step.one.into()) },
        25 if step.four == 0 => ledger::Event::Supersedes(AppId(step.two.into())),
        _ => ledger::Event::FromCoordinator(CoordinatorToApp::HeartbeatAck { sequence: 1 }),
    }
}

/// I2: at most one end per job, and never a delivery of an attempt that does not count.
fn drain_ledger(ledger: &mut Ledger, ends: &mut BTreeMap<(TaskId, JobIndex), u32>) {
    while let Some(effect) = ledger.poll_effect() {
        let over = match effect {
            ledger::Effect::Deliver { job, .. } => job.job,
            ledger::Effect::Fail { job, .. } => job,
            ledger::Effect::ToCoordinator(_)
            | ledger::Effect::Connect { .. }
            | ledger::Effect::ToNode { .. }
            | ledger::Effect::Disconnect { .. }
            | ledger::Effect::Waiting { .. }
            | ledger::Effect::ForgetProgram(_)
            | ledger::Effect::DropPayload { .. }
            | ledger::Effect::Refused { .. } => continue,
        };
        let times = ends.entry((over.task, over.index)).or_default();
        *times += 1;
        assert_eq!(*times, 1, "{over} ended twice");
    }
}

fn judge_ledger(steps: &[Step]) {
    let hello = AppHello {
        protocol: PROTOCOL_VERSION,
        name: "app".to_owned(),
        weight: 1.0,
        global_stealing: false,
        policy: String::new(),
        resume: None,
    };
    let mut ledger = Ledger::new(hello);
    let mut ends = BTreeMap::new();
    let mut now = Instant::ZERO;
    for &step in steps {
        let now = after(&mut now, step);
        ledger.handle_timeout(now);
        ledger.check_invariants();
        assert!(ledger.poll_timeout().is_none_or(|due| due > now), "a timer that is due was not acted on");
        ledger.handle(now, ledger_event(step));
        ledger.check_invariants();
        drain_ledger(&mut ledger, &mut ends);
        ledger.check_invariants();
    }
    let counts = ledger.counts();
    let ended: u64 = ends.values().map(|times| u64::from(*times)).sum();
    assert_eq!(counts.delivered_jobs + counts.failed_jobs, ended, "each end is told once");
}

/// The pause before the next try was over long after the time for all tries.
#[test]
fn a_try_that_comes_too_late_has_its_time_all_the_same() {
    let step = Step { kind: 0, one: 0, two: 0, three: 0, four: 0, pause_ms: 0 };
    judge_ledger(&[
        step,
        Step { kind: 1, ..step },
        Step { kind: 4, one: 1, three: 1, ..step },
        Step { kind: 6, two: 1, three: 1, ..step },
        Step { kind: 10, two: 1, ..step },
        Step { kind: 13, two: 1, ..step },
        Step { kind: 12, two: 1, ..step },
        Step { kind: 24, pause_ms: 10_000, ..step },
    ]);
}

fn after(now: &mut Instant, step: Step) -> Instant {
    *now = Instant(now.0 + u64::from(step.pause_ms) * 1_000_000);
    *now
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2_000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn the_coordinator_keeps_its_invariants(epoch in 1_u32..3, steps in steps(20)) {
        let mut machine = CoordinatorMachine::new(CoordinatorConfig::new(Epoch(epoch), 1));
        let mut now = Instant::ZERO;
        for step in steps {
            let now = after(&mut now, step);
            machine.handle_timeout(now);
            machine.check_invariants();
            prop_assert!(machine.poll_timeout().is_none_or(|due| due > now), "a timer that is due was not acted on");
            machine.handle(now, coordinator_event(step));
            machine.check_invariants();
            while machine.poll_effect().is_some() {}
            let status = machine.status();
            let open: u64 = status.apps.iter().map(|app| app.waiting_jobs + app.outstanding_jobs).sum();
            prop_assert!(open < 10_000, "bounded");
        }
    }

    #[test]
    fn the_worker_keeps_its_invariants(steps in steps(31)) {
        let mut machine = worker_machine();
        let mut handed = Vec::new();
        let mut now = Instant::ZERO;
        // Most sequences should get past the registration.
        for event in [0, 1].map(|kind| worker_event(Step { kind, one: 0, two: 0, three: 0, four: 0, pause_ms: 0 })) {
            machine.handle(now, event);
        }
        for step in steps {
            let now = after(&mut now, step);
            machine.handle_timeout(now);
            machine.check_invariants();
            prop_assert!(machine.poll_timeout().is_none_or(|due| due > now), "a timer that is due was not acted on");
            let event = worker_event(step);
            if let worker::Event::Executed { job, device, .. } = &event {
                handed.retain(|handed| *handed != (*job, *device));
            }
            machine.handle(now, event);
            machine.check_invariants();
            drain_worker(&mut machine, &mut handed);
            run_executors(&mut machine, now, step, &mut handed);
            machine.check_invariants();
            drain_worker(&mut machine, &mut handed);
        }
    }

    #[test]
    fn the_ledger_keeps_its_invariants(steps in steps(26)) {
        judge_ledger(&steps);
    }
}
