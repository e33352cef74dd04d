//! A node of a secured farm over loopback: whom it lets compute, and who may fetch from it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, SystemTime},
};

use client_sdk::{Farm, FarmError, FarmOptions, TaskGraph};
use coordinator::{CoordinatorHandle, CoordinatorOptions, initialise, start};
use farm_core::{
    id::{AppId, AppIncarnation, Attempt, DeviceIndex, Epoch, JobAttempt, JobId, JobIndex, TaskId},
    message::{
        AppHello, AppToCoordinator, AppToNode, CoordinatorToApp, CostNs, JobFailure, JobTicket, LatencyClass,
        NodeToApp, PROTOCOL_VERSION, Priority,
    },
    program::{Content, JobProgram},
    project::QuotaChange,
};
use proto::{
    codec,
    control::{self, Invitation, Session},
    link::{self, Arrived, ContentBytes, ContentSource, Link},
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
        self.join_project(role, name, None).await
    }

    async fn join_project(&self, role: Role, name: &str, project: Option<&str>) -> Identity {
        let invitation = Invitation {
            role,
            name: Some(name.to_owned()),
            lifetime: Duration::from_secs(60),
            uses: 1,
            project: project.map(str::to_owned),
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
    dial_with(worker, who, ContentSource::empty()).await
}

/// The same as somebody who has contents.
async fn dial_with(
    worker: &WorkerHandle,
    who: Option<&Identity>,
    contents: ContentSource,
) -> Option<Link<AppToNode, NodeToApp>> {
    let contact = &worker.info().contact;
    link::connect(&contact.addresses, &contact.certificate_der, who, contents).await.ok()
}

/// An application that the coordinator knows.
struct Introduced {
    id: (AppId, AppIncarnation),
    /// Its capability.
    given: Vec<u8>,
    _session: Session<AppToCoordinator, CoordinatorToApp>,
}

async fn introduce(farm: &SecuredFarm, who: &Identity) -> Introduced {
    let mut session = control::connect_app(&farm.address, Some(who), &[]).await.unwrap();
    let hello = AppHello {
        protocol: PROTOCOL_VERSION,
        name: "app".to_owned(),
        weight: 1.0,
        global_stealing: false,
        policy: String::new(),
        resume: None,
    };
    session.sender.try_send(AppToCoordinator::Hello(hello)).unwrap();
    let given = match session.receiver.recv().await.unwrap() {
        CoordinatorToApp::Capability(bytes) => bytes,
        other => panic!("got {other:?}"),
    };
    let id = match session.receiver.recv().await.unwrap() {
        CoordinatorToApp::Welcome { app, incarnation, .. } => (app, incarnation),
        other => panic!("got {other:?}"),
    };
    Introduced { id, given, _session: session }
}

/// Has the node run a job that names `content`, as somebody whose data server has `contents`: what becomes of it.
async fn outcome_of_naming(
    farm: &SecuredFarm,
    worker: &WorkerHandle,
    who: &Identity,
    content: Content,
    contents: ContentSource,
) -> Result<Vec<u64>, JobFailure> {
    let Introduced { id, given, _session } = introduce(farm, who).await;
    let mut link = dial_with(worker, Some(who), contents).await.unwrap();
    let welcome = say_hello(&mut link, id, given).await;
    assert!(matches!(welcome, Some(NodeToApp::Welcome { .. })), "{welcome:?}");
    let mut program = JobProgram::default();
    let buffer = program.malloc(4).unwrap();
    program.task_allocation(content);
    program.memcpy_dtoh(buffer, 0, 4).unwrap();
    let job = JobId { app: id.0, task: TaskId(1), index: JobIndex(0) };
    let ticket = JobTicket {
        job: JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence: 1 } },
        device: DeviceIndex(0),
        class: LatencyClass::Batch,
        priority: Priority(0),
        cost: CostNs(0),
        contents: vec![content],
    };
    let payload = codec::pack_programs([&codec::encode_program(&program).unwrap()]);
    link.sender.send(AppToNode::Jobs(vec![ticket]), payload).await.unwrap();
    let mut frames = Vec::new();
    loop {
        let came =
            tokio::time::timeout(Duration::from_secs(20), link.receiver.recv_many(&mut frames, 8)).await;
        came.expect("the job ends").expect("the link stands");
        for frame in frames.drain(..) {
            if let NodeToApp::Result(header) = frame.header {
                return header.outcome;
            }
        }
    }
}

/// Scenarios 29 and 30: what a project's application has brought here is there for that project. Another one that knows its digest
/// gets nothing by it, unless it has the bytes itself.
#[tokio::test(flavor = "multi_thread")]
async fn s29_a_digest_gives_no_access_to_another_projects_contents() {
    let farm = SecuredFarm::start().await;
    for project in ["films", "science"] {
        let set = control::set_project(&farm.address, Some(&farm.operator), project, QuotaChange::default());
        set.await.unwrap();
    }
    let worker = farm.add_worker("n").await;
    let artist = farm.join_project(Role::App, "artist", Some("films")).await;
    let colleague = farm.join_project(Role::App, "colleague", Some("films")).await;
    let stranger = farm.join_project(Role::App, "stranger", Some("science")).await;
    let scene = ContentBytes::new(vec![7; 3 << 20]);
    let content = scene.content();
    let served = Arc::new(AtomicU64::new(0));
    let source = || {
        let scene = scene.clone();
        ContentSource::new(move |hash| (hash == content.hash).then(|| scene.clone()))
            .counted_in(Arc::clone(&served))
    };
    let name = |who, contents| outcome_of_naming(&farm, &worker, who, content, contents);
    assert_eq!(
        name(&stranger, ContentSource::empty()).await,
        Err(JobFailure::ContentUnavailable(content.hash))
    );
    assert_eq!(name(&artist, source()).await, Ok(vec![4]));
    assert_eq!(served.load(Ordering::Relaxed), content.size_bytes, "the first brings it");
    assert_eq!(name(&colleague, ContentSource::empty()).await, Ok(vec![4]), "it is there for the project");
    assert_eq!(
        name(&stranger, ContentSource::empty()).await,
        Err(JobFailure::ContentUnavailable(content.hash)),
        "and for no other"
    );
    assert_eq!(name(&stranger, source()).await, Ok(vec![4]));
    assert_eq!(
        served.load(Ordering::Relaxed),
        2 * content.size_bytes,
        "a miss: who has the bytes sends them"
    );
    worker.drain().await;
    farm.coordinator.shutdown().await;
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
    let Introduced { id, given, _session } = introduce(&farm, &app).await;
    let own_word = Capability {
        app: id.0,
        incarnation: id.1,
        holder: app.principal().clone(),
        project: "default".to_owned(),
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
