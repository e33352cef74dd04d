//! The worker daemon's library: a thin driver around `farm_core::worker::WorkerMachine`.
//!
//! It owns sockets, clocks, payload bytes (programs, contents, results) and the devices' executors; it decides
//! nothing about jobs. One task owns the machine; everything else sends it inputs.

mod contents;
mod device;
mod driver;
mod executor;
mod link;
mod programs;
mod session;
mod spool;

use std::{net::SocketAddr, path::PathBuf, sync::Arc, time::Duration};

use farm_core::{
    device::DeviceInfo,
    id::{NodeId, NodeSession},
    message::Contact,
    worker::{Share, WorkerConfig},
};
use gpu_exec::{DeviceSpec, OpenError};
use proto::{
    control::SessionError,
    link::{BindError, DataServer},
    trust::Identity,
};
use thiserror::Error;
use tokio::{
    sync::{mpsc, oneshot},
    task::JoinHandle,
};

pub use self::executor::{Isolation, serve_if_executor};
use self::{
    contents::Contents,
    driver::{Input, QUEUED_INPUTS, Setup},
    spool::{Spool, SpoolRoom},
};

/// Most jobs a worker holds, executed and unacknowledged ones too; further ones go back to the coordinator.
const MAX_JOBS: usize = 65_536;

/// Settings of a worker.
#[derive(Clone, Debug)]
pub struct WorkerOptions {
    /// `host:port` of the coordinator.
    pub coordinator: String,
    /// Address of the data plane (UDP); port 0 lets the system choose.
    pub listen: SocketAddr,
    /// `host:port` addresses under which applications reach the data plane; the listening one when empty.
    pub advertise: Vec<String>,
    /// For people, and the node's identity over restarts: a second worker of one name takes the first one's place.
    pub name: String,
    /// The devices to open.
    pub devices: Vec<DeviceSpec>,
    /// Whether executors run in processes of their own.
    pub isolation: Isolation,
    /// How long the coordinator is tried at the start.
    pub connect_timeout: Duration,
    /// Most bytes of task allocations and modules kept in memory.
    pub content_cache_bytes: u64,
    /// Most bytes of results that an application may leave unacknowledged; beyond it no further job of it is begun.
    pub spool_quota_bytes: u64,
    /// Bytes of results of all applications kept in memory; the oldest go to disk beyond it, if there is a cache folder.
    pub spool_memory_bytes: u64,
    /// Most bytes of results there. When both are full, an application gets a further job only while it leaves no result
    /// unacknowledged.
    pub spool_disk_bytes: u64,
    /// How long one job may run.
    pub job_limit: Duration,
    /// Whether an idle device takes queued jobs of its siblings; off only for measuring what that gains.
    pub local_stealing: bool,
    /// How devices are shared between applications.
    pub share: Share,
    /// Who this node is in a secured farm; without it, everyone who reaches it can use it.
    pub identity: Option<Identity>,
    /// A folder for caches on disk: contents that come from elsewhere are kept there over restarts.
    pub cache: Option<PathBuf>,
    /// Most bytes of contents kept there.
    pub disk_cache_bytes: u64,
}

impl WorkerOptions {
    /// On loopback, with a port of the system's choice: what an embedded farm and tests use.
    #[must_use]
    pub fn embedded(coordinator: String, devices: Vec<DeviceSpec>) -> Self {
        Self {
            coordinator,
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            advertise: Vec::new(),
            name: format!("worker-{}", std::process::id()),
            devices,
            isolation: Isolation::None,
            connect_timeout: Duration::from_secs(10),
            content_cache_bytes: 4 << 30,
            spool_quota_bytes: 1 << 30,
            spool_memory_bytes: 1 << 30,
            spool_disk_bytes: 16 << 30,
            job_limit: Duration::from_secs(600),
            local_stealing: true,
            share: Share::DEFAULT,
            identity: None,
            cache: None,
            disk_cache_bytes: 32 << 30,
        }
    }
}

