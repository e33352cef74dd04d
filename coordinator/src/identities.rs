//! What members of a secured farm may say as whom: a node its own name, an application its own earlier life; and the
//! capabilities that applications show to nodes.

use std::{
    collections::{BTreeMap, HashMap},
    time::{Duration, Instant},
};

use farm_core::{
    id::{AppId, AppIncarnation, Epoch, LinkId},
    message::{AppToCoordinator, CoordinatorToApp, NodeToCoordinator},
};
use proto::trust::Principal;

use crate::security::{CAPABILITY_LIFETIME, Gate};

/// A capability of this age is followed by a new one.
const RENEW_AFTER: Duration = CAPABILITY_LIFETIME.checked_div(2).expect("two is not zero");
/// Applications whose owner is known, at most; beyond it the earliest is forgotten.
const MAX_OWNERS: usize = 65_536;

/// Who said which hello.
#[derive(Debug)]
pub(crate) struct Identities {
    gate: Gate,
    /// Of this coordinator's life. An application that resumes after a restart is believed: nobody else knows its number.
    owners: BTreeMap<AppId, Principal>,
    /// The capability given on a connection.
    given: HashMap<LinkId, Given>,
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
        Self { gate, owners: BTreeMap::new(), given: HashMap::new() }
    }

    /// # Errors
    /// It resumes somebody else's application.
    pub(crate) fn check_app(
        &self,
        member: Option<&Principal>,
        message: &AppToCoordinator,
    ) -> Result<(), String> {
        let (Some(member), AppToCoordinator::Hello(hello)) = (member, message) else { return Ok(()) };
        let owner = hello.resume.and_then(|resumed| self.owners.get(&resumed.0));
        if owner.is_none_or(|owner| owner == member) {
            return Ok(());
        }
        Err(self.refused(
            "resume an application",
            member,
            format!("{member} resumes somebody else's application"),
        ))
    }

    /// # Errors
    /// It calls itself by another's name.
    pub(crate) fn check_node(
        &self,
        member: Option<&Principal>,
        message: &NodeToCoordinator,
    ) -> Result<(), String> {
        let (Some(member), NodeToCoordinator::Hello(hello)) = (member, message) else { return Ok(()) };
        if member.may_be_called(&hello.name) {
            return Ok(());
        }
        let reason = format!(
            "{member} may be called {:?} or \"{}/ANYTHING\", not {:?}",
            member.name, member.name, hello.name
        );
        Err(self.refused("register a node", member, reason))
    }

    fn refused(&self, what: &str, member: &Principal, reason: String) -> String {
        self.gate.refused(what, member, &reason);
        reason
    }

    /// What an application is to be given before a message: with its welcome, and with an answer when the last one ages.
    pub(crate) fn capability(
        &mut self,
        link: LinkId,
        member: &Principal,
        message: &CoordinatorToApp,
    ) -> Option<Vec<u8>> {
        let Gate::Members(security) = &self.gate else { return None };
        let given = match (message, self.given.get_mut(&link)) {
            (&CoordinatorToApp::Welcome { app, incarnation, epoch, .. }, _) => {
                self.owners.insert(app, member.clone());
                if self.owners.len() > MAX_OWNERS {
                    self.owners.pop_first();
                }
                self.given.insert(link, Given { app, incarnation, epoch, at: Instant::now() });
                self.given.get(&link)?
            }
            (CoordinatorToApp::HeartbeatAck { .. }, Some(given)) if given.at.elapsed() >= RENEW_AFTER => {
                given.at = Instant::now();
                given
            }
            _ => return None,
        };
        security.capability(given.app, given.incarnation, member, given.epoch)
    }

    pub(crate) fn forget(&mut self, link: LinkId) {
        self.given.remove(&link);
    }
}
