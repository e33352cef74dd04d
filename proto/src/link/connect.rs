//! Making links: the node's listening socket and the application's race over a node's addresses.

use std::{net::SocketAddr, time::Duration};

use thiserror::Error;

use super::{ContentSource, Header, Link, LinkError};
use crate::tls::TlsError;

/// How long `connect` tries in all, and how long an accepted handshake may take.
pub const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// A data server could not start.
#[derive(Debug, Error)]
pub enum BindError {
    /// The address cannot be had.
    #[error("cannot listen on {address} (UDP): {source}")]
    Address {
        /// The address asked for.
        address: SocketAddr,
        /// Why not.
        source: std::io::Error,
    },
    /// No certificate.
    #[error(transparent)]
    Tls(#[from] TlsError),
}

/// No address of a node gave a link. May be retried.
#[derive(Debug, Error)]
pub enum ConnectError {
    /// The contact names no address.
    #[error("the node has no address")]
    NoAddress,
    /// The pinned certificate cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// Each address failed.
    #[error("no address answered: {}", list(.0))]
    Unreachable(Vec<(String, String)>),
}

fn list(failures: &[(String, String)]) -> String {
    failures.iter().map(|(address, reason)| format!("{address}: {reason}")).collect::<Vec<_>>().join("; ")
}

/// A node's listening end.
#[derive(Debug)]
pub struct DataServer {}

impl DataServer {
    /// Listens on a UDP address (port 0: the system chooses) under a fresh certificate.
    ///
    /// # Errors
    /// The address cannot be had, or no certificate can be made.
    pub fn bind(address: SocketAddr) -> Result<Self, BindError> {
        let _ = address;
        unimplemented!()
    }

    /// Where it listens.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        unimplemented!()
    }

    /// The certificate to pin, DER.
    #[must_use]
    pub fn certificate_der(&self) -> &[u8] {
        unimplemented!()
    }

    /// The next application that dials; `None` after [`Self::shutdown`]. Cancel-safe.
    pub async fn accept(&self) -> Option<Incoming> {
        unimplemented!()
    }

    /// Closes every link and waits (at most a second) until the peers were told.
    pub async fn shutdown(&self, reason: &str) {
        let _ = reason;
        unimplemented!()
    }
}

/// A dialling application before its handshake.
#[derive(Debug)]
pub struct Incoming {}

impl Incoming {
    /// Who dials.
    #[must_use]
    pub fn remote_address(&self) -> SocketAddr {
        unimplemented!()
    }

    /// Completes the handshake; run it on a task of its own, for a peer may dawdle up to [`CONNECT_TIMEOUT`].
    ///
    /// # Errors
    /// The handshake failed.
    pub async fn establish<S: Header, R: Header>(self, contents: ContentSource) -> Result<Link<S, R>, LinkError> {
        let _ = contents;
        unimplemented!()
    }
}

/// Dials a node: all addresses (`host:port`) side by side, the first that answers with the pinned certificate wins.
///
/// # Errors
/// None answered within [`CONNECT_TIMEOUT`]; the error names each address and its reason.
pub async fn connect<S: Header, R: Header>(
    addresses: &[String],
    certificate_der: &[u8],
    contents: ContentSource,
) -> Result<Link<S, R>, ConnectError> {
    let _ = (addresses, certificate_der, contents);
    unimplemented!()
}
