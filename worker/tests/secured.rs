//! A node of a secured farm over loopback: whom it lets compute, and who may fetch from it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, SystemTime},
};

use bytes::Bytes;
use client_sdk::{Farm, FarmError, FarmOptions, TaskGraph};
use coordinator::{CoordinatorHandle, CoordinatorOptions, initialise, start};
use farm_core::{
    device::Requirements,
    id::{AppId, AppIncarnation, BatchId, DeviceIndex, Epoch, JobAttempt, JobId, JobIndex, TaskId},
    message::{
        AppHello, AppToCoordinator, AppToNode, CoordinatorToApp, CostNs, JobTicket, LatencyClass, NodeToApp,
        PROTOCOL_VERSION, Plan, PlanJob, PlanRequest, Priority,
    },
    program::{Content, JobProgram},
    project::QuotaChange,
};
use proto::{
    codec,
    control::{self, Invitation, Session},
    link::{self, Arrived, ContentBytes, ContentSource, Link},
    trust::{Authority, Capability, IDENTITY_LIFETIME, Identity, Role, Scope},
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
    session: Session<AppToCoordinator, CoordinatorToApp>,
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
    Introduced { id, given, session }
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

/// A job of one attempt that names `content` in its program, and, if `told`, in its ticket.
fn job_naming(job: JobAttempt, content: Content, told: bool) -> (AppToNode, Vec<Bytes>) {
    let mut program = JobProgram::default();
    let buffer = program.malloc(4).unwrap();
    program.task_allocation(content);
    program.memcpy_dtoh(buffer, 0, 4).unwrap();
    let ticket = JobTicket {
        job,
        device: DeviceIndex(0),
        class: LatencyClass::Batch,
        priority: Priority(0),
        cost: CostNs(0),
        contents: if told { vec![content] } else { Vec::new() },
    };
    (AppToNode::Jobs(vec![ticket]), codec::pack_programs([&codec::encode_program(&program).unwrap()]))
}

impl Introduced {
    /// The attempt of a job that the coordinator plans.
    async fn planned(&mut self, content: Content) -> JobAttempt {
        let request = PlanRequest {
            batch: BatchId(1),
            task: TaskId(1),
            jobs: vec![PlanJob { index: JobIndex(0), cost: CostNs(0) }],
            needs: Requirements::ANY,
            module: None,
            contents: vec![content],
            held: Vec::new(),
        };
        self.session.sender.try_send(AppToCoordinator::Plan(request)).unwrap();
        loop {
            if let CoordinatorToApp::Plan(plan) = self.session.receiver.recv().await.unwrap() {
                return plan.nodes[0].devices[0].jobs[0];
            }
        }
    }
}

/// Has the node run a job that names `content`, as somebody whose data server has `contents`. Whether it did; if not, the coordinator
/// plans it again, since the node could not get the content.
async fn runs_naming(
    farm: &SecuredFarm,
    worker: &WorkerHandle,
    who: &Identity,
    content: Content,
    contents: ContentSource,
) -> bool {
    let mut app = introduce(farm, who).await;
    let job = app.planned(content).await;
    let mut link = dial_with(worker, Some(who), contents).await.unwrap();
    let welcome = say_hello(&mut link, app.id, app.given.clone()).await;
    assert!(matches!(welcome, Some(NodeToApp::Welcome { .. })), "{welcome:?}");
    let (jobs, payload) = job_naming(job, content, true);
    link.sender.send(jobs, payload).await.unwrap();
    loop {
        tokio::select! {
            frame = link.receiver.recv() => {
                if let NodeToApp::Result(header) = frame.unwrap().header {
                    assert_eq!((header.job, header.outcome), (job, Ok(vec![4])), "its own");
                    return true;
                }
            }
            heard = app.session.receiver.recv() => {
                if matches!(heard.unwrap(), CoordinatorToApp::Plan(Plan { batch: None, .. })) {
                    return false;
                }
            }
            () = tokio::time::sleep(Duration::from_secs(60)) => panic!("the job has no end"),
        }
    }
}

async fn farm_with_projects() -> SecuredFarm {
    let farm = SecuredFarm::start().await;
    for project in ["films", "science"] {
        let set = control::set_project(&farm.address, Some(&farm.operator), project, QuotaChange::default());
        set.await.unwrap();
    }
    farm
}

/// Scenarios 29 and 30: what a project's application has brought here is there for that project. Another one that knows its digest
/// gets nothing by it, unless it has the bytes itself.
#[tokio::test(flavor = "multi_thread")]
async fn s29_a_digest_gives_no_access_to_another_projects_contents() {
    let farm = farm_with_projects().await;
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
    let naming = |who, contents| runs_naming(&farm, &worker, who, content, contents);
    assert!(!naming(&stranger, ContentSource::empty()).await, "nobody has it");
    assert!(naming(&artist, source()).await);
    assert_eq!(served.load(Ordering::Relaxed), content.size_bytes, "the first brings it");
    assert!(naming(&colleague, ContentSource::empty()).await, "it is there for the project");
    assert!(!naming(&stranger, ContentSource::empty()).await, "and for no other");
    assert!(naming(&stranger, source()).await);
    assert_eq!(
        served.load(Ordering::Relaxed),
        2 * content.size_bytes,
        "a miss: who has the bytes sends them"
    );
    worker.drain().await;
    farm.coordinator.shutdown().await;
}

/// A hello that is refused ends the link's rights: what comes after it, with the names that the node has for another project's
/// contents, is not run.
#[tokio::test(flavor = "multi_thread")]
async fn what_follows_a_refused_hello_is_nobodys_word() {
    let farm = farm_with_projects().await;
    let worker = farm.add_worker("n").await;
    let artist = farm.join_project(Role::App, "artist", Some("films")).await;
    let stranger = farm.join_project(Role::App, "stranger", Some("science")).await;
    let (scene, own) = (ContentBytes::new(vec![7; 3 << 20]), ContentBytes::new(vec![8; 16]));
    let source = |bytes: &ContentBytes| {
        let bytes = bytes.clone();
        ContentSource::new(move |hash| (hash == bytes.content().hash).then(|| bytes.clone()))
    };
    assert!(runs_naming(&farm, &worker, &artist, scene.content(), source(&scene)).await);
    let name = Content { hash: Scope::of("films").name(scene.content().hash), ..scene.content() };

    let mut app = introduce(&farm, &stranger).await;
    let own_job = app.planned(own.content()).await;
    let other = JobAttempt { job: JobId { index: JobIndex(9), ..own_job.job }, ..own_job };
    let hello = AppToNode::Hello { protocol: PROTOCOL_VERSION, app: app.id.0, incarnation: app.id.1 };
    let (jobs, payload) = job_naming(other, name, false);
    // With the rights of an earlier hello, and with none.
    for introduced in [true, false] {
        let mut link = dial_with(&worker, Some(&stranger), ContentSource::empty()).await.unwrap();
        if introduced {
            let welcome = say_hello(&mut link, app.id, app.given.clone()).await;
            assert!(matches!(welcome, Some(NodeToApp::Welcome { .. })), "{welcome:?}");
            link.sender.send(hello.clone(), vec![Bytes::from_static(b"x")]).await.unwrap();
        }
        link.sender.send(jobs.clone(), payload.clone()).await.unwrap();
        // To its end, which the node makes.
        while let Ok(frame) = link.receiver.recv().await {
            assert!(matches!(frame.header, NodeToApp::Refused { .. }), "{:?}", frame.header);
        }
    }
    // Another application's job is not this one's to bring.
    let mut link = dial_with(&worker, Some(&stranger), source(&own)).await.unwrap();
    let foreign = JobAttempt { job: JobId { app: AppId(app.id.0.0 - 1), ..other.job }, ..other };
    say_hello(&mut link, app.id, app.given.clone()).await;
    let (jobs, payload) = job_naming(foreign, own.content(), true);
    link.sender.send(jobs, payload).await.unwrap();
    while link.receiver.recv().await.is_ok() {}

    let mut link = dial_with(&worker, Some(&stranger), source(&own)).await.unwrap();
    say_hello(&mut link, app.id, app.given.clone()).await;
    let (jobs, payload) = job_naming(own_job, own.content(), true);
    link.sender.send(jobs, payload).await.unwrap();
    let result = loop {
        if let NodeToApp::Result(header) = link.receiver.recv().await.unwrap().header {
            break header;
        }
    };
    assert_eq!(result.job, own_job, "nothing else was run for it before");
    worker.drain().await;
    farm.coordinator.shutdown().await;
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
                .fetch(Content { hash: codec::content_hash(b"x"), size_bytes: 1 }, &mut Arrived::default())
                .await;
            assert!(matches!(fetched, Err(link::FetchError::Link(_))), "{who:?}: {fetched:?}");
            let mut frames = Vec::new();
            assert!(link.receiver.recv_many(&mut frames, 1).await.is_err(), "{who:?}");
        }
    }

    // What an application of this farm shows, if it is what the coordinator gave, is enough; all else is not.
    let Introduced { id, given, session: _session } = introduce(&farm, &app).await;
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
