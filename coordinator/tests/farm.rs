//! An embedded coordinator over loopback: real gRPC sessions, the operator's requests, HTTP, lives and ports.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{
    io::{Read as _, Write as _},
    net::{SocketAddr, TcpStream},
};

use coordinator::{CoordinatorHandle, CoordinatorOptions, StartError, start};
use farm_core::{
    coordinator::NodeState,
    device::{DeviceInfo, DeviceKind, Features, Limits, Requirements},
    id::{BatchId, DeviceIndex, Epoch, JobIndex, NodeId, NodeSession, TaskId},
    message::{
        AppHello, AppToCoordinator, CacheFigures, Contact, CoordinatorToApp, CoordinatorToNode, CostNs,
        Executed, JobFailure, JobTrace, NodeHello, NodeToCoordinator, PROTOCOL_VERSION, PlanJob, PlanRequest,
        WaitReason,
    },
    time::Instant,
};
use proto::control::{self, Session, SessionError, v1};
use tokio_stream::StreamExt as _;

type AppSession = Session<AppToCoordinator, CoordinatorToApp>;
type NodeSessionLink = Session<NodeToCoordinator, CoordinatorToNode>;

async fn farm() -> (CoordinatorHandle, String) {
    let handle = start(CoordinatorOptions::embedded()).await.unwrap();
    let address = handle.grpc_addr().to_string();
    (handle, address)
}

async fn app(address: &str, protocol: u32) -> AppSession {
    let session = control::connect_app(address, None, &[]).await.unwrap();
    session.sender.try_send(AppToCoordinator::Hello(app_hello(protocol))).unwrap();
    session
}

fn app_hello(protocol: u32) -> AppHello {
    AppHello {
        protocol,
        name: "an app".to_owned(),
        weight: 1.0,
        global_stealing: false,
        policy: String::new(),
        resume: None,
    }
}

async fn node(address: &str) -> NodeSessionLink {
    let session = control::connect_node(address, None).await.unwrap();
    let device = DeviceInfo {
        name: "simulated".to_owned(),
        kind: DeviceKind::Simulated,
        score: 1_000.0,
        features: Features::default(),
        limits: Limits::UNBOUNDED,
    };
    let hello = NodeHello {
        protocol: PROTOCOL_VERSION,
        node: None,
        name: "a node".to_owned(),
        session: NodeSession(77),
        devices: vec![device],
        contact: Contact { addresses: vec!["127.0.0.1:9".to_owned()], certificate_der: vec![1, 2, 3] },
        inventory: Vec::new(),
    };
    session.sender.send(NodeToCoordinator::Hello(hello)).await.unwrap();
    session
}

fn plan_request(jobs: u32) -> AppToCoordinator {
    let jobs = (0..jobs).map(|index| PlanJob { index: JobIndex(index), cost: CostNs(1_000) });
    AppToCoordinator::Plan(PlanRequest {
        batch: BatchId(5),
        task: TaskId(2),
        jobs: jobs.collect(),
        needs: Requirements::ANY,
        module: None,
        contents: Vec::new(),
        held: Vec::new(),
    })
}

#[tokio::test]
async fn an_app_and_a_node_meet_through_sessions() {
    let (handle, address) = farm().await;
    let mut app = app(&address, PROTOCOL_VERSION).await;
    let welcome = app.receiver.recv().await.unwrap();
    assert!(
        matches!(welcome, CoordinatorToApp::Welcome { epoch, .. } if epoch > Epoch(0)),
        "got {welcome:?}"
    );
    app.sender.try_send(plan_request(4_096)).unwrap();
    let waiting = app.receiver.recv().await.unwrap();
    assert_eq!(waiting, CoordinatorToApp::Waiting { batch: BatchId(5), reason: WaitReason::NoNode });

    let mut node = node(&address).await;
    let welcome = node.receiver.recv().await.unwrap();
    let CoordinatorToNode::Welcome { node: id, .. } = welcome else { panic!("got {welcome:?}") };
    let joined = node.receiver.recv().await.unwrap();
    assert!(matches!(joined, CoordinatorToNode::AppsJoined(_)), "got {joined:?}");
    let plan = app.receiver.recv().await.unwrap();
    let CoordinatorToApp::Plan(plan) = plan else { panic!("got {plan:?}") };
    assert_eq!(plan.nodes.len(), 1);
    assert_eq!((plan.nodes[0].node, plan.nodes[0].session), (id, NodeSession(77)));
    assert_eq!(plan.nodes[0].contact.certificate_der, [1, 2, 3]);
    assert_eq!(plan.nodes[0].devices.iter().map(|device| device.jobs.len()).sum::<usize>(), 4_096);

    node.sender
        .try_send(NodeToCoordinator::Heartbeat {
            sequence: 9,
            unanswered: false,
            devices: Vec::new(),
            spool_bytes: 0,
            cache: Some(CacheFigures::default()),
        })
        .unwrap();
    loop {
        match node.receiver.recv().await.unwrap() {
            CoordinatorToNode::HeartbeatAck { sequence } => break assert_eq!(sequence, 9),
            other => assert!(!matches!(other, CoordinatorToNode::Refused { .. }), "got {other:?}"),
        }
    }
    let status = control::status(&address, None).await.unwrap();
    assert_eq!(Some(&status), handle.status().await.as_ref());
    assert_eq!(status.nodes[0].name, "a node");
    assert_eq!(status.apps[0].outstanding_jobs, 4_096);

    control::drain(&address, None, id).await.unwrap();
    assert_eq!(node.receiver.recv().await.unwrap(), CoordinatorToNode::Drain);
    let error = control::drain(&address, None, NodeId(999)).await.unwrap_err();
    assert!(matches!(&error, SessionError::Refused { reason } if reason.contains("node-999")), "got {error}");

    drop(app.sender);
    let ended = app.receiver.recv_end().await;
    assert!(matches!(ended, SessionError::Ended { .. }), "got {ended}");
    handle.shutdown().await;
    let ended = node.receiver.recv_end().await;
    assert!(matches!(ended, SessionError::Ended { .. }), "got {ended}");
    let error = control::status(&address, None).await.unwrap_err();
    assert!(error.to_string().contains(&address), "got {error}");
}