/// A worker could not start.
#[derive(Debug, Error)]
pub enum StartError {
    /// A device cannot be opened.
    #[error(transparent)]
    Device(#[from] OpenError),
    /// A device's executor process does not start, or does not open its device.
    #[error("{reason}")]
    Executor {
        /// Its words.
        reason: String,
    },
    /// Not one device was asked for.
    #[error("no device: name one with --device (all, gpu:N, cpu, sim)")]
    NoDevice,
    /// The data plane's address cannot be had.
    #[error(transparent)]
    Listen(#[from] BindError),
    /// The cache folder cannot be used.
    #[error("cache folder {} cannot be used", path.display())]
    Cache {
        /// Which.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// The farm does not let this node in, or is not the node's.
    #[error("denied: {reason}")]
    Denied {
        /// Why.
        reason: String,
    },
    /// The coordinator cannot be reached. May be retried.
    #[error("no coordinator answered within {1:?}")]
    Unreachable(#[source] SessionError, Duration),
    /// The coordinator does not want this node.
    #[error("the coordinator refused this node: {reason}")]
    Refused {
        /// Its reason.
        reason: String,
    },
    /// The process lacks something of the system's.
    #[error("{0}")]
    System(#[from] std::io::Error),
}

/// Why a worker ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// Drained: it holds no job any more and said goodbye.
    Drained,
    /// The farm does not let it in.
    Denied {
        /// Why.
        reason: String,
    },
    /// The coordinator does not want it any more.
    Refused {
        /// Its reason.
        reason: String,
    },
    /// It could not go on.
    Failed {
        /// Why.
        reason: String,
    },
}

/// What a running worker is.
#[derive(Clone, Debug, PartialEq)]
pub struct WorkerInfo {
    /// Its name.
    pub name: String,
    /// Its id at the coordinator.
    pub node: NodeId,
    /// Where its data plane listens.
    pub data: SocketAddr,
    /// How applications reach it, as plans say it.
    pub contact: Contact,
    /// Its devices.
    pub devices: Vec<DeviceInfo>,
}

/// A running worker. Dropping it stops it without draining.
#[derive(Debug)]
pub struct WorkerHandle {
    info: WorkerInfo,
    inputs: mpsc::Sender<Input>,
    driver: JoinHandle<End>,
    end: Option<End>,
}

impl WorkerHandle {
    /// What it is.
    #[must_use]
    pub const fn info(&self) -> &WorkerInfo {
        &self.info
    }

    /// Asks it to take no new work, finish what runs and leave; [`Self::ended`] resolves when it has.
    pub async fn begin_drain(&self) {
        // A driver that is gone has nothing to drain.
        let _ = self.inputs.send(Input::Drain).await;
    }

    /// Waits until it ends by itself. Cancel-safe.
    pub async fn ended(&mut self) -> End {
        if let Some(end) = &self.end {
            return end.clone();
        }
        let ended = (&mut self.driver).await;
        let failed = |error| End::Failed { reason: format!("the worker's task ended: {error}") };
        self.end.insert(ended.unwrap_or_else(failed)).clone()
    }

    /// Takes no new work, finishes what runs, delivers it (for a bounded time), says goodbye and ends.
    pub async fn drain(mut self) -> End {
        self.begin_drain().await;
        self.ended().await
    }
}

impl Drop for WorkerHandle {
    fn drop(&mut self) {
        self.driver.abort();
    }
}

/// Opens the devices, listens, registers, and runs until drained.
///
/// # Errors
/// A device or address cannot be had, or the coordinator cannot be reached in time or refuses.
pub async fn start(options: WorkerOptions) -> Result<WorkerHandle, StartError> {
    let (events_sender, events) = mpsc::unbounded_channel();
    let contents = open_contents(&options).await?;
    let compiled = options.cache.as_ref().map(|cache| cache.join("pipelines"));
    let (specs, shelf) = (options.devices.clone(), contents.shelf());
    let opened =
        executor::open(specs, &options.isolation, compiled.as_deref(), shelf, &events_sender).await?;
    let (devices, infos): (_, Vec<DeviceInfo>) = opened.into_iter().unzip();
    let server = Arc::new(DataServer::bind(options.listen, options.identity.as_ref())?);
    let data = server.local_addr();
    let advertise =
        if options.advertise.is_empty() { vec![data.to_string()] } else { options.advertise.clone() };
    let contact = Contact { addresses: advertise, certificate_der: server.certificate_der().to_vec() };
    let identity = random_u64()?;
    let config = WorkerConfig {
        name: options.name.clone(),
        session: NodeSession(identity),
        devices: infos.clone(),
        contact: contact.clone(),
        max_jobs: MAX_JOBS,
        spool_quota_bytes: options.spool_quota_bytes,
        local_stealing: options.local_stealing,
        share: options.share,
        cached: contents.on_disk(),
        seed: identity,
    };
    let session = session::first(&options.coordinator, options.identity.as_ref(), options.connect_timeout)
        .await
        .map_err(|error| match error {
            SessionError::Denied { reason } => StartError::Denied { reason },
            error => StartError::Unreachable(error, options.connect_timeout),
        })?;

    let (inputs, received) = mpsc::channel(QUEUED_INPUTS);
    let (registered, registration) = oneshot::channel();
    let room = SpoolRoom {
        memory_bytes: options.spool_memory_bytes,
        disk: options.cache.clone().map(|folder| (folder, options.spool_disk_bytes)),
    };
    let setup = Setup {
        options: options.clone(),
        config,
        devices,
        contents,
        spool: Spool::new(room, inputs.clone()),
        events,
        server,
        session,
        inputs: inputs.clone(),
        received,
        registered,
    };
    let mut driver = tokio::spawn(driver::drive(setup));
    let timeout = tokio::time::sleep(options.connect_timeout);
    let node = tokio::select! {
        Ok(node) = registration => node,
        end = &mut driver => {
            let reason = match end {
                Ok(End::Denied { reason }) => return Err(StartError::Denied { reason }),
                Ok(End::Refused { reason } | End::Failed { reason }) => reason,
                Ok(End::Drained) => "it ended before it was registered".to_owned(),
                Err(error) => error.to_string(),
            };
            return Err(StartError::Refused { reason });
        }
        () = timeout => {
            driver.abort();
            let reason = "no answer to the registration".to_owned();
            return Err(StartError::Unreachable(SessionError::Ended { reason }, options.connect_timeout));
        }
    };
    let info = WorkerInfo { name: options.name, node, data, contact, devices: infos };
    Ok(WorkerHandle { info, inputs, driver, end: None })
}

/// Opens the caches; a large folder takes its time.
async fn open_contents(options: &WorkerOptions) -> Result<Contents, StartError> {
    let (cap_bytes, disk_bytes) = (options.content_cache_bytes, options.disk_cache_bytes);
    let open = options.identity.is_none();
    let Some(path) = options.cache.clone() else {
        let memory_alone = Contents::open(cap_bytes, None, open);
        return Ok(memory_alone?);
    };
    let opening = tokio::task::spawn_blocking(move || {
        check_cache(&path)
            .and_then(|()| Contents::open(cap_bytes, Some((&path, disk_bytes)), open))
            .map_err(|source| StartError::Cache { path, source })
    });
    opening.await.map_err(std::io::Error::other)?
}

fn check_cache(path: &std::path::Path) -> std::io::Result<()> {
    std::fs::create_dir_all(path)?;
    let probe = path.join(format!(".probe-{}", std::process::id()));
    std::fs::write(&probe, b"")?;
    std::fs::remove_file(&probe)
}

/// Entropy for the session's identity, from the system.
fn random_u64() -> std::io::Result<u64> {
    use std::io::Read as _;

    let mut bytes = [0; 8];
    std::fs::File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(u64::from_le_bytes(bytes))
}
