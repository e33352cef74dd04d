//! What `farmctl` asks a coordinator as an operator.

use farm_core::{
    coordinator::{
        FarmStatus,
        timeline::{Timeline, TimelineQuery},
    },
    id::NodeId,
};
use proto::control::{self, SessionError};

use crate::failure::Failure;

/// Where `farmctl up` and `farm-coordinator` listen unless told otherwise.
const DEFAULT_COORDINATOR: &str = "127.0.0.1:7700";

/// The coordinator that operator verbs talk to.
#[derive(Debug)]
pub(crate) struct Admin<'a> {
    address: &'a str,
}

impl<'a> Admin<'a> {
    /// The configured coordinator, or the one at the usual place.
    pub(crate) fn new(coordinator: Option<&'a str>) -> Self {
        Self { address: coordinator.unwrap_or(DEFAULT_COORDINATOR) }
    }

    /// How the farm stands.
    pub(crate) async fn status(&self) -> Result<FarmStatus, Failure> {
        control::status(self.address).await.map_err(failure)
    }

    /// What ran when and where.
    pub(crate) async fn timeline(&self, query: TimelineQuery) -> Result<Timeline, Failure> {
        control::timeline(self.address, query).await.map_err(failure)
    }

    /// Lets a node finish and leave.
    pub(crate) async fn drain(&self, node: NodeId) -> Result<(), Failure> {
        control::drain(self.address, node).await.map_err(failure)
    }
}

fn failure(error: SessionError) -> Failure {
    match error {
        SessionError::Address { .. } => Failure::Usage(error.into()),
        SessionError::Unreachable { .. } => Failure::Unreachable(anyhow::Error::new(error).context(
            "no farm answers; start one with `farmctl up`, or name it with --coordinator or GLEANER_COORDINATOR",
        )),
        SessionError::Ended { .. }
        | SessionError::Malformed { .. }
        | SessionError::Refused { .. }
        | SessionError::Full => Failure::Work(error.into()),
    }
}
