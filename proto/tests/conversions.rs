//! Every message of the control plane survives its way over the wire, and what is not allowed is refused by field.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::fmt;

use farm_core::{
    coordinator::{
        AppStatus, ContentStatus, ContentsStatus, DeviceStatus, FarmStatus, NodeState, NodeStatus,
        ProjectStatus,
        timeline::{Migration, Outcome, Segment, TimelineApp, TimelineHead, TimelineNode},
    },
    device::{DeviceInfo, DeviceKind, Features, Limits, Requirements, SimulatedDevices},
    id::{
        AppId, AppIncarnation, Attempt, BatchId, ContentHash, DeviceIndex, Epoch, JobAttempt, JobId,
        JobIndex, NodeId, NodeSession, StealId, TaskId,
    },
    message::{
        AppHello, AppToCoordinator, CacheFigures, Contact, CoordinatorToApp, CoordinatorToNode, CostNs,
        DeviceLoad, DevicePlan, Executed, HeldJob, JobFailure, JobTrace, Liveness, NodeHello, NodePlan,
        NodeToCoordinator, Plan, PlanJob, PlanRequest, RunningJob, WaitReason,
    },
    program::Content,
    project::{AppTerms, Quota},
    time::Instant,
};
use proptest::{collection::vec, option, prelude::*};
use prost::Message;
use proto::control::{MAX_TEXT_BYTES, WireError, v1};

/// Out, over bytes, and in again.
fn over_the_wire<D, W>(message: D) -> D
where
    W: From<D> + Message + Default,
    D: TryFrom<W>,
    <D as TryFrom<W>>::Error: fmt::Debug,
{
    let bytes = W::from(message).encode_to_vec();
    D::try_from(W::decode(bytes.as_slice()).unwrap()).unwrap()
}

fn attempts() -> impl Strategy<Value = Vec<JobAttempt>> {
    // Few applications and tasks, so that runs form; any index and sequence, so that differences go both ways.
    let attempt = (0_u64..3, 0_u32..2, prop_oneof![0_u32..50, any::<u32>()], 1_u32..3, any::<u64>());
    vec(attempt, 0..40).prop_map(|attempts| {
        let attempts = attempts.into_iter().map(|(app, task, index, epoch, sequence)| JobAttempt {
            job: JobId { app: AppId(app), task: TaskId(task), index: JobIndex(index) },
            attempt: Attempt { epoch: Epoch(epoch), sequence },
        });
        attempts.collect()
    })
}

fn jobs() -> impl Strategy<Value = Vec<JobId>> {
    attempts().prop_map(|attempts| attempts.into_iter().map(|attempt| attempt.job).collect())
}

fn positive() -> impl Strategy<Value = f64> {
    f64::MIN_POSITIVE..f64::MAX
}

fn limits() -> impl Strategy<Value = Limits> {
    (any::<[u64; 3]>(), any::<[u32; 3]>()).prop_map(|(wide, narrow)| Limits {
        memory_bytes: wide[0],
        buffer_bytes: wide[1],
        binding_bytes: wide[2],
        storage_buffers: narrow[0],
        workgroup_memory_bytes: narrow[1],
        workgroup_invocations: narrow[2],
    })
}

fn kind() -> impl Strategy<Value = DeviceKind> {
    prop::sample::select(vec![DeviceKind::Gpu, DeviceKind::Cpu, DeviceKind::Simulated])
}

fn device_info() -> impl Strategy<Value = DeviceInfo> {
    ("\\PC{0,40}", kind(), 0.0..f64::MAX, any::<u32>(), limits()).prop_map(
        |(name, kind, score, features, limits)| DeviceInfo {
            name,
            kind,
            score,
            features: Features(features),
            limits,
        },
    )
}

fn requirements() -> impl Strategy<Value = Requirements> {
    (any::<u32>(), limits(), any::<bool>()).prop_map(|(features, limits, simulated)| Requirements {
        features: Features(features),
        limits,
        simulated: if simulated { SimulatedDevices::Accepted } else { SimulatedDevices::Refused },
    })
}

