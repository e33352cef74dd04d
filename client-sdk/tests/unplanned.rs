//! A member of the farm that is linked with an application and answers a job that the plan gave to another node: the real SDK and
//! coordinator, and two nodes of the test's own, over loopback.
#![allow(clippy::unwrap_used, reason = "a step that fails fails its test")]

use std::{
    io,
    sync::{Arc, Mutex},
};

use bytes::Bytes;
use client_sdk::{
    DispatchError, Farm, FarmOptions, Job, JobProgram, JobResult, Requirements, RetrieveError, Task,
    TaskGraph,
};
use coordinator::CoordinatorOptions;
use farm_core::{
    device::{DeviceInfo, DeviceKind, Features, Limits},
    id::{DeviceIndex, JobAttempt, JobId, NodeId, NodeSession},
    message::{
        AppToNode, Contact, CoordinatorToNode, NodeHello, NodeToApp, NodeToCoordinator, PROTOCOL_VERSION,
        ResultHeader,
    },
};
use proto::{
    codec::content_hash,
    control::{self, Session},
    link::{ContentSource, DataServer, Link},
};

/// Every job's result, from a node that may give it.
const RIGHT: &[u8] = b"good";
const WRONG: &[u8] = b"evil";

/// Keeps what it gets.
struct Ask {
    brought: Brought,
    number: u32,
}

/// What came for which job, in order of arrival.
type Brought = Arc<Mutex<Vec<(u32, Vec<u8>)>>>;

impl Job for Ask {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        let buffer = cmd.malloc(4)?;
        cmd.memcpy_dtoh(buffer, 0, 4)
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        self.brought.lock().unwrap().push((self.number, result.section(0, 4)?.to_vec()));
        Ok(())
    }
}

struct Asks(Brought);

impl Task for Asks {
    fn requirements(&self) -> Requirements {
        Requirements::ANY
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        let ask = |number| Box::new(Ask { brought: Arc::clone(&self.0), number }) as Box<dyn Job>;
        (0..2).map(ask).collect()
    }
}

/// A node that does what the test says.
struct Node {
    id: NodeId,
    session: NodeSession,
    server: DataServer,
    _coordinator: Session<NodeToCoordinator, CoordinatorToNode>,
}

impl Node {
    async fn join(coordinator: &str, name: &str) -> Self {
        let server = DataServer::bind("127.0.0.1:0".parse().unwrap(), None).unwrap();
        let mut link = control::connect_node(coordinator, None).await.unwrap();
        let device = DeviceInfo {
            name: "none".to_owned(),
            kind: DeviceKind::Simulated,
            score: 1_000.0,
            features: Features::default(),
            limits: Limits::UNBOUNDED,
        };
        let session = NodeSession(name.bytes().map(u64::from).sum());
        let contact = Contact {
            addresses: vec![server.local_addr().to_string()],
            certificate_der: server.certificate_der().to_vec(),
        };
        let hello = NodeHello {
            protocol: PROTOCOL_VERSION,
            node: None,
            name: name.to_owned(),
            session,
            devices: vec![device],
            contact,
            inventory: Vec::new(),
        };
        link.sender.send(NodeToCoordinator::Hello(hello)).await.unwrap();
        let CoordinatorToNode::Welcome { node, .. } = link.receiver.recv().await.unwrap() else {
            panic!("the first word is the welcome")
        };
        Self { id: node, session, server, _coordinator: link }
    }

    /// The application's link, and the one job that is planned here.
    async fn planned(&self) -> (Link<NodeToApp, AppToNode>, JobAttempt) {
        let dialled = self.server.accept().await.unwrap();
        let (mut link, _) = dialled.establish(|_| ContentSource::empty()).await.unwrap();
        let hello = link.receiver.recv().await.unwrap().header;
        assert!(matches!(hello, AppToNode::Hello { .. }), "got {hello:?}");
        let welcome = NodeToApp::Welcome { node: self.id, session: self.session };
        link.sender.send(welcome, Vec::new()).await.unwrap();
        let AppToNode::Jobs(tickets) = link.receiver.recv().await.unwrap().header else { panic!("no jobs") };
        assert_eq!(tickets.len(), 1, "one job for each node");
        (link, tickets[0].job)
    }
}

async fn answer(link: &Link<NodeToApp, AppToNode>, job: JobAttempt, bytes: &'static [u8]) {
    let header = ResultHeader {
        job,
        device: DeviceIndex(0),
        device_time_ns: 1,
        outcome: Ok(vec![bytes.len() as u64]),
        digest: content_hash(bytes),
    };
    link.sender.send(NodeToApp::Result(header), vec![Bytes::from_static(bytes)]).await.unwrap();
}

/// What the application acknowledges next.
async fn acknowledged(link: &mut Link<NodeToApp, AppToNode>) -> Vec<JobAttempt> {
    let AppToNode::Acks(acks) = link.receiver.recv().await.unwrap().header else { panic!("no answer") };
    acks.into_iter().map(|ack| ack.job).collect()
}

/// What this thread logs.
#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl io::Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// 30 of `tests/README.md`: it is told, not retrieved, not acknowledged, and the planned node's result counts as if nothing had been.
#[tokio::test]
async fn s30_a_result_of_a_node_that_the_plan_does_not_name_is_refused() {
    let log = Log::default();
    let writer = log.clone();
    let _logged = tracing::subscriber::set_default(
        tracing_subscriber::fmt().with_ansi(false).with_writer(move || writer.clone()).finish(),
    );
    let coordinator = coordinator::start(CoordinatorOptions::embedded()).await.unwrap();
    let address = coordinator.grpc_addr().to_string();
    let (honest, impostor) = (Node::join(&address, "honest").await, Node::join(&address, "impostor").await);
    let app = Farm::connect(FarmOptions::new(&address, "test")).await.unwrap();
    let brought = Brought::default();
    let nodes = async {
        let ((mut honest, own), (mut impostor, other)) = tokio::join!(honest.planned(), impostor.planned());
        answer(&impostor, own, WRONG).await;
        answer(&impostor, other, RIGHT).await;
        // In the order in which they were sent: it would have come first.
        assert_eq!(acknowledged(&mut impostor).await, [other], "its own is acknowledged, the other's is not");
        answer(&honest, own, RIGHT).await;
        assert_eq!(acknowledged(&mut honest).await, [own]);
        let JobId { index, .. } = own.job;
        index.0
    };
    let (summary, refused) =
        tokio::join!(app.run(TaskGraph::new().task("ask", Asks(Arc::clone(&brought)))), nodes);
    let summary = summary.unwrap();
    assert_eq!((summary.jobs, summary.replanned), (2, 0));
    let brought = brought.lock().unwrap().clone();
    assert_eq!(brought.len(), 2, "once each: {brought:?}");
    assert!(brought.iter().all(|(_, bytes)| bytes == RIGHT), "{brought:?}");
    assert_eq!(brought[1].0, refused, "it came when the planned node said so");
    let log = String::from_utf8(log.0.lock().unwrap().clone()).unwrap();
    let told: Vec<&str> = log.lines().filter(|line| line.contains("the plan does not name")).collect();
    assert_eq!(told.len(), 1, "{log}");
    app.close().await;
    coordinator.shutdown().await;
}
