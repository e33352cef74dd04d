//! What a successor finds in the state directory of a coordinator that it takes the farm over from, and what that one may still do.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{io::Write as _, time::Duration};

use coordinator::{CoordinatorHandle, CoordinatorOptions, StartError, Vacancy, initialise, stand_by, start};
use farm_core::message::Liveness;
use proto::{
    control::{self, Invitation, SessionError},
    trust::Role,
};

fn options(state: &tempfile::TempDir, vacancy: Option<Vacancy>) -> CoordinatorOptions {
    let state = Some(state.path().to_owned());
    CoordinatorOptions { state, vacancy, secured: true, ..CoordinatorOptions::embedded() }
}

const SILENT: Vacancy = Vacancy { term: 1, silent: true };

fn address(handle: &CoordinatorHandle) -> String {
    handle.grpc_addr().to_string()
}

fn invitation() -> Invitation {
    let lifetime = Duration::from_secs(60);
    Invitation { role: Role::App, name: None, lifetime, uses: 1, project: None }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_successor_has_what_was_acknowledged_and_its_predecessor_changes_nothing() {
    let state = tempfile::tempdir().unwrap();
    let operator = initialise(state.path(), "farm", "boss").unwrap();
    let first = start(options(&state, None)).await.unwrap();
    let (_, token) = control::create_token(&address(&first), Some(&operator), &invitation()).await.unwrap();

    // Alive as it is: what a standby does when it has been silent for long enough.
    let second = start(options(&state, Some(SILENT))).await.unwrap();
    let refused = control::create_token(&address(&first), Some(&operator), &invitation()).await.unwrap_err();
    let SessionError::Failed { reason } = &refused else { panic!("{refused:?}") };
    assert!(reason.contains("another coordinator has taken the farm over"), "{reason}");
    first.stopped().await;

    let joined = control::join(&address(&second), &token, Some("artist")).await;
    joined.expect("the token that was acknowledged is there");
    let members = control::list_members(&address(&second), Some(&operator)).await.unwrap();
    assert!(members.iter().any(|member| member.uri == "gleaner://farm/app/artist"), "{members:?}");
    let tokens = control::list_tokens(&address(&second), Some(&operator)).await.unwrap();
    assert!(tokens.is_empty(), "what the first one refused is not there: {tokens:?}");
    drop(first);
    assert!(matches!(start(options(&state, Some(SILENT))).await, Err(StartError::Outrun)), "one follows");
    assert!(
        matches!(start(options(&state, None)).await, Err(StartError::InUse { .. })),
        "who does not stand by is refused while another one leads"
    );
    second.shutdown().await;

    let third = start(options(&state, None)).await.unwrap();
    let members = control::list_members(&address(&third), Some(&operator)).await.unwrap();
    assert!(members.iter().any(|member| member.uri == "gleaner://farm/app/artist"), "{members:?}");
    third.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_standby_follows_a_leader_that_ended_without_waiting() {
    let state = tempfile::tempdir().unwrap();
    initialise(state.path(), "farm", "boss").unwrap();
    let liveness = Liveness { dead_ms: 3_600_000, ..Liveness::default() };
    let first = start(options(&state, None)).await.unwrap();
    let directory = state.path().to_owned();
    let waiting = tokio::spawn(async move { stand_by(&directory, liveness).await });
    first.shutdown().await;
    assert_eq!(
        waiting.await.unwrap().unwrap(),
        Vacancy { term: 1, silent: false },
        "its process lets go of the lock"
    );
}

/// Of several addresses the one that leads is found, whichever it is; one that only takes connections does not count.
#[tokio::test(flavor = "multi_thread")]
async fn the_coordinator_that_answers_is_found() {
    let handle = start(CoordinatorOptions::embedded()).await.unwrap();
    let mute = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let mute = mute.local_addr().map(|address| (mute, address.to_string())).unwrap();
    let closed = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    for list in [
        format!("{},{closed},{}", mute.1, address(&handle)),
        format!("{},{},{closed}", address(&handle), mute.1),
    ] {
        control::status(&list, None).await.unwrap();
    }
    // One that leads while the mute one is waited for is found, too.
    let later = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let list = format!("{}, {later}", mute.1);
    let (found, standby) = tokio::join!(control::status(&list, None), async {
        tokio::time::sleep(Duration::from_millis(500)).await;
        start(CoordinatorOptions { listen: later, ..CoordinatorOptions::embedded() }).await.unwrap()
    });
    found.unwrap();
    standby.shutdown().await;
    // Somebody else's port beside it is not the farm's answer.
    let other = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let stranger = other.local_addr().unwrap();
    std::thread::spawn(move || {
        for stream in other.incoming() {
            let _ = stream.unwrap().write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n");
        }
    });
    for _ in 0..8 {
        control::status(&format!("{stranger},{}", address(&handle)), None).await.unwrap();
    }
    let error = control::status(&format!("{closed},{}", mute.1), None).await.unwrap_err().to_string();
    assert!(error.contains(&closed) && error.contains("no answer within"), "{error}");
    handle.shutdown().await;
}
