//! A secured coordinator over loopback: the authorisation matrix, joining, renewing, expelling; each refusal changes nothing and
//! is in the audit log.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{fs, time::Duration};

use coordinator::{CoordinatorHandle, CoordinatorOptions, initialise, start};
use farm_core::{
    coordinator::{AppStatus, timeline::TimelineQuery},
    device::{DeviceInfo, DeviceKind, Features, Limits, Requirements},
    id::{AppId, AppIncarnation, BatchId, ContentHash, JobIndex, NodeId, NodeSession, TaskId},
    message::{
        AppHello, AppToCoordinator, Contact, CoordinatorToApp, CoordinatorToNode, CostNs, JobFailure,
        NodeHello, NodeToCoordinator, PROTOCOL_VERSION, PlanJob, PlanRequest,
    },
    program::Content,
    project::QuotaChange,
};
use proto::{
    control::{self, Invitation, Session, SessionError},
    trust::{Authority, IDENTITY_LIFETIME, Identity, JoinToken, Role},
};
use tempfile::TempDir;

/// A secured coordinator and one member of each role.
struct Farm {
    state: TempDir,
    handle: CoordinatorHandle,
    address: String,
    operator: Identity,
    node: Identity,
    app: Identity,
}

impl Farm {
    async fn start() -> Self {
        let state = tempfile::tempdir().unwrap();
        let operator = initialise(state.path(), "farm", "boss").unwrap();
        let handle = Self::coordinator(&state).await;
        let address = handle.grpc_addr().to_string();
        let node = join(&address, &operator, Role::Node, "n").await;
        let app = join(&address, &operator, Role::App, "project").await;
        Self { state, handle, address, operator, node, app }
    }

    async fn coordinator(state: &TempDir) -> CoordinatorHandle {
        let state = Some(state.path().to_owned());
        start(CoordinatorOptions { state, secured: true, ..CoordinatorOptions::embedded() }).await.unwrap()
    }

    fn fingerprint(state: &TempDir) -> [u8; 32] {
        Authority::read(&state.path().join("authority.pem")).unwrap().fingerprint()
    }

    fn audit(&self) -> String {
        fs::read_to_string(self.state.path().join("audit.ndjson")).unwrap()
    }
}

fn invitation(role: Role, name: Option<&str>) -> Invitation {
    Invitation {
        role,
        name: name.map(str::to_owned),
        lifetime: Duration::from_secs(60),
        uses: 1,
        project: None,
    }
}

async fn token(address: &str, operator: &Identity, invitation: &Invitation) -> JoinToken {
    control::create_token(address, Some(operator), invitation).await.unwrap().1
}

async fn join(address: &str, operator: &Identity, role: Role, name: &str) -> Identity {
    let token = token(address, operator, &invitation(role, None)).await;
    control::join(address, &token, Some(name)).await.unwrap()
}

fn is_denied<T>(outcome: Result<T, SessionError>) -> bool {
    matches!(outcome, Err(SessionError::Denied { .. }))
}

/// It is no matter of rights.
fn is_refused<T>(outcome: Result<T, SessionError>) -> bool {
    matches!(outcome, Err(SessionError::Refused { .. }))
}

