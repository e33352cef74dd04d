//! Valid inputs, made by our own encoders; `FARM_BLESS=1` writes those that are missing. Text that people write (scenes,
//! alignments, WGSL) is in the corpus only.

use std::time::Duration;

use farm_core::{
    coordinator::{
        AppStatus, DeviceStatus, FarmStatus, NodeState, NodeStatus, ProjectStatus,
        policy::{Choice, Question, QuestionDevice, QuestionJob},
        timeline::{Migration, Outcome, Segment, TimelineApp, TimelineHead, TimelineNode},
    },
    device::{DeviceInfo, DeviceKind, Features, Limits, Requirements, SimulatedDevices},
    id::{
        AppId, AppIncarnation, Attempt, BatchId, ContentHash, DeviceIndex, Epoch, JobAttempt, JobId,
        JobIndex, NodeId, NodeSession, StealId, TaskId,
    },
    message::{
        AppHello, AppToCoordinator, AppToNode, CacheFigures, Contact, CoordinatorToApp, CoordinatorToNode,
        CostNs, DeviceLoad, DevicePlan, Executed, HeldJob, JobFailure, JobTicket, JobTrace, LatencyClass,
        Liveness, NodeHello, NodePlan, NodeToApp, NodeToCoordinator, Plan, PlanJob, PlanRequest, Priority,
        ResultAck, ResultHeader, RunningJob,
    },
    program::{Access, Content, JobProgram, Slicing},
    project::Quota,
    time::Instant,
};
use mi_kernel::{NullModel, Reference, ShuffleKind, saved};
use proto::{
    codec,
    control::{self, v1},
    link,
    trust::{Authority, Capability, JoinToken, NewKey, Role},
};

use crate::targets::{
    alignment::{SEED, alignment},
    state::{Folder, packed},
    trust::{authority, holder, node, now},
};

/// How long identities of the corpus live. Their age is not asked; the capability's is, at a time that does not move.
const LIFETIME: Duration = Duration::from_secs(9 * 365 * 86_400);

/// Target, file, maker.
pub(crate) type Seed = (&'static str, &'static str, fn() -> Vec<u8>);

