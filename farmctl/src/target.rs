//! The farm that a command is for: where its coordinator is, and who we are there.

use std::{
    path::{Path, PathBuf},
    time::SystemTime,
};

use client_sdk::FarmOptions;
use proto::{
    control,
    trust::{Identity, default_identity},
};

use crate::failure::Failure;

/// Where `farmctl up` and `farm-coordinator` listen unless told otherwise.
pub(crate) const DEFAULT_COORDINATOR: &str = "127.0.0.1:7700";

/// As the command line says it.
#[derive(Debug)]
pub(crate) struct Target<'a> {
    coordinator: Option<&'a str>,
    identity: Option<&'a Path>,
    insecure: bool,
}

/// A farm to talk to.
#[derive(Clone, Debug)]
pub(crate) struct Reach {
    /// Its coordinator.
    pub(crate) address: String,
    /// Who we are there; `None` where the farm is open.
    pub(crate) identity: Option<Identity>,
}

impl<'a> Target<'a> {
    pub(crate) const fn new(
        coordinator: Option<&'a str>,
        identity: Option<&'a Path>,
        insecure: bool,
    ) -> Self {
        Self { coordinator, identity, insecure }
    }

    /// The farm that was named; `None` if none was.
    pub(crate) async fn named(&self) -> Result<Option<Reach>, Failure> {
        match self.coordinator {
            Some(address) => Ok(Some(self.reach(address).await?)),
            None => Ok(None),
        }
    }

    /// The farm that was named, or the one at the usual place.
    pub(crate) async fn existing(&self) -> Result<Reach, Failure> {
        self.reach(self.address()).await
    }

    /// Where to ask, named or not.
    pub(crate) fn address(&self) -> &'a str {
        self.coordinator.unwrap_or(DEFAULT_COORDINATOR)
    }

    /// Where an identity of a kind (`user`, `node`) is written to.
    pub(crate) fn identity_file(&self, kind: &str) -> Result<PathBuf, Failure> {
        let usual = || default_identity(kind);
        self.identity.map(Path::to_owned).or_else(usual).ok_or_else(|| {
            Failure::Usage(anyhow::anyhow!(
                "no place for an identity: there is no home folder; say --identity FILE"
            ))
        })
    }

    async fn reach(&self, address: &str) -> Result<Reach, Failure> {
        let usual = || default_identity("user").filter(|path| path.exists());
        let file = self.identity.map(Path::to_owned).or_else(usual).filter(|_| !self.insecure);
        let identity = file.map(|file| Identity::read(&file)).transpose();
        let identity =
            identity.map_err(|error| Failure::Usage(anyhow::Error::new(error).context("identity")))?;
        if let Some(identity) = &identity
            && !identity.is_over()
            && identity.renew_at() <= SystemTime::now()
            && let Err(error) = control::renew(address, identity).await
        {
            // The old one does for now; what it is used for says the rest.
            tell!("farmctl: warning: your identity could not be renewed: {error}");
        }
        Ok(Reach { address: address.to_owned(), identity })
    }
}

impl Reach {
    /// How an application of this name connects.
    pub(crate) fn options(&self, name: impl Into<String>) -> FarmOptions {
        FarmOptions { identity: self.identity.clone(), ..FarmOptions::new(&self.address, name) }
    }

    /// A farm without members, such as one of our own.
    pub(crate) fn open(address: &str) -> Self {
        Self { address: address.to_owned(), identity: None }
    }
}