#[tokio::test(flavor = "multi_thread")]
async fn each_role_may_do_what_the_matrix_says_and_nothing_else() {
    let farm = Farm::start().await;
    let address = farm.address.as_str();
    // What each may: see the farm, the timeline, drain, make tokens, list tokens, take one back, list members, expel, bring jobs,
    // set up a project, remove one, give devices, renew.
    let matrix: [(Option<&Identity>, [bool; 13]); 4] = [
        (
            Some(&farm.operator),
            [true, true, true, true, true, true, true, true, true, true, true, false, true],
        ),
        (
            Some(&farm.app),
            [true, true, false, false, false, false, false, false, true, false, false, false, true],
        ),
        (
            Some(&farm.node),
            [false, false, false, false, false, false, false, false, false, false, false, true, true],
        ),
        (None, [false; 13]),
    ];
    let before = control::status(address, Some(&farm.operator)).await.unwrap();
    for (who, allowed) in matrix {
        let everything = TimelineQuery { app: None, task: None, max_segments: 0 };
        let wanted = invitation(Role::App, None);
        let renewed = match who {
            Some(identity) => control::renew(address, identity).await,
            None => Err(SessionError::Denied { reason: "nobody has nothing to renew".to_owned() }),
        };
        let denied = [
            is_denied(control::status(address, who).await),
            is_denied(control::timeline(address, who, everything).await),
            // Whoever may is told that there is no such node, token or member.
            is_denied(control::drain(address, who, NodeId(999)).await),
            is_denied(control::create_token(address, who, &wanted).await),
            is_denied(control::list_tokens(address, who).await),
            is_denied(control::revoke_token(address, who, 999).await),
            is_denied(control::list_members(address, who).await),
            is_denied(control::expel(address, who, "gleaner://farm/app/nobody").await),
            is_denied(control::connect_app(address, who, &[]).await),
            is_denied(control::set_project(address, who, "default", QuotaChange::default()).await),
            is_denied(control::remove_project(address, who, "nonesuch").await),
            is_denied(control::connect_node(address, who).await),
            is_denied(renewed),
        ];
        assert_eq!(denied, allowed.map(|allowed| !allowed), "{who:?}");
    }
    assert_eq!(control::status(address, Some(&farm.operator)).await.unwrap(), before, "nothing changed");
    let audit = farm.audit();
    for what in ["see the farm", "operate the farm", "bring jobs", "give devices"] {
        let line = audit.lines().find(|line| line.contains("\"refused\"") && line.contains(what));
        assert!(line.is_some(), "no refusal to {what} in:\n{audit}");
    }
    farm.handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_token_lets_in_whom_it_is_for_once() {
    let farm = Farm::start().await;
    let address = farm.address.as_str();
    let for_a_name = token(address, &farm.operator, &invitation(Role::Node, Some("gpu-1"))).await;
    let other_secret = JoinToken { secret: [1; 16], ..for_a_name.clone() };
    assert!(is_denied(control::join(address, &other_secret, None).await), "a guessed secret");
    let other_farm = JoinToken { authority: [1; 32], ..for_a_name.clone() };
    assert!(
        is_denied(control::join(address, &other_farm, None).await),
        "another farm's coordinator is not believed"
    );
    assert!(is_denied(control::join(address, &for_a_name, Some("gpu-2")).await), "another name");
    let joined = control::join(address, &for_a_name, None).await.unwrap();
    assert_eq!(joined.principal().to_string(), "gleaner://farm/node/gpu-1");
    assert!(is_denied(control::join(address, &for_a_name, None).await), "once");
    let any_name = token(address, &farm.operator, &invitation(Role::Node, None)).await;
    assert!(is_refused(control::join(address, &any_name, Some("gpu-1")).await), "the name is somebody's");

    let (id, revoked) =
        control::create_token(address, Some(&farm.operator), &invitation(Role::App, None)).await.unwrap();
    control::revoke_token(address, Some(&farm.operator), id).await.unwrap();
    assert!(is_denied(control::join(address, &revoked, Some("x")).await), "it was taken back");
    let bad = [
        Invitation { uses: 0, ..invitation(Role::App, None) },
        Invitation { uses: 2, ..invitation(Role::App, Some("one")) },
        Invitation { lifetime: Duration::ZERO, ..invitation(Role::App, None) },
        invitation(Role::Coordinator, None),
        invitation(Role::App, Some("no/name")),
    ];
    for bad in bad {
        let refused = control::create_token(address, Some(&farm.operator), &bad).await;
        assert!(matches!(refused, Err(SessionError::Refused { .. })), "{bad:?}: {refused:?}");
    }
    farm.handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn members_of_another_farm_are_strangers_and_so_is_its_coordinator() {
    let (farm, other) = (Farm::start().await, Farm::start().await);
    let outcome = control::status(&farm.address, Some(&other.operator)).await;
    assert!(is_denied(outcome), "both farms are called the same");
    // A self-made authority of the farm's name is none.
    let forged =
        Authority::create("farm").unwrap().identity(Role::Operator, "boss", IDENTITY_LIFETIME).unwrap();
    assert!(is_denied(control::status(&farm.address, Some(&forged)).await));
    // An open farm is not this member's either.
    let open = start(CoordinatorOptions::embedded()).await.unwrap();
    let outcome = control::status(&open.grpc_addr().to_string(), Some(&farm.operator)).await;
    let said = matches!(&outcome, Err(SessionError::Denied { reason }) if reason.contains("--insecure"));
    assert!(said, "got {outcome:?}");
    open.shutdown().await;
    farm.handle.shutdown().await;
    other.handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn who_was_expelled_or_replaced_is_out_and_memberships_outlive_the_coordinator() {
    let farm = Farm::start().await;
    let operator = Some(&farm.operator);
    let uri = farm.app.principal().to_string();
    assert!(control::status(&farm.address, Some(&farm.app)).await.is_ok());
    control::expel(&farm.address, operator, &uri).await.unwrap();
    assert!(is_denied(control::status(&farm.address, Some(&farm.app)).await), "expelled");
    let members = control::list_members(&farm.address, operator).await.unwrap();
    let members: Vec<_> = members.into_iter().map(|member| member.uri).collect();
    assert_eq!(members, ["gleaner://farm/node/n", "gleaner://farm/operator/boss"]);
    let again = token(&farm.address, &farm.operator, &invitation(Role::Node, Some("n"))).await;
    let replaced = control::join(&farm.address, &again, None).await.unwrap();
    assert!(
        is_denied(control::connect_node(&farm.address, Some(&farm.node)).await),
        "its name has another key now"
    );
    assert!(is_denied(control::renew(&farm.address, &farm.node).await), "and it gets no new certificate");

    let Farm { state, handle, operator, .. } = farm;
    handle.shutdown().await;
    let handle = Farm::coordinator(&state).await;
    let address = handle.grpc_addr().to_string();
    assert!(control::status(&address, Some(&operator)).await.is_ok(), "the farm knows its members still");
    assert!(control::connect_node(&address, Some(&replaced)).await.is_ok());
    control::renew(&address, &replaced).await.unwrap();
    assert!(control::connect_node(&address, Some(&replaced)).await.is_ok(), "under the renewed certificate");
    handle.shutdown().await;
}

fn app_hello(resume: Option<(AppId, AppIncarnation)>) -> AppToCoordinator {
    AppToCoordinator::Hello(AppHello {
        protocol: PROTOCOL_VERSION,
        name: "an app".to_owned(),
        weight: 1.0,
        global_stealing: false,
        policy: String::new(),
        resume,
    })
}

/// Who belongs to a project is of it in each life of the coordinator, and its quota counts in each.
#[tokio::test(flavor = "multi_thread")]
async fn a_member_is_of_its_tokens_project_and_the_quota_outlives_the_coordinator() {
    let farm = Farm::start().await;
    let operator = Some(&farm.operator);
    let films = Invitation { project: Some("films".to_owned()), ..invitation(Role::App, None) };
    let refused = control::create_token(&farm.address, operator, &films).await;
    assert!(is_refused(refused), "a slip in a name makes no project");
    let change = QuotaChange { bytes: Some(Some(100)), weight: Some(Some(0.5)), ..QuotaChange::default() };
    let quota = control::set_project(&farm.address, operator, "films", change).await.unwrap();
    assert_eq!((quota.bytes, quota.weight, quota.devices), (Some(100), Some(0.5), None));
    let of_a_node = Invitation { role: Role::Node, ..films.clone() };
    let refused = control::create_token(&farm.address, operator, &of_a_node).await;
    assert!(is_refused(refused));
    let bad = QuotaChange { weight: Some(Some(f64::NAN)), ..QuotaChange::default() };
    let refused = control::set_project(&farm.address, operator, "films", bad).await;
    assert!(is_refused(refused));

    let token = token(&farm.address, &farm.operator, &films).await;
    let artist = control::join(&farm.address, &token, Some("artist")).await.unwrap();
    let in_use = control::remove_project(&farm.address, operator, "films").await;
    let says_who = matches!(&in_use, Err(SessionError::Refused { reason }) if reason.contains("app/artist"));
    assert!(says_who, "{in_use:?}");
    let (session, who, given) = app(&farm.address, &artist, None, &[]).await.unwrap();
    let (_other, ..) = app(&farm.address, &farm.app, None, &[]).await.unwrap();
    let projects = async |address: &str, operator: &Identity| {
        let status = control::status(address, Some(operator)).await.unwrap();
        let of = |app: AppStatus| (app.project, app.weight);
        status.apps.into_iter().map(of).collect::<Vec<_>>()
    };
    let of_films = ("films".to_owned(), 0.5);
    let both = [of_films.clone(), ("default".to_owned(), 1.0)];
    assert_eq!(projects(&farm.address, &farm.operator).await, both);

    let Farm { state, handle, operator, .. } = farm;
    drop(session);
    handle.shutdown().await;
    let handle = Farm::coordinator(&state).await;
    let address = handle.grpc_addr().to_string();
    let (mut session, ..) = app(&address, &artist, Some(who), &given).await.unwrap();
    assert_eq!(projects(&address, &operator).await, [of_films]);

    // A node, so that there is something to be refused.
    let node = join(&address, &operator, Role::Node, "m").await;
    let mut node = control::connect_node(&address, Some(&node)).await.unwrap();
    node.sender.try_send(node_hello("m")).unwrap();
    assert!(matches!(node.receiver.recv().await, Ok(CoordinatorToNode::Welcome { .. })));
    let heard = node.receiver.recv().await.unwrap();
    let CoordinatorToNode::AppsJoined(apps) = heard else { panic!("{heard:?}") };
    let (_, terms) = &apps[0];
    assert_eq!((terms.project.as_str(), terms.weight, terms.result_bytes), ("films", 0.5, Some(100)));
    let content = Content { hash: ContentHash([7; 32]), size_bytes: 101 };
    let request = PlanRequest {
        batch: BatchId(1),
        task: TaskId(0),
        jobs: (0..3).map(|index| PlanJob { index: JobIndex(index), cost: CostNs(1) }).collect(),
        needs: Requirements::ANY,
        module: None,
        contents: vec![content],
        held: Vec::new(),
    };
    session.sender.try_send(AppToCoordinator::Plan(request)).unwrap();
    for _ in 0..3 {
        let heard = session.receiver.recv().await.unwrap();
        let over = matches!(&heard, CoordinatorToApp::JobFailed { failure: JobFailure::OverQuota(_), .. });
        assert!(over, "{heard:?}");
    }
    let audit = fs::read_to_string(state.path().join("audit.ndjson")).unwrap();
    let refusals =
        audit.lines().filter(|line| line.contains("\"refused\"") && line.contains("101 B")).count();
    assert_eq!(refusals, 1, "once for the batch:\n{audit}");
    assert!(audit.contains("\"project set\""), "{audit}");
    handle.shutdown().await;
}

fn node_hello(name: &str) -> NodeToCoordinator {
    let device = DeviceInfo {
        name: "simulated".to_owned(),
        kind: DeviceKind::Simulated,
        score: 1_000.0,
        features: Features::default(),
        limits: Limits::UNBOUNDED,
    };
    NodeToCoordinator::Hello(NodeHello {
        protocol: PROTOCOL_VERSION,
        node: None,
        name: name.to_owned(),
        session: NodeSession(77),
        devices: vec![device],
        contact: Contact { addresses: vec!["127.0.0.1:9".to_owned()], certificate_der: vec![1, 2, 3] },
        inventory: Vec::new(),
    })
}

type AppSession = Session<AppToCoordinator, CoordinatorToApp>;
type Who = (AppId, AppIncarnation);

/// An application's session, who it is, and what it was given to show. It may come back as somebody.
async fn app(
    address: &str,
    identity: &Identity,
    resume: Option<Who>,
    shown: &[u8],
) -> Result<(AppSession, Who, Vec<u8>), SessionError> {
    let mut session = control::connect_app(address, Some(identity), shown).await?;
    session.sender.try_send(app_hello(resume)).unwrap();
    let CoordinatorToApp::Capability(given) = session.receiver.recv().await? else {
        panic!("before the welcome comes what is to be shown")
    };
    let CoordinatorToApp::Welcome { app, incarnation, .. } = session.receiver.recv().await? else {
        panic!("then comes the welcome")
    };
    Ok((session, (app, incarnation), given))
}

/// The hostile test of 2026-11-26: numbers of applications are no secret, and a coordinator that had forgotten, or never known, who
/// had one gave it to the first who said it.
#[tokio::test(flavor = "multi_thread")]
async fn nobody_goes_on_as_somebody_elses_application() {
    let farm = Farm::start().await;
    let other = join(&farm.address, &farm.operator, Role::App, "other").await;
    let (session, who, given) = app(&farm.address, &farm.app, None, &[]).await.unwrap();
    let (others, _, others_own) = app(&farm.address, &other, None, &[]).await.unwrap();
    drop(others);
    for shown in [&[][..], &given, &others_own, b"nonsense"] {
        assert!(is_denied(app(&farm.address, &other, Some(who), shown).await), "showing {} B", shown.len());
    }
    let status = control::status(&farm.address, Some(&farm.operator)).await.unwrap();
    let connected = status.apps.iter().find(|app| app.app == who.0).unwrap().connected;
    assert!(connected, "its owner's session stands");
    drop(session);
    let (_, back, _) = app(&farm.address, &farm.app, Some(who), &given).await.unwrap();
    assert_eq!(back.0, who.0, "the owner may");
    assert!(farm.audit().contains("does not show that app-1 is its own"), "{}", farm.audit());

    let Farm { state, handle, app: owner, .. } = farm;
    handle.shutdown().await;
    let handle = Farm::coordinator(&state).await;
    let address = handle.grpc_addr().to_string();
    for shown in [&[][..], &given, &others_own] {
        assert!(
            is_denied(app(&address, &other, Some(who), shown).await),
            "after a restart, {} B",
            shown.len()
        );
    }
    let (_, back, _) = app(&address, &owner, Some(who), &given).await.unwrap();
    assert_eq!(back.0, who.0, "the earlier coordinator's word still counts");
    handle.shutdown().await;
}

/// Only its member ends an application before its lease does; who tries goes on, and what was tried is written down.
#[tokio::test(flavor = "multi_thread")]
async fn nobody_ends_somebody_elses_application() {
    let farm = Farm::start().await;
    let other = join(&farm.address, &farm.operator, Role::App, "other").await;
    let (session, (predecessor, _), _) = app(&farm.address, &farm.app, None, &[]).await.unwrap();
    drop(session);
    let is_there = async || {
        let status = control::status(&farm.address, Some(&farm.operator)).await.unwrap();
        status.apps.iter().any(|app| app.app == predecessor)
    };
    let mut answers = Vec::new();
    for who in [&other, &farm.operator, &farm.app] {
        let (mut session, ..) = app(&farm.address, who, None, &[]).await.unwrap();
        session.sender.try_send(AppToCoordinator::Supersede(predecessor)).unwrap();
        session.sender.try_send(AppToCoordinator::Heartbeat { sequence: 1, unanswered: false }).unwrap();
        let heard = session.receiver.recv().await.unwrap();
        assert!(matches!(heard, CoordinatorToApp::HeartbeatAck { sequence: 1 }), "{heard:?}");
        // Its end may be noticed after that.
        if who.principal() == farm.app.principal() {
            while is_there().await {
                tokio::task::yield_now().await;
            }
        }
        answers.push(is_there().await);
    }
    assert_eq!(answers, [true, true, false], "its own member alone");
    let audit = farm.audit();
    let refusals: Vec<&str> =
        audit.lines().filter(|line| line.contains("supersede an application")).collect();
    assert_eq!(refusals.len(), 2, "{audit}");
    assert!(refusals[0].contains("app/other") && refusals[0].contains("app-1 is"), "{audit}");
    farm.handle.shutdown().await;
}

/// The hostile test of 2026-11-26, further findings.
#[tokio::test(flavor = "multi_thread")]
async fn who_is_out_is_out_at_once_and_so_is_whom_they_invited() {
    let farm = Farm::start().await;
    let second = join(&farm.address, &farm.operator, Role::Operator, "second").await;
    let by_second = token(&farm.address, &second, &invitation(Role::Operator, None)).await;
    let (mut session, ..) = app(&farm.address, &farm.app, None, &[]).await.unwrap();
    let operator = Some(&farm.operator);
    for member in [&farm.app, &second] {
        control::expel(&farm.address, operator, &member.principal().to_string()).await.unwrap();
    }
    assert!(is_denied(session.receiver.recv().await), "an open session ends");
    assert!(
        is_denied(control::join(&farm.address, &by_second, Some("third")).await),
        "its tokens are taken back"
    );
    let last = control::expel(&farm.address, operator, &farm.operator.principal().to_string()).await;
    assert!(is_refused(last), "the last operator stays");

    let old_token = token(&farm.address, &farm.operator, &invitation(Role::Operator, None)).await;
    let Farm { state, handle, operator, .. } = farm;
    handle.shutdown().await;
    fs::remove_file(state.path().join("authority.pem")).unwrap();
    let options =
        || CoordinatorOptions { state: Some(state.path().to_owned()), ..CoordinatorOptions::embedded() };
    let error = start(options()).await.unwrap_err().to_string();
    assert!(error.contains("authority.pem"), "a farm with members does not become open by itself: {error}");
    start(CoordinatorOptions { insecure: true, ..options() }).await.unwrap().shutdown().await;
    initialise(state.path(), "farm", "anew").unwrap();
    let handle = Farm::coordinator(&state).await;
    let address = handle.grpc_addr().to_string();
    assert!(is_denied(control::status(&address, Some(&operator)).await));
    let secret_known = JoinToken { authority: Farm::fingerprint(&state), ..old_token };
    assert!(is_denied(control::join(&address, &secret_known, Some("old")).await), "another farm's token");
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_node_has_the_name_of_its_identity() {
    let farm = Farm::start().await;
    let register = async |name: &str| {
        let mut session = control::connect_node(&farm.address, Some(&farm.node)).await.unwrap();
        session.sender.try_send(node_hello(name)).unwrap();
        session.receiver.recv().await
    };
    assert!(is_denied(register("somebody-else").await));
    let status = control::status(&farm.address, Some(&farm.operator)).await.unwrap();
    assert!(status.nodes.is_empty(), "nothing came of it");
    assert!(matches!(register("n").await, Ok(CoordinatorToNode::Welcome { .. })));
    assert!(matches!(register("n/second").await, Ok(CoordinatorToNode::Welcome { .. })));
    farm.handle.shutdown().await;
}

#[test]
fn a_farm_is_secured_once() {
    let state = tempfile::tempdir().unwrap();
    initialise(state.path(), "farm", "boss").unwrap();
    let error = initialise(state.path(), "farm", "boss").unwrap_err().to_string();
    assert!(error.contains("secured already") && error.contains("authority.pem"), "got {error}");
    assert!(initialise(tempfile::tempdir().unwrap().path(), "no farm", "boss").is_err());
}
