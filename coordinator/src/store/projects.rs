//! Projects: what each may have, and which members belong to one. Who belongs to none is of `default`, which is always there.

use std::collections::BTreeMap;

use farm_core::project::{DEFAULT_PROJECT, MAX_PROJECTS, Quota, QuotaChange};
use proto::trust::Principal;
use redb::{ReadableTable as _, ReadableTableMetadata as _, TableDefinition, WriteTransaction};

use super::{Store, StoreError, TOKENS, broken, fault, parse};
use crate::StartError;

/// Quotas as JSON, by project.
pub(super) const PROJECTS: TableDefinition<'_, &str, &str> = TableDefinition::new("projects");
/// The projects of members, by their URIs.
pub(super) const BELONGING: TableDefinition<'_, &str, &str> = TableDefinition::new("belonging");

impl Store {
    /// Makes a project, or changes its quota. Gives what it may have now.
    pub(crate) fn set_project(&self, name: &str, change: QuotaChange) -> Result<Quota, StoreError> {
        self.write(|transaction| {
            let mut projects = transaction.open_table(PROJECTS).map_err(broken)?;
            let before = projects.get(name).map_err(broken)?.map(|text| quota(text.value())).transpose()?;
            // The one that is always there counts as none.
            let is_new = before.is_none() && name != DEFAULT_PROJECT;
            if is_new && projects.len().map_err(broken)? >= MAX_PROJECTS as u64 {
                return Err(StoreError::Refused(format!("{MAX_PROJECTS} projects are there already")));
            }
            let after = change.apply(before.unwrap_or_default());
            let text =
                serde_json::to_string(&after).map_err(|error| StoreError::Broken(error.to_string()))?;
            projects.insert(name, text.as_str()).map_err(broken)?;
            Ok(after)
        })
    }

    /// Removes a project; whether it was there.
    pub(crate) fn remove_project(&self, name: &str, now_s: u64) -> Result<bool, StoreError> {
        if name == DEFAULT_PROJECT {
            let reason = "the project default stays; `farmctl project set default` lifts its bounds";
            return Err(StoreError::Refused(reason.to_owned()));
        }
        self.write(|transaction| {
            for entry in transaction.open_table(BELONGING).map_err(broken)?.iter().map_err(broken)? {
                let (member, project) = entry.map_err(broken)?;
                if project.value() == name {
                    let member = member.value();
                    return Err(StoreError::Refused(format!(
                        "the project {name} stays: {member} belongs to it"
                    )));
                }
            }
            for entry in transaction.open_table(TOKENS).map_err(broken)?.iter().map_err(broken)? {
                let token = parse(entry.map_err(broken)?.1.value())?;
                if token.project == name && token.expires_s > now_s {
                    let id = token.id;
                    return Err(StoreError::Refused(format!(
                        "the project {name} stays: token {id} is for it"
                    )));
                }
            }
            let mut projects = transaction.open_table(PROJECTS).map_err(broken)?;
            Ok(projects.remove(name).map_err(broken)?.is_some())
        })
    }

    /// What each project may have.
    pub(crate) fn quotas(&self) -> Result<BTreeMap<String, Quota>, StoreError> {
        self.read(|transaction| {
            let table = transaction.open_table(PROJECTS).map_err(broken)?;
            let mut quotas = BTreeMap::new();
            for entry in table.iter().map_err(broken)? {
                let (name, text) = entry.map_err(broken)?;
                quotas.insert(name.value().to_owned(), quota(text.value())?);
            }
            Ok(quotas)
        })
    }

    /// What each project may have, for the start.
    pub(crate) fn restore_quotas(&self) -> Result<BTreeMap<String, Quota>, StartError> {
        self.quotas().map_err(|error| fault(&self.path, &error))
    }

    /// The project that a member belongs to.
    pub(crate) fn project_of(&self, member: &Principal) -> Result<String, StoreError> {
        self.read(|transaction| {
            let table = transaction.open_table(BELONGING).map_err(broken)?;
            let project = table.get(member.to_string().as_str()).map_err(broken)?;
            Ok(project.map_or_else(|| DEFAULT_PROJECT.to_owned(), |project| project.value().to_owned()))
        })
    }