pub(crate) const SEEDS: &[Seed] = &[
    ("frames_to_node", "valid-jobs", frames_to_node),
    ("frames_to_app", "valid-results", frames_to_app),
    ("job_program", "valid-program", || codec::encode_program(&program()).unwrap().to_vec()),
    ("job_program", "valid-empty", || codec::encode_program(&JobProgram::default()).unwrap().to_vec()),
    ("packed_programs", "valid-two", || {
        let encoded = codec::encode_program(&program()).unwrap();
        [&[2, 0][..], &codec::pack_programs([&encoded, &encoded]).concat()].concat()
    }),
    ("app_to_coordinator", "valid-hello", || {
        app_to_coordinator(AppToCoordinator::Hello(AppHello {
            protocol: 3,
            name: "render".to_owned(),
            weight: 2.5,
            global_stealing: true,
            policy: "fcfs".to_owned(),
            resume: Some((AppId(7), AppIncarnation(2))),
        }))
    }),
    ("app_to_coordinator", "valid-plan", || app_to_coordinator(AppToCoordinator::Plan(plan_request()))),
    ("app_to_coordinator", "valid-delivered", || {
        app_to_coordinator(AppToCoordinator::AlreadyDelivered(
            attempts(5).iter().map(|job| job.job).collect(),
        ))
    }),
    ("app_to_coordinator", "valid-supersede", || {
        app_to_coordinator(AppToCoordinator::Supersede(AppId(3 << 32 | 7)))
    }),
    ("coordinator_to_app", "valid-plan", || coordinator_to_app(CoordinatorToApp::Plan(plan()))),
    ("coordinator_to_app", "valid-welcome", || {
        coordinator_to_app(CoordinatorToApp::Welcome {
            app: AppId(7),
            incarnation: AppIncarnation(1),
            epoch: Epoch(3),
            liveness: Liveness::default(),
        })
    }),
    ("coordinator_to_app", "valid-failed", || {
        let failure = JobFailure::DeviceLost("gone".to_owned());
        coordinator_to_app(CoordinatorToApp::JobFailed { job: attempt(1).job, failure })
    }),
    ("coordinator_to_app", "valid-stopped", || {
        coordinator_to_app(CoordinatorToApp::Stopped { reason: "8 in a row".to_owned() })
    }),
    ("node_to_coordinator", "valid-hello", || {
        node_to_coordinator(NodeToCoordinator::Hello(NodeHello {
            protocol: 3,
            name: "n1".to_owned(),
            node: Some(NodeId(4)),
            session: NodeSession(99),
            devices: vec![device()],
            contact: contact(),
            inventory: attempts(3),
        }))
    }),
    ("node_to_coordinator", "valid-report", || node_to_coordinator(report())),
    ("node_to_coordinator", "valid-heartbeat", || {
        let running = Some(RunningJob { job: attempt(1), for_ns: 5_000 });
        let devices = vec![DeviceLoad { queued_jobs: 3, running }, DeviceLoad::default()];
        let heartbeat = NodeToCoordinator::Heartbeat {
            sequence: 9,
            unanswered: true,
            devices,
            spool_bytes: 1 << 20,
            cache: Some(cache()),
        };
        node_to_coordinator(heartbeat)
    }),
    ("node_to_coordinator", "valid-retracted", || {
        let [retracted, running, unknown] = [attempts(3), attempts(1), Vec::new()];
        node_to_coordinator(NodeToCoordinator::Retracted { steal: StealId(5), retracted, running, unknown })
    }),
    ("node_to_coordinator", "valid-cache", || {
        let (held, gone) = (
            vec![Content { hash: ContentHash([1; 32]), size_bytes: 5 << 20 }],
            vec![ContentHash([2; 32]); 3],
        );
        node_to_coordinator(NodeToCoordinator::CacheChanged { held, gone })
    }),
    ("node_to_coordinator", "valid-holding", || {
        node_to_coordinator(NodeToCoordinator::Holding(attempts(3).into_iter().collect()))
    }),
    ("node_to_coordinator", "valid-inventory", || {
        node_to_coordinator(NodeToCoordinator::Inventory(attempts(3)))
    }),
    ("coordinator_to_node", "valid-retract", || {
        coordinator_to_node(CoordinatorToNode::Retract { steal: StealId(5), jobs: attempts(6) })
    }),
    ("coordinator_to_node", "valid-located", || {
        coordinator_to_node(CoordinatorToNode::Located {
            content: ContentHash([3; 32]),
            peer: Some(contact()),
        })
    }),
    ("coordinator_to_node", "valid-evict", || {
        coordinator_to_node(CoordinatorToNode::Evict { contents: vec![ContentHash([3; 32]); 2] })
    }),
    ("farm_status", "valid-status", || control::encode::<v1::FarmStatus, _>(status())),
    ("timeline_head", "valid-head", || control::encode::<v1::TimelineHead, _>(head())),
    ("timeline_segments", "valid-segments", || control::encode::<v1::TimelineSegments, _>(&*segments())),
    ("plugin_question", "valid-question", || serde_json::to_vec(&question()).unwrap()),
    ("plugin_answer", "valid-answer", || {
        let choices = vec![Choice { job: 0, device: 1 }, Choice { job: 1, device: 0 }];
        serde_json::to_vec(&Ok::<_, String>(choices)).unwrap()
    }),
    ("plugin_answer", "valid-refusal", || {
        serde_json::to_vec(&Err::<Vec<Choice>, _>("no \u{1f600}")).unwrap()
    }),
    ("join_token", "valid-token", || {
        format!(" {}\n", JoinToken { secret: [0xa5; 16], authority: [7; 32] }).into_bytes()
    }),
    ("principal", "valid-principal", || holder().to_string().into_bytes()),
    // Two rounds: the others read these.
    ("authority_file", "valid-authority", || {
        Folder::new_file(|path| Authority::create("hostile").unwrap().write(path).unwrap())
    }),
    ("identity_file", "valid-node", || {
        let node = authority().identity(Role::Node, "n", LIFETIME).unwrap();
        Folder::new_file(|path| node.write(path).unwrap())
    }),
    ("certificate", "valid-app", || {
        let request = NewKey::generate().unwrap().request().unwrap();
        authority().admit(Role::App, "a", &request, LIFETIME).unwrap().certificate_der
    }),
    ("membership", "valid-renewal", || {
        authority().admit(Role::Node, "n", &node().request().unwrap(), LIFETIME).unwrap().certificate_der
    }),
    ("membership", "valid-authority", || {
        authority().admit(Role::Node, "n", &node().request().unwrap(), LIFETIME).unwrap().authority_der
    }),
    ("signing_request", "valid-request", || NewKey::generate().unwrap().request().unwrap()),
    ("capability", "valid-capability", || {
        let coordinator = authority().identity(Role::Coordinator, "coordinator", LIFETIME).unwrap();
        let capability = Capability {
            app: AppId(7),
            incarnation: AppIncarnation(2),
            holder: holder(),
            project: "default".to_owned(),
            epoch: Epoch(3),
            expires: now() + Duration::from_secs(3_600),
        };
        capability.sign(&coordinator).unwrap()
    }),
    ("control_store", "valid-new", || {
        let folder = Folder::new();
        coordinator::check_state(folder.path()).unwrap();
        packed(&folder.read("control.redb"))
    }),
    ("control_store", "valid-secured", || {
        let folder = Folder::new();
        coordinator::initialise(folder.path(), "hostile", "o").unwrap();
        packed(&folder.read("control.redb"))
    }),
    ("epoch_file", "valid-epoch", || b"41\n".to_vec()),
    ("saved_sums", "valid-sums", || {
        let alignment = alignment();
        let reference = Reference::new(&alignment).unwrap();
        let sums = NullModel::new(&reference, SEED, ShuffleKind::Feistel).run(4..9).unwrap();
        let mut bytes = saved::save(&alignment, SEED, &sums);
        bytes.truncate(bytes.len() - 32);
        bytes
    }),
    ("mi_result", "valid-reduced", || {
        let alignment = alignment();
        let reference = Reference::new(&alignment).unwrap();
        let sums = NullModel::new(&reference, SEED, ShuffleKind::Feistel).run(4..9).unwrap();
        let maxima: Vec<u8> =
            sums.maxima().values().flat_map(|x| (x.cast_unsigned() ^ (1 << 31)).to_le_bytes()).collect();
        let sections = [
            sums.sum().iter().flat_map(|x| x.to_le_bytes()).collect(),
            sums.sum_of_squares().iter().flat_map(|x| x.to_le_bytes()).collect(),
            sums.at_least_observed().iter().flat_map(|x| x.to_le_bytes()).collect(),
            maxima,
        ];
        result(0, &sections)
    }),
    ("mi_result", "valid-matrix", || result(1, &[1, 2, 3, 4, 5].map(|tag| [tag, 0, 0, 0].repeat(3)))),
    ("mi_result", "valid-observed", || result(2, &[vec![1; 12]])),
    ("render_result", "valid-tile", || result(0, &[vec![1; 128], vec![2; 192], vec![0; 32]])),
    ("render_result", "valid-light", || result(1, &[vec![1; 48], vec![0; 32]])),
    ("device_spec", "valid-sim", || b"sim:score=2.5,speed=0.125".to_vec()),
    ("device_spec", "valid-gpu", || b"gpu:12".to_vec()),
];

