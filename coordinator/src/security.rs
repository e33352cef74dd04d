//! A secured farm's coordinator: who may do what, who may join, and the capabilities that nodes ask applications for
//! (20-delivery.md "Security").

use std::{
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, SystemTime},
};

use farm_core::{
    id::{AppId, AppIncarnation, Epoch},
    project::DEFAULT_PROJECT,
};
use proto::{
    control::{
        Caller, quota_change,
        v1::{self, trust_server::Trust},
    },
    trust::{
        Authority, Capability, IDENTITY_LIFETIME, Identity, Member, Membership, Principal, Role,
        SECRET_BYTES, check_name, unix_now,
    },
};
use serde_json::json;
use tokio::sync::Mutex;
use tonic::{Extensions, Request, Response, Status};

use crate::{
    StartError,
    audit::Audit,
    owner::OwnerHandle,
    store::{Store, StoreError, Token},
};

/// The authority's file in the state directory: a coordinator that finds it lets members alone in.
pub const AUTHORITY_FILE: &str = "authority.pem";
/// What the coordinator calls itself.
const COORDINATOR_NAME: &str = "coordinator";
/// How long a capability counts; a new one comes when half of it is over.
pub(crate) const CAPABILITY_LIFETIME: Duration = Duration::from_secs(24 * 3_600);
/// How often the coordinator looks whether its own certificate is to be renewed.
const RENEWAL_CHECK: Duration = Duration::from_secs(3_600);
/// Longest life of a token, in seconds: a year.
const MAX_TOKEN_LIFETIME_S: u64 = 365 * 86_400;
/// Most uses of a token.
const MAX_TOKEN_USES: u32 = 100_000;

/// What a secured coordinator holds.
#[derive(Debug)]
pub(crate) struct Security {
    authority: Authority,
    identity: Identity,
    store: Arc<Store>,
    audit: Audit,
}

/// Whether members alone are let in.
#[derive(Clone, Debug)]
pub(crate) enum Gate {
    /// Everyone is.
    Open,
    /// They are.
    Members(Arc<Security>),
}

/// What callers ask for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Action {
    /// Bring jobs.
    Compute,
    /// Give devices.
    Serve,
    /// See how the farm stands and what ran.
    Look,
    /// Drain nodes, make tokens.
    Operate,
    /// Keep one's membership.
    Renew,
}

impl Action {
    /// The authorisation matrix.
    const fn roles(self) -> &'static [Role] {
        match self {
            Self::Compute => &[Role::App, Role::Operator],
            Self::Serve => &[Role::Node],
            Self::Look => &[Role::App, Role::Operator],
            Self::Operate => &[Role::Operator],
            Self::Renew => &[Role::Node, Role::App, Role::Operator],
        }
    }

    const fn word(self) -> &'static str {
        match self {
            Self::Compute => "bring jobs",
            Self::Serve => "give devices",
            Self::Look => "see the farm",
            Self::Operate => "operate the farm",
            Self::Renew => "renew a certificate",
        }
    }
}

impl Gate {
    /// Whether a caller may do something. Gives who it is; `None` where nobody is asked.
    pub(crate) fn admit(&self, extensions: &Extensions, action: Action) -> Result<Option<Member>, Status> {
        let Self::Members(security) = self else { return Ok(None) };
        let caller = extensions.get::<Caller>();
        let address = caller.map_or_else(String::new, |caller| caller.address.to_string());
        let Some(member) = caller.and_then(|caller| caller.member.clone()) else {
            let reason = "this farm is secured and you are no member: `farmctl join TOKEN`, with a token of its operator";
            security.audit.refused(action.word(), &address, "not a member");
            return Err(Status::unauthenticated(reason));
        };
        let who = format!("{} at {address}", member.principal);
        let refuse = |reason: String| {
            security.audit.refused(action.word(), &who, &reason);
            Err(Status::permission_denied(reason))
        };
        if !action.roles().contains(&member.principal.role) {
            return refuse(format!("{} may not {}", member.principal, action.word()));
        }
        match security.store.is_member(&member) {
            Ok(true) => Ok(Some(member)),
            Ok(false) => {
                refuse(format!("{} is no member any more, or joined anew elsewhere", member.principal))
            }
            Err(error) => Err(Status::internal(error.to_string())),
        }
    }