fn contact() -> impl Strategy<Value = Contact> {
    (vec("[a-z0-9.:]{1,30}", 0..4), vec(any::<u8>(), 0..600))
        .prop_map(|(addresses, certificate_der)| Contact { addresses, certificate_der })
}

fn liveness() -> impl Strategy<Value = Liveness> {
    any::<[u64; 5]>().prop_map(|ms| Liveness {
        heartbeat_ms: ms[0],
        suspect_ms: ms[1],
        dead_ms: ms[2],
        reconnect_ms: ms[3],
        compare_ms: ms[4],
    })
}

fn content() -> impl Strategy<Value = Content> {
    any::<([u8; 32], u64)>().prop_map(|(hash, size_bytes)| Content { hash: ContentHash(hash), size_bytes })
}

fn contents() -> impl Strategy<Value = Vec<Content>> {
    vec(content(), 0..5)
}

fn failure() -> impl Strategy<Value = JobFailure> {
    prop_oneof![
        "\\PC{0,80}".prop_map(JobFailure::InvalidProgram),
        Just(JobFailure::Timeout),
        "\\PC{0,80}".prop_map(JobFailure::DeviceLost),
        "\\PC{0,80}".prop_map(JobFailure::OutOfMemory),
        any::<[u8; 32]>().prop_map(|hash| JobFailure::ContentUnavailable(ContentHash(hash))),
        "\\PC{0,80}".prop_map(JobFailure::Poison),
        "\\PC{0,80}".prop_map(JobFailure::PoisonApplication),
        "\\PC{0,80}".prop_map(JobFailure::OverQuota),
        Just(JobFailure::Cancelled),
        Just(JobFailure::Returned),
    ]
}

fn app_to_coordinator() -> impl Strategy<Value = AppToCoordinator> {
    let names = ("\\PC{0,40}", "\\PC{0,40}");
    let hello = (any::<(u32, bool)>(), names, positive(), option::of(any::<(u64, u32)>())).prop_map(
        |((protocol, global_stealing), (name, policy), weight, resume)| {
            let resume = resume.map(|(app, life)| (AppId(app), AppIncarnation(life)));
            AppToCoordinator::Hello(AppHello { protocol, name, weight, global_stealing, policy, resume })
        },
    );
    let job = |cost: BoxedStrategy<u64>| {
        (prop_oneof![0_u32..50, any::<u32>()], cost)
            .prop_map(|(index, cost)| PlanJob { index: JobIndex(index), cost: CostNs(cost) })
    };
    let jobs_of = prop_oneof![
        vec(job(Just(0).boxed()), 0..40),
        vec(job(Just(7_000_000).boxed()), 0..40),
        vec(job(any::<u64>().boxed()), 0..40),
    ];
    let module = option::of(any::<[u8; 32]>().prop_map(ContentHash));
    let held = vec((0_u64..3, 0_u16..3, 0_u32..2, any::<(u32, u64)>()), 0..40).prop_map(|mut held| {
        // The wire groups them.
        held.sort_by_key(|&(session, device, epoch, _)| (session, device, epoch));
        let job = |(session, device, epoch, (index, sequence))| HeldJob {
            index: JobIndex(index),
            session: NodeSession(session),
            device: DeviceIndex(device),
            attempt: Attempt { epoch: Epoch(epoch), sequence },
        };
        held.into_iter().map(job).collect::<Vec<HeldJob>>()
    });
    let plan = (any::<(u64, u32)>(), jobs_of, requirements(), module, contents(), held).prop_map(
        |((batch, task), jobs, needs, module, contents, held)| {
            let (batch, task) = (BatchId(batch), TaskId(task));
            AppToCoordinator::Plan(PlanRequest { batch, task, jobs, needs, module, contents, held })
        },
    );
    prop_oneof![
        hello,
        plan,
        jobs().prop_map(AppToCoordinator::AlreadyDelivered),
        any::<(u64, u64)>().prop_map(|(node, session)| AppToCoordinator::Unreachable {
            node: NodeId(node),
            session: NodeSession(session)
        }),
        any::<u32>().prop_map(|task| AppToCoordinator::Cancel(TaskId(task))),
        any::<u64>().prop_map(|app| AppToCoordinator::Supersede(AppId(app))),
        any::<(u64, bool)>()
            .prop_map(|(sequence, unanswered)| AppToCoordinator::Heartbeat { sequence, unanswered }),
        Just(AppToCoordinator::Goodbye),
    ]
}