fn result(kind: u8, sections: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = vec![kind];
    for section in sections {
        bytes.push(u8::try_from(section.len() / 4).unwrap());
        bytes.extend(section);
    }
    bytes
}

fn attempt(index: u32) -> JobAttempt {
    JobAttempt {
        job: JobId { app: AppId(7), task: TaskId(index / 3), index: JobIndex(index) },
        attempt: Attempt { epoch: Epoch(3), sequence: u64::from(index) << 33 },
    }
}

fn attempts(count: u32) -> Vec<JobAttempt> {
    (0..count).map(attempt).collect()
}

fn content(tag: u8) -> Content {
    Content { hash: ContentHash([tag; 32]), size_bytes: u64::from(tag) << 20 }
}

fn contact() -> Contact {
    Contact {
        addresses: vec!["127.0.0.1:7000".to_owned(), "[::1]:7000".to_owned()],
        certificate_der: vec![0x30, 0x82, 1, 2],
    }
}

fn limits() -> Limits {
    Limits {
        memory_bytes: 8 << 30,
        buffer_bytes: 1 << 30,
        binding_bytes: 128 << 20,
        storage_buffers: 8,
        workgroup_memory_bytes: 32 << 10,
        workgroup_invocations: 256,
    }
}

fn device() -> DeviceInfo {
    let (name, kind, features) = ("lavapipe".to_owned(), DeviceKind::Cpu, Features(1));
    DeviceInfo { name, kind, score: 12.5, features, limits: limits() }
}