    /// The project of a caller.
    pub(crate) fn project_of(&self, member: Option<&Member>) -> Result<String, Status> {
        let (Self::Members(security), Some(member)) = (self, member) else {
            return Ok(DEFAULT_PROJECT.to_owned());
        };
        security.store.project_of(&member.principal).map_err(|error| Status::internal(error.to_string()))
    }

    /// Whether somebody is a member under this key still; a store that cannot be read ends nobody's session.
    pub(crate) fn is_member(&self, member: &Member) -> bool {
        match self {
            Self::Open => true,
            Self::Members(security) => security.store.is_member(member).unwrap_or(true),
        }
    }

    /// The capability that an application shows when it comes back, if it is one of its own.
    pub(crate) fn capability_of(
        &self,
        member: Option<&Member>,
        shown: Option<&[u8]>,
    ) -> Result<Option<Capability>, Status> {
        let (Self::Members(security), Some(member), Some(shown)) = (self, member, shown) else {
            return Ok(None);
        };
        let checked = Capability::check(shown, &security.identity, &member.principal, SystemTime::now());
        checked.map(Some).map_err(|error| {
            let reason = error.to_string();
            self.refused("resume an application", &member.principal, &reason);
            Status::permission_denied(reason)
        })
    }

    /// Writes down what a member did.
    pub(crate) fn done(&self, what: &str, member: Option<&Member>, details: serde_json::Value) {
        if let (Self::Members(security), Some(member)) = (self, member) {
            security.audit.done(what, &member.principal.to_string(), details);
        }
    }

    /// Writes down what a member was refused.
    pub(crate) fn refused(&self, what: &str, member: &Principal, reason: &str) {
        if let Self::Members(security) = self {
            security.audit.refused(what, &member.to_string(), reason);
        }
    }
}

impl Security {
    /// Opens what `farmctl init` made.
    pub(crate) fn open(directory: &Path, store: Arc<Store>) -> Result<Arc<Self>, StartError> {
        let path = directory.join(AUTHORITY_FILE);
        let fault = |reason: String| StartError::State { path: path.clone(), reason };
        let authority = Authority::read(&path).map_err(|error| StartError::Trust(error.to_string()))?;
        // Its key is in memory alone, and new in each life.
        let identity = authority
            .identity(Role::Coordinator, COORDINATOR_NAME, IDENTITY_LIFETIME)
            .map_err(|error| fault(error.to_string()))?;
        let audit = Audit::open(directory).map_err(|error| fault(error.to_string()))?;
        Ok(Arc::new(Self { authority, identity, store, audit }))
    }

    /// What the coordinator shows to those who connect.
    pub(crate) const fn identity(&self) -> &Identity {
        &self.identity
    }

    /// A capability for an application, as bytes for the wire.
    pub(crate) fn capability(
        &self,
        app: AppId,
        incarnation: AppIncarnation,
        holder: &Principal,
        project: &str,
        epoch: Epoch,
    ) -> Option<Vec<u8>> {
        let expires = SystemTime::now() + CAPABILITY_LIFETIME;
        let (holder, project) = (holder.clone(), project.to_owned());
        let capability = Capability { app, incarnation, holder, project, epoch, expires };
        match capability.sign(&self.identity) {
            Ok(bytes) => Some(bytes),
            Err(error) => {
                tracing::error!(%error, %app, "no capability could be made");
                None
            }
        }
    }

