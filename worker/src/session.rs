//! The connection to the coordinator: made at the start within a bounded time, and made again, for as long as the worker
//! lives, with a bounded pause between tries.

use std::time::Duration;

use farm_core::message::{CoordinatorToNode, NodeToCoordinator};
use proto::control::{Session, SessionError, SessionReceiver, connect_node};
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

/// Connects at the start, trying for at most `timeout`.
pub(crate) async fn first(coordinator: &str, timeout: Duration) -> Result<NodeLink, SessionError> {
    let deadline = Instant::now() + timeout;
    let mut pause = FIRST_PAUSE;
    loop {
        let error = match connect_node(coordinator).await {
            Ok(session) => return Ok(session),
            Err(error @ (SessionError::Address { .. } | SessionError::Malformed { .. })) => {
                return Err(error);
            }
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
pub(crate) async fn again(coordinator: String, inputs: mpsc::Sender<Input>) {
    let mut pause = FIRST_PAUSE;
    loop {
        sleep(pause).await;
        match connect_node(&coordinator).await {
            Ok(session) => {
                // Without a driver the worker has ended, and the session with it.
                let _ = inputs.send(Input::Connected(session)).await;
                return;
            }
            Err(error) => tracing::debug!(%error, "trying again"),
        }
        pause = (pause * 2).min(LONGEST_PAUSE);
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