fn coordinator_to_app() -> impl Strategy<Value = CoordinatorToApp> {
    let device_plan = (any::<u16>(), attempts())
        .prop_map(|(device, jobs)| DevicePlan { device: DeviceIndex(device), jobs });
    let node_plan = (any::<(u64, u64)>(), contact(), vec(device_plan, 0..4)).prop_map(
        |((node, session), contact, devices)| NodePlan {
            node: NodeId(node),
            session: NodeSession(session),
            contact,
            devices,
        },
    );
    let plan = (option::of(any::<u64>()), any::<bool>(), vec(node_plan, 0..4)).prop_map(
        |(batch, speculative, nodes)| {
            CoordinatorToApp::Plan(Plan { batch: batch.map(BatchId), speculative, nodes })
        },
    );
    let reason =
        prop::sample::select(vec![WaitReason::NoNode, WaitReason::NoFittingDevice, WaitReason::OverQuota]);
    prop_oneof![
        (any::<(u64, u32, u32)>(), liveness()).prop_map(|((app, life, epoch), liveness)| {
            CoordinatorToApp::Welcome {
                app: AppId(app),
                incarnation: AppIncarnation(life),
                epoch: Epoch(epoch),
                liveness,
            }
        }),
        "\\PC{0,80}".prop_map(|reason| CoordinatorToApp::Refused { reason }),
        plan,
        (any::<u64>(), reason)
            .prop_map(|(batch, reason)| CoordinatorToApp::Waiting { batch: BatchId(batch), reason }),
        (any::<(u64, u32, u32)>(), failure()).prop_map(|((app, task, index), failure)| {
            let job = JobId { app: AppId(app), task: TaskId(task), index: JobIndex(index) };
            CoordinatorToApp::JobFailed { job, failure }
        }),
        "\\PC{0,80}".prop_map(|reason| CoordinatorToApp::Stopped { reason }),
        any::<u64>().prop_map(|sequence| CoordinatorToApp::HeartbeatAck { sequence }),
        vec(any::<u8>(), 0..80).prop_map(CoordinatorToApp::Capability),
    ]
}

/// When the reports leave; traces are of before.
const SENT_AT: Instant = Instant(1 << 50);

fn trace() -> impl Strategy<Value = JobTrace> {
    let at = || (0..=SENT_AT.0).prop_map(Instant);
    (at(), at(), at(), option::of((0..u16::MAX).prop_map(DeviceIndex))).prop_map(
        |(staged_at, started_at, ended_at, stolen_from)| JobTrace {
            staged_at,
            started_at,
            ended_at,
            stolen_from,
        },
    )
}