    /// Renews the coordinator's own certificate in time, for as long as it is polled.
    pub(crate) async fn stay_valid(self: Arc<Self>) {
        loop {
            tokio::time::sleep(RENEWAL_CHECK).await;
            if SystemTime::now() < self.identity.renew_at() {
                continue;
            }
            let renewed = self.identity.request().and_then(|request| {
                let Principal { role, name, .. } = self.identity.principal();
                let membership = self.authority.admit(*role, name, &request, IDENTITY_LIFETIME)?;
                self.identity.renew(&membership)
            });
            match renewed {
                Ok(()) => tracing::info!("the coordinator's certificate is renewed"),
                Err(error) => tracing::error!(%error, "the coordinator's certificate cannot be renewed"),
            }
        }
    }

    /// Writes down what an operator was refused; a store that fails refuses nobody.
    fn denied(&self, what: &str, operator: &Member, error: &StoreError) {
        if let StoreError::Denied(reason) | StoreError::Refused(reason) = error {
            self.audit.refused(what, &operator.principal.to_string(), reason);
        }
    }

    fn join(&self, request: &v1::JoinRequest, address: &str) -> Result<Membership, StoreError> {
        let issue =
            |role, name: &str| self.authority.admit(role, name, &request.request_der, IDENTITY_LIFETIME);
        let joined = self.store.join(&request.secret, &request.name, unix_now(), issue);
        match &joined {
            Ok(membership) => {
                let who = Member::of_certificate(&membership.certificate_der)?.principal;
                let project = self.store.project_of(&who)?;
                self.audit.done("joined", &who.to_string(), json!({ "from": address, "project": project }));
            }
            Err(error) => self.audit.refused("join", address, &error.to_string()),
        }
        joined
    }
}

/// The service of members and those who become one.
#[derive(Clone, Debug)]
pub(crate) struct TrustService {
    gate: Gate,
    owner: OwnerHandle,
    /// A change is kept and then told; the next one is not before it is.
    turn: Arc<Mutex<()>>,
}

impl TrustService {
    pub(crate) fn new(gate: Gate, owner: OwnerHandle) -> Self {
        Self { gate, owner, turn: Arc::default() }
    }

    /// Makes a change to its end, in the store and then at the owner, though the caller does not wait for it; one after the other.
    async fn change<T: Send + 'static>(
        &self,
        change: impl Future<Output = Result<T, Status>> + Send + 'static,
    ) -> Result<T, Status> {
        let turn = Arc::clone(&self.turn);
        let changed = tokio::spawn(async move {
            let _turn = turn.lock().await;
            change.await
        });
        changed.await.unwrap_or_else(|error| Err(Status::internal(error.to_string())))
    }

    fn security(&self) -> Result<&Arc<Security>, Status> {
        match &self.gate {
            Gate::Members(security) => Ok(security),
            Gate::Open => Err(Status::failed_precondition(
                "this farm is open: it has no members (`farmctl init` secures one)",
            )),
        }
    }

    /// A caller who may operate the farm.
    fn operator<T>(&self, request: &Request<T>) -> Result<(Arc<Security>, Member), Status> {
        let security = Arc::clone(self.security()?);
        let member = self.gate.admit(request.extensions(), Action::Operate)?;
        Ok((security, member.ok_or_else(|| Status::internal("a member has no name"))?))
    }
}

#[tonic::async_trait]
impl Trust for TrustService {
    async fn create_token(
        &self,
        request: Request<v1::CreateTokenRequest>,
    ) -> Result<Response<v1::CreateTokenResponse>, Status> {
        let (security, operator) = self.operator(&request)?;
        let asked = request.into_inner();
        let token = token(&asked, &operator.principal)?;
        let secret: [u8; SECRET_BYTES] =
            proto::trust::random().map_err(|error| Status::internal(error.to_string()))?;
        let authority = security.authority.fingerprint().to_vec();
        let id = on_disk(move || {
            let details = json!({
                "role": token.role, "name": token.name, "uses": token.uses_left, "project": token.project,
            });
            let id = security
                .store
                .add_token(&secret, token, unix_now())
                .inspect_err(|error| security.denied("make a token", &operator, error))?;
            let details = json!({ "id": id, "token": details });
            security.audit.done("token created", &operator.principal.to_string(), details);
            Ok(id)
        })
        .await?;
        Ok(Response::new(v1::CreateTokenResponse { id, secret: secret.to_vec(), authority }))
    }