#[tokio::test]
async fn a_lost_session_is_noticed_at_once() {
    let (handle, address) = farm().await;
    let mut node = node(&address).await;
    assert!(matches!(node.receiver.recv().await.unwrap(), CoordinatorToNode::Welcome { .. }), "registered");
    drop(node);
    // Asked again until it shows: each question goes through the owner, so this does not spin without progress.
    let noticed = async {
        loop {
            let status = handle.status().await.unwrap();
            match status.nodes.first() {
                Some(node) if node.state == NodeState::Alive => tokio::task::yield_now().await,
                _ => break,
            }
        }
    };
    tokio::time::timeout(std::time::Duration::from_secs(20), noticed)
        .await
        .expect("a closed connection is noticed");
}

#[tokio::test]
async fn who_speaks_another_protocol_is_told_why() {
    let (_handle, address) = farm().await;
    let mut app = app(&address, PROTOCOL_VERSION + 1).await;
    let refused = app.receiver.recv().await.unwrap();
    assert!(matches!(refused, CoordinatorToApp::Refused { .. }), "got {refused:?}");
    let ended = app.receiver.recv().await.unwrap_err();
    assert!(matches!(ended, SessionError::Ended { .. }), "got {ended}");
}

#[tokio::test]
async fn a_malformed_message_ends_the_session_by_field() {
    let (_handle, address) = farm().await;
    let channel = tonic::transport::Endpoint::from_shared(format!("http://{address}")).unwrap();
    let mut client = v1::apps_client::AppsClient::new(channel.connect().await.unwrap());
    let hello = v1::AppHello {
        protocol: PROTOCOL_VERSION,
        name: "a".to_owned(),
        weight: -1.0,
        global_stealing: false,
        policy: String::new(),
        resume: None,
    };
    let hello = v1::AppToCoordinator { message: Some(v1::app_to_coordinator::Message::Hello(hello)) };
    let outgoing = tokio_stream::once(hello).chain(tokio_stream::pending());
    let mut answers = client.session(outgoing).await.unwrap().into_inner();
    let status = answers.message().await.unwrap_err();
    assert_eq!(status.code(), tonic::Code::InvalidArgument);
    assert!(status.message().contains("AppHello.weight"), "got {status}");
    // The coordinator goes on.
    assert!(control::status(&address, None).await.is_ok(), "it still answers");
}

#[tokio::test]
async fn wrong_addresses_are_named() {
    for (address, part) in [
        ("127.0.0.1", "port is missing"),
        (":7700", "host is missing"),
        ("127.0.0.1:x", "1 to 65535"),
        ("127.0.0.1:0", "1 to 65535"),
        ("a b:1", "a b:1"),
    ] {
        let error = control::status(address, None).await.unwrap_err();
        assert!(matches!(error, SessionError::Address { .. }), "{address}: got {error}");
        assert!(error.to_string().contains(part), "{address}: got {error}");
    }
    let unused = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = unused.local_addr().unwrap().to_string();
    drop(unused);
    let error = control::connect_node(&address, None).await.map(|_| ()).unwrap_err();
    assert!(matches!(error, SessionError::Unreachable { .. }), "got {error}");
    assert!(error.to_string().contains("refused"), "the root cause: {error}");
}

#[tokio::test]
async fn each_life_has_a_larger_epoch() {
    let state = tempfile::tempdir().unwrap();
    for expected in 1..=3 {
        let options =
            CoordinatorOptions { state: Some(state.path().to_owned()), ..CoordinatorOptions::embedded() };
        let handle = start(options).await.unwrap();
        assert_eq!(handle.status().await.unwrap().epoch, Epoch(expected));
        handle.shutdown().await;
    }
}