    /// The members that belong to a project other than `default`, with it.
    pub(crate) fn belonging(&self) -> Result<BTreeMap<String, String>, StoreError> {
        self.read(|transaction| {
            let table = transaction.open_table(BELONGING).map_err(broken)?;
            let belonging = table.iter().map_err(broken)?.map(|entry| {
                entry.map(|(member, project)| (member.value().to_owned(), project.value().to_owned()))
            });
            belonging.collect::<Result<_, _>>().map_err(broken)
        })
    }
}

/// A token's project must be there; empty is `default`.
pub(super) fn check_known(transaction: &WriteTransaction, project: &str) -> Result<(), StoreError> {
    if project.is_empty() || project == DEFAULT_PROJECT {
        return Ok(());
    }
    let projects = transaction.open_table(PROJECTS).map_err(broken)?;
    if projects.get(project).map_err(broken)?.is_some() {
        return Ok(());
    }
    Err(StoreError::Refused(format!(
        "there is no project {project:?}: `farmctl project set {project}` makes it"
    )))
}

/// Puts a member into a project; empty is `default`.
pub(super) fn put(
    transaction: &WriteTransaction,
    member: &Principal,
    project: &str,
) -> Result<(), StoreError> {
    let mut belonging = transaction.open_table(BELONGING).map_err(broken)?;
    let member = member.to_string();
    if project.is_empty() || project == DEFAULT_PROJECT {
        belonging.remove(member.as_str()).map_err(broken)?;
    } else {
        belonging.insert(member.as_str(), project).map_err(broken)?;
    }
    Ok(())
}

fn quota(text: &str) -> Result<Quota, StoreError> {
    serde_json::from_str(text).map_err(|error| StoreError::Broken(error.to_string()))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a step that fails fails its test")]
mod tests {
    use super::*;
    use crate::store::Token;

    fn token(project: &str) -> Token {
        Token {
            id: 0,
            role: "app".to_owned(),
            name: String::new(),
            expires_s: 100,
            uses_left: 1,
            maker: String::new(),
            project: project.to_owned(),
        }
    }

    #[test]
    fn a_change_leaves_what_it_does_not_name_and_all_of_it_is_there_after_a_restart() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path()).unwrap();
        let first = QuotaChange { devices: Some(Some(3)), weight: Some(Some(2.0)), ..QuotaChange::default() };
        store.set_project("films", first).unwrap();
        let second = QuotaChange { devices: Some(None), bytes: Some(Some(7)), ..QuotaChange::default() };
        let quota = Quota { devices: None, queued_jobs: None, bytes: Some(7), weight: Some(2.0) };
        assert_eq!(store.set_project("films", second).unwrap(), quota);
        drop(store);
        let store = Store::open(directory.path()).unwrap();
        assert_eq!(store.quotas().unwrap(), BTreeMap::from([("films".to_owned(), quota)]));
    }

    #[test]
    fn a_project_is_made_before_its_tokens_and_removed_after_them() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path()).unwrap();
        let refused = store.add_token(b"secret", token("films"), 0).unwrap_err();
        assert!(refused.to_string().contains("farmctl project set films"), "{refused}");
        store.set_project("films", QuotaChange::default()).unwrap();
        let id = store.add_token(b"secret", token("films"), 0).unwrap();
        let refused = store.remove_project("films", 99).unwrap_err();
        assert!(refused.to_string().contains(&format!("token {id}")), "{refused}");
        assert!(store.remove_project("films", 100).unwrap(), "a token that is over is none");
        assert!(!store.remove_project("films", 100).unwrap(), "once");
        assert!(store.remove_project(DEFAULT_PROJECT, 100).is_err(), "that one stays");
    }

    #[test]
    fn there_are_no_more_projects_than_a_farm_may_have() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path()).unwrap();
        store
            .write(|transaction| {
                let mut projects = transaction.open_table(PROJECTS).map_err(broken)?;
                for number in 0..MAX_PROJECTS {
                    projects.insert(number.to_string().as_str(), "{}").map_err(broken)?;
                }
                Ok(())
            })
            .unwrap();
        assert!(store.set_project("one-more", QuotaChange::default()).is_err());
        for there in ["0", DEFAULT_PROJECT] {
            store.set_project(there, QuotaChange::default()).unwrap();
        }
    }
}