fn node_to_coordinator() -> impl Strategy<Value = NodeToCoordinator> {
    let identity = (any::<(u32, u64)>(), option::of(any::<u64>()));
    let hello = (identity, "\\PC{0,40}", vec(device_info(), 0..5), contact(), attempts()).prop_map(
        |(((protocol, session), node), name, devices, contact, inventory)| {
            let (session, node) = (NodeSession(session), node.map(NodeId));
            NodeToCoordinator::Hello(NodeHello { protocol, name, node, session, devices, contact, inventory })
        },
    );
    let running = (attempts(), any::<u64>())
        .prop_map(|(jobs, for_ns)| jobs.first().map(|&job| RunningJob { job, for_ns }));
    let load = (any::<u32>(), running).prop_map(|(queued_jobs, running)| DeviceLoad { queued_jobs, running });
    let outcome = (any::<(u16, u64)>(), trace(), option::of(failure()));
    let executed = (attempts(), vec(outcome, 40)).prop_map(|(attempts, outcomes)| {
        let executed =
            attempts.into_iter().zip(outcomes).map(|(job, ((device, device_time_ns), trace, failure))| {
                Executed { job, device: DeviceIndex(device), device_time_ns, trace, failure }
            });
        executed.collect::<Vec<_>>()
    });
    prop_oneof![
        hello,
        (any::<(u64, bool, u64)>(), vec(load, 0..9), option::of(cache())).prop_map(
            |((sequence, unanswered, spool_bytes), devices, cache)| {
                NodeToCoordinator::Heartbeat { sequence, unanswered, devices, spool_bytes, cache }
            }
        ),
        (vec(content(), 0..9), vec(content(), 0..9)).prop_map(|(held, gone)| {
            let gone = gone.into_iter().map(|content| content.hash).collect();
            NodeToCoordinator::CacheChanged { held, gone }
        }),
        content().prop_map(NodeToCoordinator::Locate),
        (executed, attempts()).prop_map(|(executed, delivered)| NodeToCoordinator::Report {
            sent_at: SENT_AT,
            executed,
            delivered
        }),
        (any::<u16>(), "\\PC{0,80}").prop_map(|(device, reason)| NodeToCoordinator::DeviceLost {
            device: DeviceIndex(device),
            reason
        }),
        (any::<u64>(), attempts(), attempts(), attempts()).prop_map(
            |(steal, retracted, running, unknown)| NodeToCoordinator::Retracted {
                steal: StealId(steal),
                retracted,
                running,
                unknown
            }
        ),
        Just(NodeToCoordinator::Goodbye),
        attempts().prop_map(|held| NodeToCoordinator::Holding(held.into_iter().collect())),
        attempts().prop_map(NodeToCoordinator::Inventory),
    ]
}

fn cache() -> impl Strategy<Value = CacheFigures> {
    any::<[u64; 10]>().prop_map(|counts| CacheFigures {
        memory_contents: counts[0],
        memory_bytes: counts[1],
        disk_contents: counts[2],
        disk_bytes: counts[3],
        memory_hits: counts[4],
        disk_hits: counts[5],
        fetches: counts[6],
        fetched_bytes: counts[7],
        memory_evictions: counts[8],
        disk_evictions: counts[9],
    })
}

fn contents_status() -> impl Strategy<Value = ContentsStatus> {
    let held = (content(), vec(any::<u64>(), 0..5)).prop_map(|(content, nodes)| ContentStatus {
        content,
        nodes: nodes.into_iter().map(NodeId).collect(),
    });
    (vec(held, 0..9), any::<u64>()).prop_map(|(contents, omitted)| ContentsStatus { contents, omitted })
}

fn coordinator_to_node() -> impl Strategy<Value = CoordinatorToNode> {
    prop_oneof![
        (any::<(u64, u32)>(), liveness()).prop_map(|((node, epoch), liveness)| CoordinatorToNode::Welcome {
            node: NodeId(node),
            epoch: Epoch(epoch),
            liveness
        }),
        "\\PC{0,80}".prop_map(|reason| CoordinatorToNode::Refused { reason }),
        Just(CoordinatorToNode::SayInventory),
        vec((any::<u64>(), positive(), "\\PC{0,20}", any::<(Option<u64>, bool)>()), 0..5).prop_map(|apps| {
            let apps = apps.into_iter().map(|(app, weight, project, (result_bytes, stays))| {
                (AppId(app), AppTerms { weight, project, result_bytes, stays })
            });
            CoordinatorToNode::AppsJoined(apps.collect())
        }),
        any::<u64>().prop_map(|app| CoordinatorToNode::AppLeft { app: AppId(app) }),
        attempts().prop_map(|jobs| CoordinatorToNode::Cancel { jobs }),
        (any::<u64>(), attempts())
            .prop_map(|(steal, jobs)| CoordinatorToNode::Retract { steal: StealId(steal), jobs }),
        vec(content(), 0..9).prop_map(|contents| CoordinatorToNode::Evict {
            contents: contents.into_iter().map(|content| content.hash).collect()
        }),
        Just(CoordinatorToNode::Drain),
        any::<u64>().prop_map(|sequence| CoordinatorToNode::HeartbeatAck { sequence }),
    ]
}