/// A program with every command.
fn program() -> JobProgram {
    let mut program = JobProgram::default();
    let buffer = program.malloc(1_024).unwrap();
    let input = program.task_allocation(content(2));
    let kernel = program.function_with_constants(content(1), "main", &[("tile", 8.5)]);
    program.memcpy_htod(kernel, "camera", &[1; 16]).unwrap();
    program.memcpy_htod_buffer(buffer, 4, &[2; 64]).unwrap();
    program.param_in(kernel, 0, input).unwrap();
    program.param(kernel, 1, buffer, 256, 512, Access::InOut).unwrap();
    let slicing = Slicing { global: "first_z".to_owned(), max_groups_z: 4 };
    program.launch_sliced(kernel, [3, 2, 8], slicing, CostNs(1 << 40)).unwrap();
    program.memcpy_dtoh(buffer, 0, 1_024).unwrap();
    program
}

fn frames_to_node() -> Vec<u8> {
    let encoded = codec::encode_program(&program()).unwrap();
    let ticket = |index| JobTicket {
        job: attempt(index),
        device: DeviceIndex(1),
        class: LatencyClass::Interactive,
        priority: Priority(-5),
        cost: CostNs(1 << 33),
        contents: vec![content(1), content(2)],
    };
    let hello = AppToNode::Hello { protocol: 3, app: AppId(7), incarnation: AppIncarnation(1) };
    let jobs = AppToNode::Jobs(vec![ticket(1), ticket(2)]);
    let acks = AppToNode::Acks(vec![ResultAck { job: attempt(1), digest: ContentHash([9; 32]) }]);
    let frames = [
        link::encode_frame(&hello, &[]).unwrap(),
        link::encode_frame(&jobs, &codec::pack_programs([&encoded, &encoded])).unwrap(),
        link::encode_frame(&acks, &[]).unwrap(),
        link::encode_frame(&AppToNode::Cancel(attempts(3)), &[]).unwrap(),
        link::encode_frame(&AppToNode::Holding(attempts(3).into_iter().collect()), &[]).unwrap(),
    ];
    frames.concat()
}

fn frames_to_app() -> Vec<u8> {
    let result = |outcome| {
        NodeToApp::Result(ResultHeader {
            job: attempt(1),
            device: DeviceIndex(0),
            device_time_ns: 1 << 30,
            outcome,
            digest: ContentHash([9; 32]),
        })
    };
    let frames = [
        link::encode_frame(&result(Ok(vec![4, 8])), &[vec![1; 12].into()]).unwrap(),
        link::encode_frame(&result(Err(JobFailure::Poison("twice".to_owned()))), &[]).unwrap(),
        link::encode_frame(&NodeToApp::Refused { reason: "no".to_owned() }, &[]).unwrap(),
        link::encode_frame(&NodeToApp::Inventory(attempts(3)), &[]).unwrap(),
    ];
    frames.concat()
}

fn app_to_coordinator(message: AppToCoordinator) -> Vec<u8> {
    control::encode::<v1::AppToCoordinator, _>(message)
}

fn coordinator_to_app(message: CoordinatorToApp) -> Vec<u8> {
    control::encode::<v1::CoordinatorToApp, _>(message)
}

fn node_to_coordinator(message: NodeToCoordinator) -> Vec<u8> {
    control::encode::<v1::NodeToCoordinator, _>(message)
}

fn coordinator_to_node(message: CoordinatorToNode) -> Vec<u8> {
    control::encode::<v1::CoordinatorToNode, _>(message)
}

fn plan_request() -> PlanRequest {
    let held = |index| HeldJob {
        index: JobIndex(index),
        session: NodeSession(99),
        device: DeviceIndex(1),
        attempt: attempt(index).attempt,
    };
    PlanRequest {
        batch: BatchId(1),
        task: TaskId(2),
        jobs: (0..5)
            .map(|index| PlanJob { index: JobIndex(index * 7), cost: CostNs(u64::from(index)) })
            .collect(),
        needs: Requirements {
            features: Features(1),
            limits: limits(),
            simulated: SimulatedDevices::Accepted,
        },
        module: Some(ContentHash([4; 32])),
        contents: vec![content(1), content(2)],
        held: vec![held(7), held(14)],
    }
}

fn plan() -> Plan {
    let devices = vec![
        DevicePlan { device: DeviceIndex(0), jobs: attempts(5) },
        DevicePlan { device: DeviceIndex(1), jobs: Vec::new() },
    ];
    let node = NodePlan { node: NodeId(4), session: NodeSession(99), contact: contact(), devices };
    Plan { batch: Some(BatchId(1)), speculative: false, nodes: vec![node] }
}

