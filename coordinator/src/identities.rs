//! What members of a secured farm may say as whom: a node its own name, an application its own earlier life; and the
//! capabilities that applications show to nodes, and to the coordinator when they come back.

use std::{
    collections::HashMap,
    time::{Duration, Instant},
};

use farm_core::{
    id::{AppId, AppIncarnation, Epoch, LinkId},
    message::{AppToCoordinator, CoordinatorToApp, NodeToCoordinator},
};
use proto::trust::{Capability, Member, Principal};

use crate::security::{CAPABILITY_LIFETIME, Gate};

/// Owners of applications are kept for those that have left, too, until they come to this many: twice what the machine registers.
const MAX_OWNERS: usize = 32_768;

/// A capability of this age is followed by a new one.
const RENEW_AFTER: Duration = CAPABILITY_LIFETIME.checked_div(2).expect("two is not zero");

/// Who said which hello.
#[derive(Debug)]
pub(crate) struct Identities {
    gate: Gate,
    /// The capability given on a connection.
    given: HashMap<LinkId, Given>,
    /// Who the applications are of that this coordinator has registered.
    owners: HashMap<AppId, Principal>,
}

#[derive(Debug)]
struct Given {
    app: AppId,
    incarnation: AppIncarnation,
    epoch: Epoch,
    at: Instant,
}

impl Identities {
    pub(crate) fn new(gate: Gate) -> Self {
        Self { gate, given: HashMap::new(), owners: HashMap::new() }
    }

    /// Whether somebody let in is no member any more.
    pub(crate) fn is_out(&self, member: Option<&Member>) -> bool {
        member.is_some_and(|member| !self.gate.is_member(member))
    }

    /// # Errors
    /// It resumes an application and does not show that it is its own: a coordinator's word, of this life or an earlier one.
    pub(crate) fn check_app(
        &self,
        member: Option<&Member>,
        shown: Option<&Capability>,
        message: &AppToCoordinator,
    ) -> Result<(), String> {
        let (Some(member), AppToCoordinator::Hello(hello)) = (member, message) else { return Ok(()) };
        let Some((app, _)) = hello.resume else { return Ok(()) };
        if shown.is_some_and(|shown| shown.app == app) {
            return Ok(());
        }
        let reason = format!("{} does not show that {app} is its own", member.principal);
        Err(self.refused("resume an application", member, reason))
    }

    /// Whether somebody may say that they go on for an application: it is their own, or unknown. If not, it is written down, and
    /// that is all: who goes on from a colleague's journal may do so, the predecessor is just not theirs to end.
    pub(crate) fn may_supersede(&self, member: Option<&Member>, app: AppId) -> bool {
        let Some(member) = member else { return true };
        let another = self.owners.get(&app).filter(|owner| **owner != member.principal);
        if let Some(owner) = another {
            self.gate.refused("supersede an application", &member.principal, &format!("{app} is {owner}'s"));
        }
        another.is_none()
    }

    /// # Errors
    /// It calls itself by another's name.
    pub(crate) fn check_node(
        &self,
        member: Option<&Member>,
        message: &NodeToCoordinator,
    ) -> Result<(), String> {
        let (Some(member), NodeToCoordinator::Hello(hello)) = (member, message) else { return Ok(()) };
        let principal = &member.principal;
        if principal.may_be_called(&hello.name) {
            return Ok(());
        }
        let own = &principal.name;
        let reason = format!("{principal} may be called {own:?} or \"{own}/ANYTHING\", not {:?}", hello.name);
        Err(self.refused("register a node", member, reason))
    }

    /// Writes down that a batch needs more than its project may have.
    pub(crate) fn refused_by_quota(&self, member: Option<&Member>, reason: &str) {
        if let Some(member) = member {
            self.gate.refused("bring jobs", &member.principal, reason);
        }
    }

    fn refused(&self, what: &str, member: &Member, reason: String) -> String {
        self.gate.refused(what, &member.principal, &reason);
        reason
    }

    /// Keeps in mind whose an application is that is welcomed. `is_registered` says which are there still.
    pub(crate) fn welcomes(
        &mut self,
        member: Option<&Member>,
        message: &CoordinatorToApp,
        is_registered: impl Fn(AppId) -> bool,
    ) {
        let (Some(member), &CoordinatorToApp::Welcome { app, .. }) = (member, message) else { return };
        if self.owners.len() >= MAX_OWNERS {
            self.owners.retain(|&app, _| is_registered(app));
        }
        self.owners.insert(app, member.principal.clone());
    }

    /// What an application is to be given before a message: with its welcome, and with an answer when the last one ages.
    pub(crate) fn capability(
        &mut self,
        link: LinkId,
        member: &Member,
        project: &str,
        message: &CoordinatorToApp,
    ) -> Option<Vec<u8>> {
        let Gate::Members(security) = &self.gate else { return None };
        let given = match (message, self.given.get_mut(&link)) {
            (&CoordinatorToApp::Welcome { app, incarnation, epoch, .. }, _) => {
                self.given.insert(link, Given { app, incarnation, epoch, at: Instant::now() });
                self.given.get(&link)?
            }
            (CoordinatorToApp::HeartbeatAck { .. }, Some(given)) if given.at.elapsed() >= RENEW_AFTER => {
                given.at = Instant::now();
                given
            }
            _ => return None,
        };
        security.capability(given.app, given.incarnation, &member.principal, project, given.epoch)
    }

    pub(crate) fn forget(&mut self, link: LinkId) {
        self.given.remove(&link);
    }
}