fn quota() -> impl Strategy<Value = Quota> {
    (any::<(Option<u32>, Option<u64>, Option<u64>)>(), option::of(positive()))
        .prop_map(|((devices, queued_jobs, bytes), weight)| Quota { devices, queued_jobs, bytes, weight })
}

fn farm_status() -> impl Strategy<Value = FarmStatus> {
    let device = (any::<u16>(), "\\PC{0,20}", kind(), 0.0..f64::MAX, any::<([u64; 3], u32)>()).prop_map(
        |(device, name, kind, score, (counts, running_jobs))| DeviceStatus {
            device: DeviceIndex(device),
            name,
            kind,
            score,
            planned_jobs: counts[0],
            running_jobs,
            executed_jobs: counts[1],
            device_time_ns: counts[2],
            lost: counts[0].is_multiple_of(2),
        },
    );
    let state = prop::sample::select(vec![NodeState::Alive, NodeState::Suspect, NodeState::Draining]);
    let node = (any::<u64>(), "\\PC{0,20}", state, vec("[a-z0-9.:]{1,30}", 0..3), vec(device, 0..4), cache())
        .prop_map(|(node, name, state, addresses, devices, cache)| NodeStatus {
            node: NodeId(node),
            name,
            state,
            addresses,
            devices,
            cache,
        });
    let app = (any::<(u64, bool, [u64; 4])>(), "\\PC{0,20}", "[a-z]{1,9}", positive()).prop_map(
        |((app, connected, counts), name, project, weight)| AppStatus {
            app: AppId(app),
            name,
            project,
            weight,
            connected,
            waiting_jobs: counts[0],
            outstanding_jobs: counts[1],
            delivered_jobs: counts[2],
            device_time_ns: counts[3],
        },
    );
    let project = ("[a-z]{1,9}", quota(), any::<[u64; 5]>(), 0.0..f64::MAX).prop_map(
        |(project, quota, counts, weight)| ProjectStatus {
            project,
            quota,
            apps: counts[0],
            devices: counts[1],
            queued_jobs: counts[2],
            waiting_jobs: counts[3],
            bytes: counts[4],
            weight,
        },
    );
    let parts = (vec(node, 0..4), vec(app, 0..4), vec(project, 0..4));
    let standbys = vec("[a-z0-9 ]{1,40}", 0..3);
    (any::<(u32, [u64; 5])>(), parts, standbys).prop_map(|((epoch, counts), parts, standbys)| FarmStatus {
        standbys,
        projects: parts.2,
        epoch: Epoch(epoch),
        nodes: parts.0,
        apps: parts.1,
        delivered_jobs: counts[0],
        replanned_jobs: counts[1],
        stolen_jobs: counts[2],
        speculations: counts[3],
        policy_fallbacks: counts[4],
    })
}

fn segments() -> impl Strategy<Value = Vec<Segment>> {
    let from = any::<u16>().prop_map(DeviceIndex);
    let migration = option::of(prop_oneof![
        from.clone().prop_map(|device| Migration::Local { device }),
        (any::<u64>(), from).prop_map(|(node, device)| Migration::Global { node: NodeId(node), device }),
    ]);
    let outcome = prop::sample::select(vec![Outcome::Completed, Outcome::Failed]);
    let rest = (any::<(u64, u16, [u64; 5])>(), outcome, migration);
    (attempts(), vec(rest, 40)).prop_map(|(jobs, rest)| {
        let segments =
            jobs.into_iter().zip(rest).map(|(job, ((node, device, times), outcome, migration))| Segment {
                job,
                node: NodeId(node),
                device: DeviceIndex(device),
                scheduled_at: Instant(times[0]),
                staged_at: Instant(times[1]),
                started_at: Instant(times[2]),
                ended_at: Instant(times[3]),
                device_time_ns: times[4],
                outcome,
                migration,
            });
        segments.collect()
    })
}