    async fn list_tokens(
        &self,
        request: Request<v1::ListTokensRequest>,
    ) -> Result<Response<v1::ListTokensResponse>, Status> {
        let (security, _) = self.operator(&request)?;
        let tokens = on_disk(move || security.store.tokens(unix_now())).await?;
        let tokens = tokens.into_iter().map(|token| v1::TokenStatus {
            id: token.id,
            role: token.role,
            name: token.name,
            expires_s: token.expires_s,
            uses_left: token.uses_left,
            maker: token.maker,
            project: token.project,
        });
        Ok(Response::new(v1::ListTokensResponse { tokens: tokens.collect() }))
    }

    async fn revoke_token(
        &self,
        request: Request<v1::RevokeTokenRequest>,
    ) -> Result<Response<v1::RevokeTokenResponse>, Status> {
        let (security, operator) = self.operator(&request)?;
        let id = request.into_inner().id;
        let known = on_disk(move || {
            let known = security.store.remove_token(id)?;
            if known {
                security.audit.done("token revoked", &operator.principal.to_string(), json!({ "id": id }));
            }
            Ok(known)
        })
        .await?;
        if known {
            Ok(Response::new(v1::RevokeTokenResponse {}))
        } else {
            Err(Status::not_found(format!("there is no token {id}")))
        }
    }

    async fn list_members(
        &self,
        request: Request<v1::ListMembersRequest>,
    ) -> Result<Response<v1::ListMembersResponse>, Status> {
        let (security, _) = self.operator(&request)?;
        let members = on_disk(move || {
            let mut projects = security.store.belonging()?;
            let members = security.store.members()?.into_iter();
            let members = members.map(|uri| {
                let is_node = uri.parse().is_ok_and(|who: Principal| who.role == Role::Node);
                let default = if is_node { "" } else { DEFAULT_PROJECT };
                let project = projects.remove(&uri).unwrap_or_else(|| default.to_owned());
                v1::MemberStatus { uri, project }
            });
            Ok(members.collect())
        })
        .await?;
        Ok(Response::new(v1::ListMembersResponse { members }))
    }

    async fn set_project(
        &self,
        request: Request<v1::SetProjectRequest>,
    ) -> Result<Response<v1::SetProjectResponse>, Status> {
        let (security, operator) = self.operator(&request)?;
        let wrong = |reason: String| Status::invalid_argument(reason);
        let (project, change) =
            quota_change(request.into_inner()).map_err(|error| wrong(error.to_string()))?;
        check_name("project", &project).map_err(|error| wrong(error.to_string()))?;
        let name = project.clone();
        let set = on_disk(move || {
            let quota = security
                .store
                .set_project(&name, change)
                .inspect_err(|error| security.denied("set a project", &operator, error))?;
            let details = json!({ "project": name, "quota": quota });
            security.audit.done("project set", &operator.principal.to_string(), details);
            Ok(quota)
        });
        let owner = self.owner.clone();
        let change = async move {
            let quota = set.await?;
            owner.quota_set(project, quota).await;
            Ok(quota)
        };
        let quota = self.change(change).await?;
        Ok(Response::new(v1::SetProjectResponse { quota: Some(quota.into()) }))
    }

    async fn remove_project(
        &self,
        request: Request<v1::RemoveProjectRequest>,
    ) -> Result<Response<v1::RemoveProjectResponse>, Status> {
        let (security, operator) = self.operator(&request)?;
        let project = request.into_inner().project;
        let name = project.clone();
        let removed = on_disk(move || {
            let removed = security.store.remove_project(&name, unix_now());
            if !removed.inspect_err(|error| security.denied("remove a project", &operator, error))? {
                return Ok(false);
            }
            let details = json!({ "project": name });
            security.audit.done("project removed", &operator.principal.to_string(), details);
            Ok(true)
        });
        let owner = self.owner.clone();
        let change = async move {
            if !removed.await? {
                return Err(Status::not_found(format!("there is no project {project}")));
            }
            owner.project_removed(project).await;
            Ok(())
        };
        self.change(change).await?;
        Ok(Response::new(v1::RemoveProjectResponse {}))
    }