/// Reads until the application hears why it is stopped.
async fn stopped(app: &mut AppSession) -> String {
    loop {
        match app.receiver.recv().await.unwrap() {
            CoordinatorToApp::Stopped { reason } => return reason,
            other => assert!(!matches!(other, CoordinatorToApp::Refused { .. }), "got {other:?}"),
        }
    }
}

#[tokio::test]
async fn an_application_that_was_stopped_is_so_after_a_restart() {
    let state = tempfile::tempdir().unwrap();
    let options =
        CoordinatorOptions { state: Some(state.path().to_owned()), ..CoordinatorOptions::embedded() };
    let handle = start(options.clone()).await.unwrap();
    let address = handle.grpc_addr().to_string();
    let node = node(&address).await;
    let mut first = app(&address, PROTOCOL_VERSION).await;
    let welcome = first.receiver.recv().await.unwrap();
    let CoordinatorToApp::Welcome { app: id, incarnation, .. } = welcome else { panic!("got {welcome:?}") };
    first.sender.try_send(plan_request(8)).unwrap();
    let jobs = loop {
        if let CoordinatorToApp::Plan(plan) = first.receiver.recv().await.unwrap() {
            break plan.nodes[0].devices[0].jobs.clone();
        }
    };
    let crashed = |job| Executed {
        job,
        device: DeviceIndex(0),
        device_time_ns: 0,
        trace: JobTrace::default(),
        failure: Some(JobFailure::Timeout),
    };
    let executed = jobs.into_iter().map(crashed).collect();
    let report = NodeToCoordinator::Report { sent_at: Instant::ZERO, executed, delivered: Vec::new() };
    node.sender.send(report).await.unwrap();
    let reason = stopped(&mut first).await;
    assert!(reason.starts_with("8 attempts in a row"), "got {reason}");
    handle.shutdown().await;

    let handle = start(options).await.unwrap();
    let address = handle.grpc_addr().to_string();
    let hello = AppHello { resume: Some((id, incarnation)), ..app_hello(PROTOCOL_VERSION) };
    let mut again = control::connect_app(&address, None, &[]).await.unwrap();
    again.sender.try_send(AppToCoordinator::Hello(hello)).unwrap();
    again.sender.try_send(plan_request(1)).unwrap();
    assert_eq!(stopped(&mut again).await, reason);
    let mut other = app(&address, PROTOCOL_VERSION).await;
    other.sender.try_send(plan_request(1)).unwrap();
    loop {
        match other.receiver.recv().await.unwrap() {
            CoordinatorToApp::Welcome { .. } => {}
            CoordinatorToApp::Waiting { .. } => break,
            other => panic!("another application is not stopped: {other:?}"),
        }
    }
    handle.shutdown().await;
}

#[tokio::test]
async fn a_port_in_use_is_an_error_with_the_address() {
    let (first, _) = farm().await;
    let cases = [
        (
            "gRPC",
            CoordinatorOptions { listen: first.grpc_addr(), ..CoordinatorOptions::embedded() },
            first.grpc_addr(),
        ),
        (
            "HTTP",
            CoordinatorOptions { http: first.http_addr(), ..CoordinatorOptions::embedded() },
            first.http_addr(),
        ),
    ];
    for (expected, options, taken) in cases {
        let error = start(options).await.map(|_| ()).unwrap_err();
        assert!(
            matches!(error, StartError::Listen { what, address, .. } if what == expected && address == taken)
        );
        assert!(error.to_string().contains(&taken.to_string()), "got {error}");
    }
}

fn get(address: SocketAddr, path: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn http_shows_the_farm() {
    let (handle, address) = farm().await;
    let mut node = node(&address).await;
    assert!(matches!(node.receiver.recv().await.unwrap(), CoordinatorToNode::Welcome { .. }), "registered");
    let http = handle.http_addr();
    for (path, status, part) in [
        ("/healthz", "200 OK", "ok"),
        ("/metrics", "200 OK", "gleaner_nodes{state=\"alive\"} 1"),
        ("/", "200 OK", "a node"),
        ("/status.json", "200 OK", "\"state\":\"alive\""),
        ("/nothing", "404 Not Found", ""),
    ] {
        let answer = tokio::task::spawn_blocking(move || get(http, path)).await.unwrap();
        assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{path}: {answer}");
        assert!(answer.contains(part), "{path}: {answer}");
    }
    handle.shutdown().await;
    assert!(TcpStream::connect(http).is_err(), "nobody listens any more");
}

/// Reads until the end of a session.
trait ReceiveEnd {
    async fn recv_end(&mut self) -> SessionError;
}

impl<R: control::Heard> ReceiveEnd for control::SessionReceiver<R> {
    async fn recv_end(&mut self) -> SessionError {
        loop {
            if let Err(error) = self.recv().await {
                return error;
            }
        }
    }
}
