//! Peers of another version: scenario 33. Of bytes that are no message at all `proto/tests/conversions.rs` has the tests, of real
//! sessions `coordinator/tests/farm.rs`, of binaries of earlier commits `tests/upgrade.sh`.

use farm_core::{
    coordinator::{CoordinatorConfig, CoordinatorMachine, Effect, Event},
    device::{DeviceInfo, DeviceKind, Features, Limits},
    id::{AppId, AppIncarnation, Epoch, LinkId, NodeId, NodeSession},
    message::{
        AppHello, AppToCoordinator, AppToNode, Contact, CoordinatorToApp, CoordinatorToNode, Liveness,
        NodeHello, NodeToApp, NodeToCoordinator, PROTOCOL_VERSION,
    },
    time::Instant,
    worker::{self, Share, WorkerConfig, WorkerMachine},
};

use super::figures::{Bar, count};

fn device() -> DeviceInfo {
    DeviceInfo {
        name: "sim".to_owned(),
        kind: DeviceKind::Simulated,
        score: 1_000.0,
        features: Features::default(),
        limits: Limits::UNBOUNDED,
    }
}

fn contact() -> Contact {
    Contact { addresses: vec!["worker-0".to_owned()], certificate_der: Vec::new() }
}

/// Whether the reason names both versions, and the side to upgrade.
fn refuses(reason: &str, protocol: u32) -> bool {
    let older = if protocol < PROTOCOL_VERSION { "the refused side" } else { "the refusing side" };
    [&format!("version {protocol} "), &format!("version {PROTOCOL_VERSION} "), older]
        .iter()
        .all(|words| reason.contains(*words))
}

/// Whether a coordinator refuses a node and an application of this version, saying why, and keeps nothing of them.
fn coordinator_refuses(protocol: u32) -> bool {
    let mut machine = CoordinatorMachine::new(CoordinatorConfig::new(Epoch(1), 1));
    let node = NodeHello {
        protocol,
        name: "node".to_owned(),
        node: None,
        session: NodeSession(1),
        devices: vec![device()],
        contact: contact(),
        inventory: Vec::new(),
    };
    let app = AppHello {
        protocol,
        name: "app".to_owned(),
        weight: 1.0,
        global_stealing: false,
        policy: String::new(),
        resume: None,
    };
    let (node, app) = (NodeToCoordinator::Hello(node), AppToCoordinator::Hello(app));
    machine.handle(Instant::ZERO, Event::FromNode { link: LinkId(1), message: node });
    machine.handle(Instant::ZERO, Event::FromApp { link: LinkId(2), message: app });
    let (mut refused, mut closed) = (0, 0);
    while let Some(effect) = machine.poll_effect() {
        match effect {
            Effect::ToNode { message: CoordinatorToNode::Refused { reason }, .. }
            | Effect::ToApp { message: CoordinatorToApp::Refused { reason }, .. } => {
                refused += usize::from(refuses(&reason, protocol));
            }
            Effect::Close { .. } => closed += 1,
            _ => {}
        }
    }
    let status = machine.status();
    (refused, closed) == (2, 2) && status.nodes.is_empty() && status.apps.is_empty()
}

/// Whether a registered node refuses an application of this version, saying why, and keeps nothing of it.
fn node_refuses(protocol: u32) -> bool {
    let mut machine = WorkerMachine::new(WorkerConfig {
        name: "node".to_owned(),
        session: NodeSession(1),
        devices: vec![device()],
        contact: contact(),
        max_jobs: 10,
        spool_quota_bytes: 1 << 20,
        share: Share::DEFAULT,
        local_stealing: true,
        cached: Vec::new(),
        seed: 1,
    });
    let welcome =
        CoordinatorToNode::Welcome { node: NodeId(1), epoch: Epoch(1), liveness: Liveness::default() };
    let hello = AppToNode::Hello { protocol, app: AppId(1), incarnation: AppIncarnation(1) };
    machine.handle(Instant::ZERO, worker::Event::CoordinatorConnected);
    machine.handle(Instant::ZERO, worker::Event::FromCoordinator(welcome));
    machine.handle(Instant::ZERO, worker::Event::FromApp { link: LinkId(1), message: hello });
    let effects: Vec<worker::Effect> = std::iter::from_fn(|| machine.poll_effect()).collect();
    effects.iter().any(|effect| {
        matches!(effect, worker::Effect::ToApp { message: NodeToApp::Refused { reason }, .. }
            if refuses(reason, protocol))
    })
}

/// 33: a worker and an application of the version before, and after, meet a coordinator and a node of this one: each is refused
/// with an error that names the version, and nothing of them is kept. This version is not refused.
#[test]
fn s33_another_version_is_refused_by_name() {
    let others = [PROTOCOL_VERSION - 1, PROTOCOL_VERSION + 1];
    let refused = others.iter().filter(|version| coordinator_refuses(**version)).count();
    count("s33", "versions whose nodes and applications a coordinator refuses", refused, Bar::Exactly(2.0));
    let refused = others.iter().filter(|version| node_refuses(**version)).count();
    count("s33", "versions whose applications a node refuses", refused, Bar::Exactly(2.0));
    let own =
        usize::from(coordinator_refuses(PROTOCOL_VERSION)) + usize::from(node_refuses(PROTOCOL_VERSION));
    count("s33", "refusals of its own version", own, Bar::Exactly(0.0));
}
