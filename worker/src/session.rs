//! The connection to the coordinator: made at the start within a bounded time, and made again, for as long as the worker
//! lives, with a bounded pause between tries.

use std::time::{Duration, SystemTime};

use farm_core::message::{CoordinatorToNode, NodeToCoordinator};
use proto::{
    control::{Session, SessionError, SessionReceiver, connect_node, renew},
    trust::Identity,
};
use tokio::{
    sync::mpsc,
    time::{Instant, sleep, sleep_until},
};

use crate::driver::Input;

/// A node's session with its coordinator.
pub(crate) type NodeLink = Session<NodeToCoordinator, CoordinatorToNode>;

/// First pause between tries; doubled up to [`LONGEST_PAUSE`].
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// Longest pause between tries.
const LONGEST_PAUSE: Duration = Duration::from_secs(2);
/// Pause after the farm did not let this node in any more.
const DENIED_PAUSE: Duration = Duration::from_secs(30);
/// How often the node looks whether its certificate is to be renewed.
const RENEWAL_CHECK: Duration = Duration::from_secs(3_600);

/// Connects at the start, trying for at most `timeout`.
pub(crate) async fn first(
    coordinator: &str,
    identity: Option<&Identity>,
    timeout: Duration,
) -> Result<NodeLink, SessionError> {
    let deadline = Instant::now() + timeout;
    let mut pause = FIRST_PAUSE;
    loop {
        let error = match connect_node(coordinator, identity).await {
            Ok(session) => return Ok(session),
            Err(
                error @ (SessionError::Address { .. }
                | SessionError::Malformed { .. }
                | SessionError::Denied { .. }),
            ) => return Err(error),
            Err(error) => error,
        };
        if Instant::now() + pause >= deadline {
            return Err(error);
        }
        tracing::info!(%error, "trying again");
        sleep_until(Instant::now() + pause).await;
        pause = (pause * 2).min(LONGEST_PAUSE);
    }
}

/// Connects again, however long it takes; gives the session to the driver.
pub(crate) async fn again(coordinator: String, identity: Option<Identity>, inputs: mpsc::Sender<Input>) {
    let mut pause = FIRST_PAUSE;
    loop {
        sleep(pause).await;
        match connect_node(&coordinator, identity.as_ref()).await {
            Ok(session) => {
                // Without a driver the worker has ended, and the session with it.
                let _ = inputs.send(Input::Connected(session)).await;
                return;
            }
            Err(error @ SessionError::Denied { .. }) => {
                tracing::warn!(%error, "trying again");
                // Only an operator changes that.
                sleep(DENIED_PAUSE).await;
            }
            Err(error) => tracing::debug!(%error, "trying again"),
        }
        pause = (pause * 2).min(LONGEST_PAUSE);
    }
}

/// Renews the node's certificate in time, for as long as it is polled.
pub(crate) async fn stay_valid(coordinator: String, identity: Identity) {
    loop {
        if identity.renew_at() <= SystemTime::now() {
            match renew(&coordinator, &identity).await {
                Ok(()) => tracing::info!("the node's certificate is renewed"),
                Err(error) => {
                    tracing::warn!(%error, "the node's certificate could not be renewed, trying again")
                }
            }
        }
        sleep(RENEWAL_CHECK).await;
    }
}

/// Passes on what the coordinator says in session `serial`, until it ends.
pub(crate) async fn listen(
    serial: u64,
    mut receiver: SessionReceiver<CoordinatorToNode>,
    inputs: mpsc::Sender<Input>,
) {
    loop {
        let input = match receiver.recv().await {
            Ok(message) => Input::CoordinatorSaid { serial, message },
            Err(error) => Input::CoordinatorEnded { serial, error },
        };
        let over = matches!(input, Input::CoordinatorEnded { .. });
        if inputs.send(input).await.is_err() || over {
            return;
        }
    }
}
