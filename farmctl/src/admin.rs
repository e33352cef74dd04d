//! What `farmctl` asks a coordinator as an operator.

use farm_core::{
    coordinator::{
        ContentsStatus, FarmStatus, NodeStatus,
        timeline::{Timeline, TimelineQuery},
    },
    id::{ContentHash, NodeId},
    project::{Quota, QuotaChange},
};
use proto::{
    control::{
        self, Invitation, SessionError,
        v1::{MemberStatus, TokenStatus},
    },
    trust::{Identity, JoinToken},
};

use crate::{
    failure::Failure,
    output::printable,
    target::{DEFAULT_COORDINATOR, Reach},
};

/// The coordinator that operator verbs talk to.
#[derive(Debug)]
pub(crate) struct Admin {
    reach: Reach,
}

impl Admin {
    pub(crate) const fn new(reach: Reach) -> Self {
        Self { reach }
    }

    fn to(&self) -> (&str, Option<&Identity>) {
        (&self.reach.address, self.reach.identity.as_ref())
    }

    /// How the farm stands.
    pub(crate) async fn status(&self) -> Result<FarmStatus, Failure> {
        let (address, identity) = self.to();
        control::status(address, identity).await.map_err(failure)
    }

    /// The node of this name or id.
    pub(crate) async fn find_node(&self, wanted: &str) -> Result<NodeStatus, Failure> {
        let mut nodes = self.status().await?.nodes;
        let is_it = |node: &NodeStatus| {
            node.name == wanted || node.node.to_string() == wanted || node.node.0.to_string() == wanted
        };
        match nodes.iter().position(is_it) {
            Some(position) => Ok(nodes.swap_remove(position)),
            None => {
                let names: Vec<String> = nodes.iter().map(|node| printable(&node.name)).collect();
                Err(Failure::Work(anyhow::anyhow!(
                    "there is no node {wanted:?}; the farm has: {}",
                    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
                )))
            }
        }
    }

    /// What large contents nodes hold.
    pub(crate) async fn contents(&self) -> Result<ContentsStatus, Failure> {
        let (address, identity) = self.to();
        control::contents(address, identity).await.map_err(failure)
    }

    /// Has nodes drop contents that no job needs.
    pub(crate) async fn evict(&self, node: Option<NodeId>, contents: &[ContentHash]) -> Result<(), Failure> {
        let (address, identity) = self.to();
        control::evict(address, identity, node, contents).await.map_err(failure)
    }

    /// What ran when and where.
    pub(crate) async fn timeline(&self, query: TimelineQuery) -> Result<Timeline, Failure> {
        let (address, identity) = self.to();
        control::timeline(address, identity, query).await.map_err(failure)
    }

    /// Lets a node finish and leave.
    pub(crate) async fn drain(&self, node: NodeId) -> Result<(), Failure> {
        let (address, identity) = self.to();
        control::drain(address, identity, node).await.map_err(failure)
    }

    /// Makes a join token; gives its number, too.
    pub(crate) async fn create_token(&self, invitation: &Invitation) -> Result<(u64, JoinToken), Failure> {
        let (address, identity) = self.to();
        control::create_token(address, identity, invitation).await.map_err(failure)
    }

    /// The tokens that can still be used.
    pub(crate) async fn tokens(&self) -> Result<Vec<TokenStatus>, Failure> {
        let (address, identity) = self.to();
        control::list_tokens(address, identity).await.map_err(failure)
    }

    /// Takes a token back.
    pub(crate) async fn revoke_token(&self, id: u64) -> Result<(), Failure> {
        let (address, identity) = self.to();
        control::revoke_token(address, identity, id).await.map_err(failure)
    }

    /// The farm's members.
    pub(crate) async fn members(&self) -> Result<Vec<MemberStatus>, Failure> {
        let (address, identity) = self.to();
        control::list_members(address, identity).await.map_err(failure)
    }

    /// Makes a project, or changes what it may have; gives what it may have now.
    pub(crate) async fn set_project(&self, project: &str, change: QuotaChange) -> Result<Quota, Failure> {
        let (address, identity) = self.to();
        control::set_project(address, identity, project, change).await.map_err(failure)
    }

    /// Removes a project that nobody belongs to.
    pub(crate) async fn remove_project(&self, project: &str) -> Result<(), Failure> {
        let (address, identity) = self.to();
        control::remove_project(address, identity, project).await.map_err(failure)
    }

    /// Ends a membership.
    pub(crate) async fn expel(&self, uri: &str) -> Result<(), Failure> {
        let (address, identity) = self.to();
        control::expel(address, identity, uri).await.map_err(failure)
    }
}

/// What a failed request is to the one who asked.
pub(crate) fn failure(error: SessionError) -> Failure {
    match error {
        // There is no such thing, or what there is stands against it.
        SessionError::Address { .. } | SessionError::Refused { .. } => Failure::Usage(error.into()),
        SessionError::Unreachable { ref address, .. } => {
            let hint = if address.contains(',') {
                "none of the coordinators answers; if one just ended, its standby leads within some 10 s: try again then"
            } else if address == DEFAULT_COORDINATOR {
                "no farm answers; start one with `farmctl up`, or name it with --coordinator or GLEANER_COORDINATOR"
            } else {
                "no farm answers there; is its coordinator up, and is that its address?"
            };
            Failure::Unreachable(anyhow::Error::new(error).context(hint))
        }
        SessionError::Denied { .. } => Failure::Denied(error.into()),
        SessionError::Ended { .. }
        | SessionError::Malformed { .. }
        | SessionError::Failed { .. }
        | SessionError::UnknownRequest
        | SessionError::Full => Failure::Work(error.into()),
    }
}