    async fn expel(&self, request: Request<v1::ExpelRequest>) -> Result<Response<v1::ExpelResponse>, Status> {
        let (security, operator) = self.operator(&request)?;
        let uri = request.into_inner().uri;
        let principal: Principal = uri
            .parse()
            .map_err(|error: proto::trust::TrustError| Status::invalid_argument(error.to_string()))?;
        let expelled = on_disk(move || {
            let was = security
                .store
                .expel(&principal)
                .inspect_err(|error| security.denied("expel", &operator, error))?;
            if was {
                let details = json!({ "member": principal.to_string() });
                security.audit.done("expelled", &operator.principal.to_string(), details);
            }
            Ok(was)
        });
        let owner = self.owner.clone();
        let change = async move {
            let was = expelled.await?;
            owner.members_changed().await;
            Ok(was)
        };
        if self.change(change).await? {
            Ok(Response::new(v1::ExpelResponse {}))
        } else {
            Err(Status::not_found(format!("there is no member {uri}")))
        }
    }

    async fn join(&self, request: Request<v1::JoinRequest>) -> Result<Response<v1::Membership>, Status> {
        let security = Arc::clone(self.security()?);
        let Some(caller) = request.extensions().get::<Caller>().cloned() else {
            return Err(Status::internal("a caller has no address"));
        };
        if !caller.encrypted {
            return Err(Status::unauthenticated("a token is not said in plain text"));
        }
        let asked = request.into_inner();
        let owner = self.owner.clone();
        let change = async move {
            let joined = on_disk(move || security.join(&asked, &caller.address.to_string())).await?;
            // Somebody else may have had the name.
            owner.members_changed().await;
            Ok(joined)
        };
        Ok(Response::new(wire(self.change(change).await?)))
    }

    async fn renew(&self, request: Request<v1::RenewRequest>) -> Result<Response<v1::Membership>, Status> {
        let security = Arc::clone(self.security()?);
        let Some(member) = self.gate.admit(request.extensions(), Action::Renew)? else {
            return Err(Status::internal("a member has no name"));
        };
        let asked = request.into_inner();
        let renewed = on_disk(move || {
            let Principal { role, name, .. } = &member.principal;
            let membership = security.authority.admit(*role, name, &asked.request_der, IDENTITY_LIFETIME)?;
            if Member::of_certificate(&membership.certificate_der)? != member {
                return Err(StoreError::Denied("a renewal is for the same key".to_owned()));
            }
            security.audit.done("renewed", &member.principal.to_string(), serde_json::Value::Null);
            Ok(membership)
        })
        .await?;
        Ok(Response::new(wire(renewed)))
    }
}

/// A token as it was asked for.
fn token(asked: &v1::CreateTokenRequest, maker: &Principal) -> Result<Token, Status> {
    let wrong = |reason: String| Status::invalid_argument(reason);
    let role: Role =
        asked.role.parse().map_err(|error: proto::trust::TrustError| wrong(error.to_string()))?;
    if role == Role::Coordinator {
        return Err(wrong("coordinators do not join: `farmctl init` makes one".to_owned()));
    }
    if !asked.name.is_empty() {
        check_name("name", &asked.name).map_err(|error| wrong(error.to_string()))?;
    }
    if !(1..=MAX_TOKEN_LIFETIME_S).contains(&asked.lifetime_s) {
        return Err(wrong(format!(
            "a token lives 1 s to {MAX_TOKEN_LIFETIME_S} s, not {} s",
            asked.lifetime_s
        )));
    }
    if role == Role::Node && !asked.project.is_empty() {
        return Err(wrong("a node belongs to no project: it computes for all of them".to_owned()));
    }
    let most = if asked.name.is_empty() { MAX_TOKEN_USES } else { 1 };
    if !(1..=most).contains(&asked.uses) {
        return Err(wrong(format!("such a token is used 1 to {most} times, not {}", asked.uses)));
    }
    Ok(Token {
        id: 0,
        role: role.to_string(),
        name: asked.name.clone(),
        expires_s: unix_now() + asked.lifetime_s,
        uses_left: asked.uses,
        maker: maker.to_string(),
        project: asked.project.clone(),
    })
}