fn timeline_head() -> impl Strategy<Value = TimelineHead> {
    let node = (any::<u64>(), "\\PC{0,20}", vec("\\PC{0,20}", 0..4))
        .prop_map(|(node, name, devices)| TimelineNode { node: NodeId(node), name, devices });
    let app = (any::<u64>(), "\\PC{0,20}", vec(any::<(u32, u64)>(), 0..4)).prop_map(|(app, name, tasks)| {
        let tasks = tasks.into_iter().map(|(task, count)| (TaskId(task), count)).collect();
        TimelineApp { app: AppId(app), name, tasks }
    });
    (vec(node, 0..4), vec(app, 0..4), any::<(u64, u64)>()).prop_map(
        |(nodes, apps, (dropped_segments, omitted_segments))| TimelineHead {
            nodes,
            apps,
            dropped_segments,
            omitted_segments,
        },
    )
}

proptest! {
    #[test]
    fn timelines_come_back(head in timeline_head(), segments in segments()) {
        prop_assert_eq!(over_the_wire::<_, v1::TimelineHead>(head.clone()), head);
        let bytes = v1::TimelineSegments::from(segments.as_slice()).encode_to_vec();
        let wire = v1::TimelineSegments::decode(bytes.as_slice()).unwrap();
        prop_assert_eq!(Vec::<Segment>::try_from(wire).unwrap(), segments);
    }

    #[test]
    fn app_to_coordinator_comes_back(message in app_to_coordinator()) {
        prop_assert_eq!(over_the_wire::<_, v1::AppToCoordinator>(message.clone()), message);
    }

    #[test]
    fn coordinator_to_app_comes_back(message in coordinator_to_app()) {
        prop_assert_eq!(over_the_wire::<_, v1::CoordinatorToApp>(message.clone()), message);
    }

    #[test]
    fn node_to_coordinator_comes_back(message in node_to_coordinator()) {
        prop_assert_eq!(over_the_wire::<_, v1::NodeToCoordinator>(message.clone()), message);
    }

    #[test]
    fn coordinator_to_node_comes_back(message in coordinator_to_node()) {
        prop_assert_eq!(over_the_wire::<_, v1::CoordinatorToNode>(message.clone()), message);
    }

    #[test]
    fn farm_status_comes_back(status in farm_status()) {
        prop_assert_eq!(over_the_wire::<_, v1::FarmStatus>(status.clone()), status);
    }

    #[test]
    fn contents_status_comes_back(status in contents_status()) {
        prop_assert_eq!(over_the_wire::<_, v1::ContentsStatus>(status.clone()), status);
    }

    #[test]
    fn any_bytes_give_an_answer(bytes in vec(any::<u8>(), 0..200)) {
        // Whatever the answers are, there are some.
        let _ = v1::AppToCoordinator::decode(&bytes[..]).map(AppToCoordinator::try_from);
        let _ = v1::CoordinatorToApp::decode(&bytes[..]).map(CoordinatorToApp::try_from);
        let _ = v1::NodeToCoordinator::decode(&bytes[..]).map(NodeToCoordinator::try_from);
        let _ = v1::CoordinatorToNode::decode(&bytes[..]).map(CoordinatorToNode::try_from);
        let _ = v1::TimelineHead::decode(&bytes[..]).map(TimelineHead::try_from);
        let _ = v1::TimelineSegments::decode(&bytes[..]).map(Vec::<Segment>::try_from);
        let _ = v1::FarmStatus::decode(&bytes[..]).map(FarmStatus::try_from);
        let _ = v1::ContentsStatus::decode(&bytes[..]).map(ContentsStatus::try_from);
    }

    #[test]
    fn a_flipped_byte_never_panics(message in coordinator_to_app(), at in any::<prop::sample::Index>(), byte in any::<u8>()) {
        let mut bytes = v1::CoordinatorToApp::from(message).encode_to_vec();
        if !bytes.is_empty() {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        let _ = v1::CoordinatorToApp::decode(&bytes[..]).map(CoordinatorToApp::try_from);
    }
}

fn field_of(error: &WireError) -> &'static str {
    match error {
        WireError::Missing { field }
        | WireError::Invalid { field, .. }
        | WireError::TooMany { field, .. } => field,
    }
}

