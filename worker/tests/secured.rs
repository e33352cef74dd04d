//! A node of a secured farm over loopback: whom it lets compute, and who may fetch from it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::time::{Duration, SystemTime};

use client_sdk::{Farm, FarmError, FarmOptions, TaskGraph};
use coordinator::{CoordinatorHandle, CoordinatorOptions, initialise, start};
use farm_core::{
    id::{AppId, AppIncarnation, Epoch},
    message::{AppToNode, NodeToApp, PROTOCOL_VERSION},
    program::Content,
};
use proto::{
    control::{self, Invitation},
    link::{self, Arrived, ContentSource, Link},
    trust::{Authority, Capability, IDENTITY_LIFETIME, Identity, Role},
};
use tempfile::TempDir;
use worker::{End, StartError, WorkerHandle, WorkerOptions};

struct SecuredFarm {
    _state: TempDir,
    coordinator: CoordinatorHandle,
    address: String,
    operator: Identity,
}

impl SecuredFarm {
    async fn start() -> Self {
        let state = tempfile::tempdir().unwrap();
        let operator = initialise(state.path(), "farm", "boss").unwrap();
        let options = CoordinatorOptions {
            state: Some(state.path().to_owned()),
            secured: true,
            ..CoordinatorOptions::embedded()
        };
        let coordinator = start(options).await.unwrap();
        let address = coordinator.grpc_addr().to_string();
        Self { _state: state, coordinator, address, operator }
    }

    async fn join(&self, role: Role, name: &str) -> Identity {
        let invitation = Invitation {
            role,
            name: Some(name.to_owned()),
            lifetime: Duration::from_secs(60),
            uses: 1,
            project: None,
        };
        let (_, token) =
            control::create_token(&self.address, Some(&self.operator), &invitation).await.unwrap();
        control::join(&self.address, &token, None).await.unwrap()
    }

    fn worker(&self, identity: Option<Identity>) -> WorkerOptions {
        let options = WorkerOptions::embedded(self.address.clone(), vec!["sim".parse().unwrap()]);
        let name = identity.as_ref().map_or("w", |identity| &identity.principal().name).to_owned();
        WorkerOptions { identity, name, connect_timeout: Duration::from_secs(5), ..options }
    }

    async fn add_worker(&self, name: &str) -> WorkerHandle {
        worker::start(self.worker(Some(self.join(Role::Node, name).await))).await.unwrap()
    }

    fn options(&self, identity: Option<Identity>) -> FarmOptions {
        FarmOptions { identity, ..FarmOptions::new(&self.address, "test") }
    }
}

/// A link to the only node, as somebody.
async fn dial(
    farm: &SecuredFarm,
    worker: &WorkerHandle,
    who: Option<&Identity>,
) -> Option<Link<AppToNode, NodeToApp>> {
    let status = farm.coordinator.status().await.unwrap();
    assert_eq!(status.nodes.len(), 1, "the only node");
    let contact = &worker.info().contact;
    link::connect(&contact.addresses, &contact.certificate_der, who, ContentSource::empty()).await.ok()
}

