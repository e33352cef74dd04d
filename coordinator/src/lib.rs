//! The coordinator's driver: gRPC sessions, control store, status page and metrics around
//! `farm_core::coordinator::CoordinatorMachine`.
//!
//! One task owns the machine; everything else sends it messages. It never decides who runs what: the machine does.

use std::{net::SocketAddr, path::PathBuf};

use farm_core::{coordinator::FarmStatus, message::Liveness};
use thiserror::Error;

/// What a coordinator is started with.
#[derive(Clone, Debug)]
pub struct CoordinatorOptions {
    /// gRPC address; port 0 lets the system choose.
    pub listen: SocketAddr,
    /// HTTP address (status page, metrics, health); port 0 lets the system choose.
    pub http: SocketAddr,
    /// Where the epoch is kept; `None`: in memory only, the epoch is 1.
    pub state: Option<PathBuf>,
    /// Timings told to nodes and applications.
    pub liveness: Liveness,
    /// How long a vanished application keeps its jobs, in milliseconds.
    pub app_lease_ms: u64,
}

impl Default for CoordinatorOptions {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 7700)),
            http: SocketAddr::from(([127, 0, 0, 1], 7701)),
            state: None,
            liveness: Liveness::default(),
            app_lease_ms: 30_000,
        }
    }
}

impl CoordinatorOptions {
    /// On loopback with ports of the system's choice and no state: what an embedded farm and tests use.
    #[must_use]
    pub fn embedded() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            http: SocketAddr::from(([127, 0, 0, 1], 0)),
            ..Self::default()
        }
    }
}

/// A coordinator could not start.
#[derive(Debug, Error)]
pub enum StartError {
    /// An address cannot be had.
    #[error("cannot listen on {address} ({what}): {source}")]
    Listen {
        /// `gRPC` or `HTTP`.
        what: &'static str,
        /// The address asked for.
        address: SocketAddr,
        /// Why not.
        source: std::io::Error,
    },
    /// The state directory cannot be used.
    #[error("state directory {path}: {reason}")]
    State {
        /// Which.
        path: PathBuf,
        /// Why not.
        reason: String,
    },
}

/// A running coordinator. Dropping it stops it without waiting.
#[derive(Debug)]
pub struct CoordinatorHandle {}

impl CoordinatorHandle {
    /// Where applications and nodes connect.
    #[must_use]
    pub fn grpc_addr(&self) -> SocketAddr {
        unimplemented!()
    }

    /// Where the status page is.
    #[must_use]
    pub fn http_addr(&self) -> SocketAddr {
        unimplemented!()
    }

    /// The farm as an operator sees it; `None` once it has stopped.
    pub async fn status(&self) -> Option<FarmStatus> {
        unimplemented!()
    }

    /// Closes every session and waits until all is down.
    pub async fn shutdown(self) {
        unimplemented!()
    }
}

/// Starts a coordinator on the current tokio runtime.
///
/// # Errors
/// An address or the state directory cannot be had.
pub async fn start(options: CoordinatorOptions) -> Result<CoordinatorHandle, StartError> {
    let _ = options;
    unimplemented!()
}