fn report(change: impl FnOnce(&mut v1::Report)) -> Result<NodeToCoordinator, WireError> {
    let job = JobId { app: AppId(1), task: TaskId(1), index: JobIndex(1) };
    let job = JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence: 1 } };
    let done = Executed {
        job,
        device: DeviceIndex(0),
        device_time_ns: 5,
        trace: JobTrace::default(),
        failure: Some(JobFailure::Timeout),
    };
    let wire = v1::NodeToCoordinator::from(NodeToCoordinator::Report {
        sent_at: SENT_AT,
        executed: vec![done],
        delivered: vec![job],
    });
    let Some(v1::node_to_coordinator::Message::Report(mut report)) = wire.message else {
        panic!("another message")
    };
    change(&mut report);
    v1::NodeToCoordinator { message: Some(v1::node_to_coordinator::Message::Report(report)) }.try_into()
}

#[test]
fn what_is_not_allowed_is_refused_by_field() {
    let hello = |weight: f64, name: &str| {
        let hello = v1::AppHello {
            protocol: 1,
            name: name.to_owned(),
            weight,
            resume: None,
            global_stealing: false,
            policy: String::new(),
        };
        AppHello::try_from(hello).map(|_| ())
    };
    let plan = |index_deltas: Vec<i64>, cost_ns: Vec<u64>| {
        let needs = Some(Requirements::ANY.into());
        let request = v1::PlanRequest {
            batch: 1,
            task: 1,
            index_deltas,
            cost_ns,
            needs,
            contents: Vec::new(),
            held: Vec::new(),
            module: Vec::new(),
        };
        PlanRequest::try_from(request).map(|_| ())
    };
    let run = |index_deltas: Vec<i64>, sequence_deltas: Vec<i64>| {
        let run = v1::AttemptRun { app: 1, task: 1, epoch: 1, index_deltas, sequence_deltas };
        Vec::<JobAttempt>::try_from(v1::Attempts { runs: vec![run] }).map(|_| ())
    };
    let message = AppToCoordinator::try_from(v1::AppToCoordinator { message: None }).map(|_| ());
    let waiting = v1::coordinator_to_app::Message::Waiting(v1::Waiting { batch: 1, reason: 99 });
    let waiting = CoordinatorToApp::try_from(v1::CoordinatorToApp { message: Some(waiting) }).map(|_| ());
    let device = v1::DevicePlan { device: 65_536, jobs: Some(v1::Attempts::default()) };
    let kind = v1::DeviceInfo { limits: Some(Limits::NONE.into()), ..v1::DeviceInfo::default() };
    let hash = v1::Content { hash: vec![0; 31], size_bytes: 1 };
    let failure = v1::ExecutedFailure { position: 0, failure: Some(JobFailure::Timeout.into()) };
    let cases: Vec<(&str, Result<(), WireError>)> = vec![
        ("AppToCoordinator.message", message),
        ("AppHello.weight", hello(0.0, "a")),
        ("AppHello.weight", hello(f64::NAN, "a")),
        ("AppHello.weight", hello(f64::INFINITY, "a")),
        ("AppHello.name", hello(1.0, &"a".repeat(257))),
        ("PlanRequest.index_deltas", plan(vec![-1], vec![])),
        ("PlanRequest.index_deltas", plan(vec![1, i64::MAX], vec![])),
        ("PlanRequest.index_deltas", plan(vec![1 << 32], vec![])),
        ("PlanRequest.index_deltas", plan(vec![0; (1 << 20) + 1], vec![])),
        ("PlanRequest.cost_ns", plan(vec![1, 1, 1], vec![1, 2])),
        ("AttemptRun.sequence_deltas", run(vec![1, 1], vec![1])),
        ("AttemptRun.index_deltas", run(vec![i64::MIN], vec![1])),
        ("Attempts.runs", run(vec![0; (1 << 20) + 1], vec![0; (1 << 20) + 1])),
        ("Waiting.reason", waiting),
        ("DevicePlan.device", DevicePlan::try_from(device).map(|_| ())),
        ("DeviceInfo.kind", DeviceInfo::try_from(kind).map(|_| ())),
        ("Content.hash", Content::try_from(hash).map(|_| ())),
        ("Report.delivered", report(|report| report.delivered = None).map(|_| ())),
        ("Report.executed_devices", report(|report| report.executed_devices.clear()).map(|_| ())),
        (
            "Report.executed_device_time_ns",
            report(|report| report.executed_device_time_ns.push(1)).map(|_| ()),
        ),
        ("ExecutedFailure.position", report(|report| report.failures[0].position = 1).map(|_| ())),
        ("ExecutedFailure.position", report(|report| report.failures.push(failure)).map(|_| ())),
        ("ExecutedFailure.failure", report(|report| report.failures[0].failure = None).map(|_| ())),
    ];
    for (position, (field, outcome)) in cases.into_iter().enumerate() {
        assert_eq!(field_of(&outcome.unwrap_err()), field, "case {position}");
    }
    // Negative controls: the same builders with allowed values.
    assert_eq!(hello(1.0, "a"), Ok(()));
    assert_eq!(plan(vec![5, -5], vec![1, 2]), Ok(()));
    assert_eq!(run(vec![5, -5], vec![1, -1]), Ok(()));
    assert!(report(|_| {}).is_ok(), "an unchanged report is allowed");
}

