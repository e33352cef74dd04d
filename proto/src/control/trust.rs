//! The client's end of joining: tokens made and used, certificates renewed.

use std::time::Duration;

use farm_core::project::{Quota, QuotaChange};
use tonic::{Request, transport::Channel};

use super::{
    MAX_MESSAGE_BYTES, SessionError, WireError,
    convert::set_project_request,
    session::{channel, within_timeout},
    transport,
    v1::{self, trust_client::TrustClient},
};
use crate::{
    tls,
    trust::{Identity, JoinToken, Membership, NewKey, Role},
};

/// Who may join by a token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Invitation {
    /// What who joins becomes.
    pub role: Role,
    /// The name that who joins gets; `None`: any that nobody has.
    pub name: Option<String>,
    /// How long the token can be used.
    pub lifetime: Duration,
    /// How often.
    pub uses: u32,
    /// The project of who joins; `None`: `default`.
    pub project: Option<String>,
}

/// Makes a join token. For operators.
///
/// # Errors
/// Nobody answers, the caller is no operator, or the invitation is not one.
pub async fn create_token(
    coordinator: &str,
    identity: Option<&Identity>,
    invitation: &Invitation,
) -> Result<(u64, JoinToken), SessionError> {
    let request = v1::CreateTokenRequest {
        role: invitation.role.to_string(),
        name: invitation.name.clone().unwrap_or_default(),
        lifetime_s: invitation.lifetime.as_secs(),
        uses: invitation.uses,
        project: invitation.project.clone().unwrap_or_default(),
    };
    let mut client = client(channel(coordinator, identity).await?);
    let made = within_timeout(coordinator, client.create_token(Request::new(request))).await?.into_inner();
    let secret = made.secret.try_into().map_err(|_| bad("CreateTokenResponse.secret"))?;
    let authority = made.authority.try_into().map_err(|_| bad("CreateTokenResponse.authority"))?;
    Ok((made.id, JoinToken { secret, authority }))
}

/// The tokens that can still be used. For operators.
///
/// # Errors
/// Nobody answers, or the caller is no operator.
pub async fn list_tokens(
    coordinator: &str,
    identity: Option<&Identity>,
) -> Result<Vec<v1::TokenStatus>, SessionError> {
    let mut client = client(channel(coordinator, identity).await?);
    let answer =
        within_timeout(coordinator, client.list_tokens(Request::new(v1::ListTokensRequest {}))).await?;
    Ok(answer.into_inner().tokens)
}

/// Takes a token back. For operators.
///
/// # Errors
/// Nobody answers, the caller is no operator, or there is no such token.
pub async fn revoke_token(
    coordinator: &str,
    identity: Option<&Identity>,
    id: u64,
) -> Result<(), SessionError> {
    let mut client = client(channel(coordinator, identity).await?);
    within_timeout(coordinator, client.revoke_token(Request::new(v1::RevokeTokenRequest { id }))).await?;
    Ok(())
}

/// The farm's members, in order. For operators.
///
/// # Errors
/// Nobody answers, or the caller is no operator.
pub async fn list_members(
    coordinator: &str,
    identity: Option<&Identity>,
) -> Result<Vec<v1::MemberStatus>, SessionError> {
    let mut client = client(channel(coordinator, identity).await?);
    let answer =
        within_timeout(coordinator, client.list_members(Request::new(v1::ListMembersRequest {}))).await?;
    Ok(answer.into_inner().members)
}

/// Ends a membership. For operators.
///
/// # Errors
/// Nobody answers, the caller is no operator, or there is no such member.
pub async fn expel(coordinator: &str, identity: Option<&Identity>, uri: &str) -> Result<(), SessionError> {
    let mut client = client(channel(coordinator, identity).await?);
    let request = v1::ExpelRequest { uri: uri.to_owned() };
    within_timeout(coordinator, client.expel(Request::new(request))).await?;
    Ok(())
}

/// Makes a project, or changes what it may have; gives what it may have now. For operators.
///
/// # Errors
/// Nobody answers, the caller is no operator, the name or a bound is none, or there are too many projects.
pub async fn set_project(
    coordinator: &str,
    identity: Option<&Identity>,
    project: &str,
    change: QuotaChange,
) -> Result<Quota, SessionError> {
    let mut client = client(channel(coordinator, identity).await?);
    let request = set_project_request(project, change);
    let answer = within_timeout(coordinator, client.set_project(Request::new(request))).await?;
    let quota = answer.into_inner().quota.ok_or(WireError::Missing { field: "SetProjectResponse.quota" })?;
    Ok(quota.try_into()?)
}

/// Removes a project that nobody belongs to. For operators.
///
/// # Errors
/// Nobody answers, the caller is no operator, there is no such project, or somebody belongs to it.
pub async fn remove_project(
    coordinator: &str,
    identity: Option<&Identity>,
    project: &str,
) -> Result<(), SessionError> {
    let mut client = client(channel(coordinator, identity).await?);
    let request = v1::RemoveProjectRequest { project: project.to_owned() };
    within_timeout(coordinator, client.remove_project(Request::new(request))).await?;
    Ok(())
}

/// Becomes a member by a token, under a key made here, which stays here.
///
/// # Errors
/// Nobody answers, who answers is not the token's coordinator, or it does not let the caller in.
pub async fn join(
    coordinator: &str,
    token: &JoinToken,
    name: Option<&str>,
) -> Result<Identity, SessionError> {
    let denied = |reason: String| SessionError::Denied { reason };
    let key = NewKey::generate().map_err(|error| denied(error.to_string()))?;
    let request = v1::JoinRequest {
        secret: token.secret.to_vec(),
        name: name.unwrap_or_default().to_owned(),
        request_der: key.request().map_err(|error| denied(error.to_string()))?,
    };
    let config = tls::join_client_config(token.authority).map_err(|error| denied(error.to_string()))?;
    let mut client = client(transport::connect(coordinator, Some(config)).await?);
    let answer = within_timeout(coordinator, client.join(Request::new(request))).await?.into_inner();
    if *blake3::hash(&answer.authority_der).as_bytes() != token.authority {
        return Err(denied("the coordinator answers with another farm's authority".to_owned()));
    }
    key.join(&membership(answer)).map_err(|error| denied(error.to_string()))
}

/// Gets a new certificate for an identity and takes it into use.
///
/// # Errors
/// Nobody answers, the coordinator refuses, or the identity's file cannot be written.
pub async fn renew(coordinator: &str, identity: &Identity) -> Result<(), SessionError> {
    let denied = |reason: String| SessionError::Denied { reason };
    let request_der = identity.request().map_err(|error| denied(error.to_string()))?;
    let mut client = client(channel(coordinator, Some(identity)).await?);
    let answer =
        within_timeout(coordinator, client.renew(Request::new(v1::RenewRequest { request_der }))).await?;
    identity.renew(&membership(answer.into_inner())).map_err(|error| denied(error.to_string()))
}

fn client(channel: Channel) -> TrustClient<Channel> {
    TrustClient::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES)
}

fn membership(wire: v1::Membership) -> Membership {
    Membership { certificate_der: wire.certificate_der, authority_der: wire.authority_der }
}

fn bad(field: &'static str) -> SessionError {
    WireError::Invalid { field, value: "not of its length".to_owned() }.into()
}