fn report() -> NodeToCoordinator {
    let executed = |index: u32| Executed {
        job: attempt(index),
        device: DeviceIndex(0),
        device_time_ns: 1 << 20,
        trace: JobTrace {
            staged_at: Instant(1_000),
            started_at: Instant(2_000),
            ended_at: Instant(3_000),
            stolen_from: (index == 1).then_some(DeviceIndex(1)),
        },
        failure: (index == 2).then_some(JobFailure::Timeout),
    };
    NodeToCoordinator::Report {
        sent_at: Instant(9_000),
        executed: (0..4).map(executed).collect(),
        delivered: attempts(2),
    }
}

fn cache() -> CacheFigures {
    CacheFigures { memory_contents: 2, memory_bytes: 5 << 20, fetches: 3, ..CacheFigures::default() }
}

fn status() -> FarmStatus {
    let device = DeviceStatus {
        device: DeviceIndex(0),
        name: "lavapipe".to_owned(),
        kind: DeviceKind::Cpu,
        score: 12.5,
        planned_jobs: 3,
        running_jobs: 1,
        executed_jobs: 5,
        device_time_ns: 1 << 40,
        lost: true,
    };
    let node = NodeStatus {
        node: NodeId(4),
        name: "n1".to_owned(),
        state: NodeState::Draining,
        addresses: contact().addresses,
        devices: vec![device],
        cache: cache(),
    };
    let app = AppStatus {
        app: AppId(7),
        name: "render".to_owned(),
        project: "films".to_owned(),
        weight: 1.0,
        connected: true,
        waiting_jobs: 1,
        outstanding_jobs: 2,
        delivered_jobs: 3,
        device_time_ns: 4,
    };
    let project = ProjectStatus {
        project: "films".to_owned(),
        quota: Quota { devices: Some(4), weight: Some(2.0), ..Quota::default() },
        apps: 1,
        devices: 1,
        queued_jobs: 2,
        waiting_jobs: 1,
        bytes: 5 << 20,
        weight: 1.0,
    };
    FarmStatus {
        epoch: Epoch(3),
        nodes: vec![node],
        apps: vec![app],
        projects: vec![project],
        delivered_jobs: 3,
        replanned_jobs: 1,
        stolen_jobs: 1,
        speculations: 0,
        policy_fallbacks: 0,
        standbys: vec!["process 7 of two".to_owned()],
    }
}

fn head() -> TimelineHead {
    let devices = vec!["lavapipe".to_owned()];
    TimelineHead {
        nodes: vec![TimelineNode { node: NodeId(4), name: "n1".to_owned(), devices }],
        apps: vec![TimelineApp { app: AppId(7), name: "render".to_owned(), tasks: vec![(TaskId(1), 5)] }],
        dropped_segments: 1,
        omitted_segments: 2,
    }
}

fn segments() -> Vec<Segment> {
    let segment = |index: u32| Segment {
        job: attempt(index),
        node: NodeId(4),
        device: DeviceIndex(0),
        scheduled_at: Instant(u64::from(index) * 1_000),
        staged_at: Instant(u64::from(index) * 1_000 + 10),
        started_at: Instant(u64::from(index) * 1_000 + 20),
        ended_at: Instant(u64::from(index) * 1_000 + 30),
        device_time_ns: 10,
        outcome: if index == 2 { Outcome::Failed } else { Outcome::Completed },
        migration: match index {
            0 => Some(Migration::Local { device: DeviceIndex(1) }),
            3 => Some(Migration::Global { node: NodeId(5), device: DeviceIndex(2) }),
            _ => None,
        },
    };
    (0..5).map(segment).collect()
}

fn question() -> Question {
    let device = |index| QuestionDevice {
        node: NodeId(4),
        device: DeviceIndex(index),
        free_at_ns: 1e9,
        time_per_load: 0.5,
        ready_at_ns: 0.0,
    };
    let job =
        |index| QuestionJob { index: JobIndex(index), load: 1.5, avoid: (index == 1).then_some(NodeId(4)) };
    Question {
        app: AppId(7),
        task: TaskId(1),
        jobs: (0..3).map(job).collect(),
        devices: (0..2).map(device).collect(),
    }
}