#[test]
fn long_texts_for_people_are_cut_instead_of_refused() {
    // A three-byte letter across the cut.
    let reason = "€".repeat(MAX_TEXT_BYTES);
    let message = CoordinatorToNode::Refused { reason: reason.clone() };
    let CoordinatorToNode::Refused { reason: cut } = over_the_wire::<_, v1::CoordinatorToNode>(message)
    else {
        panic!("another message")
    };
    assert!(reason.starts_with(&cut), "the beginning is kept");
    assert!(cut.len() > MAX_TEXT_BYTES - 3 && cut.len() <= MAX_TEXT_BYTES, "{} B", cut.len());
}

#[test]
fn a_plan_of_4096_jobs_is_small() {
    let jobs = (0..4_096).map(|index| JobAttempt {
        job: JobId { app: AppId(17), task: TaskId(3), index: JobIndex(index) },
        attempt: Attempt { epoch: Epoch(2), sequence: 1_000_000 + u64::from(index) },
    });
    let contact = Contact { addresses: vec!["10.0.0.1:40000".to_owned()], certificate_der: vec![0; 400] };
    let node = NodePlan {
        node: NodeId(1),
        session: NodeSession(u64::MAX),
        contact,
        devices: vec![DevicePlan { device: DeviceIndex(0), jobs: jobs.collect() }],
    };
    let plan =
        CoordinatorToApp::Plan(Plan { batch: Some(BatchId(1)), speculative: false, nodes: vec![node] });
    let bytes = v1::CoordinatorToApp::from(plan).encoded_len();
    assert!(bytes < 9_000, "{bytes} B for 4,096 jobs");
    let request = PlanRequest {
        batch: BatchId(1),
        task: TaskId(3),
        jobs: (0..4_096).map(|index| PlanJob { index: JobIndex(index), cost: CostNs(1_000_000) }).collect(),
        needs: Requirements::ANY_REAL,
        module: None,
        contents: Vec::new(),
        held: Vec::new(),
    };
    let bytes = v1::PlanRequest::from(request).encoded_len();
    assert!(bytes < 4_200, "{bytes} B for 4,096 jobs");
}