/// Does what waits for the disk.
async fn on_disk<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, StoreError> + Send + 'static,
) -> Result<T, Status> {
    match tokio::task::spawn_blocking(work).await {
        Ok(Ok(done)) => Ok(done),
        Ok(Err(StoreError::Denied(reason))) => Err(Status::permission_denied(reason)),
        Ok(Err(StoreError::Refused(reason))) => Err(Status::failed_precondition(reason)),
        Ok(Err(error @ (StoreError::Broken(_) | StoreError::Superseded(_)))) => {
            tracing::error!(%error, "a request failed");
            Err(Status::internal(error.to_string()))
        }
        Err(error) => Err(Status::internal(error.to_string())),
    }
}

fn wire(membership: Membership) -> v1::Membership {
    v1::Membership { certificate_der: membership.certificate_der, authority_der: membership.authority_der }
}

/// Secures a farm: makes its authority in a coordinator's state directory, and the identity of its first operator.
///
/// # Errors
/// The directory has an authority already, a coordinator uses it, it cannot be written, or a name is not one.
pub fn initialise(state: &Path, farm: &str, operator: &str) -> Result<Identity, StartError> {
    let trust = |error: proto::trust::TrustError| StartError::Trust(error.to_string());
    check_name("operator", operator).map_err(trust)?;
    let store = Store::open(state)?;
    let path: PathBuf = state.join(AUTHORITY_FILE);
    if path.symlink_metadata().is_ok() {
        let reason =
            "the farm is secured already; remove the file to begin anew: every member has to join again";
        return Err(StartError::State { path, reason: reason.to_owned() });
    }
    let fault = |error: StoreError| StartError::State { path: path.clone(), reason: error.to_string() };
    // Members and tokens of an authority that was here before are none of the new one's.
    store.clear().map_err(fault)?;
    let authority = Authority::create(farm).map_err(trust)?;
    let identity = authority.identity(Role::Operator, operator, IDENTITY_LIFETIME).map_err(trust)?;
    store.admit(&identity.member().map_err(trust)?).map_err(fault)?;
    authority.write(&path).map_err(trust)?;
    Ok(identity)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a step that fails fails its test")]
mod tests {
    use super::*;
    use crate::owner::Command;

    /// The review of 2026-11-29: a caller that went away left a quota in the store that did not count before the next start.
    #[tokio::test]
    async fn what_the_store_keeps_the_owner_is_told_though_the_caller_is_gone() {
        let directory = tempfile::tempdir().unwrap();
        let identity = initialise(directory.path(), "farm", "boss").unwrap();
        let store = Arc::new(Store::open(directory.path()).unwrap());
        let security = Security::open(directory.path(), Arc::clone(&store)).unwrap();
        let (owner, mut commands) = OwnerHandle::new(Arc::default());
        let service = TrustService::new(Gate::Members(security), owner);
        let mut request =
            Request::new(v1::SetProjectRequest { project: "films".to_owned(), ..Default::default() });
        let (address, member) = ("127.0.0.1:1".parse().unwrap(), identity.member().unwrap());
        request.extensions_mut().insert(Caller { address, encrypted: true, member: Some(member) });
        let mut setting = Box::pin(service.set_project(request));
        tokio::select! {
            biased;
            done = &mut setting => panic!("it waits for the disk: {done:?}"),
            () = tokio::task::yield_now() => {}
        }
        drop(setting);
        let told = commands.recv().await;
        assert!(matches!(told, Some(Command::QuotaSet(project, _)) if project == "films"));
        assert!(store.quotas().unwrap().contains_key("films"));
    }
}