/// The node's answer to a hello; `None` if it closed the link.
async fn say_hello(
    link: &mut Link<AppToNode, NodeToApp>,
    app: (AppId, AppIncarnation),
    shown: Vec<u8>,
) -> Option<NodeToApp> {
    let hello = AppToNode::Hello { protocol: PROTOCOL_VERSION, app: app.0, incarnation: app.1 };
    link.sender.send(hello, vec![shown.into()]).await.unwrap();
    let mut frames = Vec::new();
    let answer = tokio::time::timeout(Duration::from_secs(20), link.receiver.recv_many(&mut frames, 1)).await;
    answer.expect("the node answers or closes").ok()?;
    frames.pop().map(|frame| frame.header)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_member_computes_and_a_stranger_does_not() {
    let farm = SecuredFarm::start().await;
    let worker = farm.add_worker("n").await;
    let app = Farm::connect(farm.options(Some(farm.join(Role::App, "project").await))).await.unwrap();
    app.run(TaskGraph::new()).await.unwrap();
    app.close().await;
    let stranger = Farm::connect(farm.options(None)).await;
    assert!(
        matches!(&stranger, Err(FarmError::Denied { reason, .. }) if reason.contains("join")),
        "{stranger:?}"
    );
    let node = Farm::connect(farm.options(Some(farm.join(Role::Node, "m").await))).await;
    assert!(matches!(node, Err(FarmError::Denied { .. })), "{node:?}");
    for identity in [None, Some(farm.join(Role::App, "other").await)] {
        let refused = worker::start(farm.worker(identity)).await;
        assert!(matches!(refused, Err(StartError::Denied { .. })), "{refused:?}");
    }
    let misnamed =
        WorkerOptions { name: "n".to_owned(), ..farm.worker(Some(farm.join(Role::Node, "o").await)) };
    let refused = worker::start(misnamed).await;
    assert!(
        matches!(&refused, Err(StartError::Denied { reason }) if reason.contains("may be called")),
        "{refused:?}"
    );
    assert_eq!(farm.coordinator.status().await.unwrap().nodes.len(), 1, "nobody else is registered");
    assert_eq!(worker.drain().await, End::Drained);
    farm.coordinator.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_node_lets_in_whom_the_coordinator_vouches_for() {
    let farm = SecuredFarm::start().await;
    let worker = farm.add_worker("n").await;
    let (app, other) = (farm.join(Role::App, "project").await, farm.join(Role::App, "other").await);
    let peer = farm.join(Role::Node, "m").await;
    let stranger =
        Authority::create("farm").unwrap().identity(Role::App, "project", IDENTITY_LIFETIME).unwrap();

    // Without an identity of the farm there is no link at all: the handshake, or the first word on it, fails.
    for who in [None, Some(&stranger)] {
        if let Some(mut link) = dial(&farm, &worker, who).await {
            let fetched = link
                .sender
                .fetch(
                    Content { hash: proto::codec::content_hash(b"x"), size_bytes: 1 },
                    &mut Arrived::default(),
                )
                .await;
            assert!(matches!(fetched, Err(link::FetchError::Link(_))), "{who:?}: {fetched:?}");
            let mut frames = Vec::new();
            assert!(link.receiver.recv_many(&mut frames, 1).await.is_err(), "{who:?}");
        }
    }

    // What an application of this farm shows, if it is what the coordinator gave, is enough; all else is not.
    let mut session = control::connect_app(&farm.address, Some(&app), &[]).await.unwrap();
    let hello = farm_core::message::AppHello {
        protocol: PROTOCOL_VERSION,
        name: "app".to_owned(),
        weight: 1.0,
        global_stealing: false,
        policy: String::new(),
        resume: None,
    };
    session.sender.try_send(farm_core::message::AppToCoordinator::Hello(hello)).unwrap();
    let given = match session.receiver.recv().await.unwrap() {
        farm_core::message::CoordinatorToApp::Capability(bytes) => bytes,
        other => panic!("got {other:?}"),
    };
    let id = match session.receiver.recv().await.unwrap() {
        farm_core::message::CoordinatorToApp::Welcome { app, incarnation, .. } => (app, incarnation),
        other => panic!("got {other:?}"),
    };
    let own_word = Capability {
        app: id.0,
        incarnation: id.1,
        holder: app.principal().clone(),
        epoch: Epoch(1),
        expires: SystemTime::now() + Duration::from_secs(60),
    };
    let refusals = [
        ("nothing shown", &app, id, Vec::new()),
        ("nonsense shown", &app, id, vec![7; 300]),
        ("its own word", &app, id, own_word.sign(&app).unwrap()),
        ("a capability of somebody else's", &other, id, given.clone()),
        ("a capability for another application", &app, (AppId(id.0.0 + 1), id.1), given.clone()),
        ("a capability for another life", &app, (id.0, AppIncarnation(id.1.0 + 1)), given.clone()),
        ("a node with an application's capability", &peer, id, given.clone()),
    ];
    for (what, who, app, shown) in refusals {
        let mut link = dial(&farm, &worker, Some(who)).await.unwrap();
        let answer = say_hello(&mut link, app, shown).await;
        assert!(matches!(answer, Some(NodeToApp::Refused { .. })), "{what}: {answer:?}");
    }
    let mut link = dial(&farm, &worker, Some(&app)).await.unwrap();
    let answer = say_hello(&mut link, id, given).await;
    assert!(matches!(answer, Some(NodeToApp::Welcome { .. })), "got {answer:?}");
    worker.drain().await;
    farm.coordinator.shutdown().await;
}
