//! The coordinator's driver: gRPC sessions, control store, status page and metrics around
//! `farm_core::coordinator::CoordinatorMachine`.
//!
//! One task owns the machine; everything else sends it messages. It never decides who runs what: the machine does.

mod audit;
mod identities;
mod keeper;
mod lead;
mod numbered;
mod owner;
pub mod plugins;
pub mod policy_host;
mod security;
mod sessions;
mod store;
mod web;

use std::{
    collections::BTreeMap,
    hash::{BuildHasher as _, Hasher as _, RandomState},
    net::SocketAddr,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use farm_core::{
    coordinator::{CoordinatorConfig, CoordinatorMachine, FarmStatus, durable::Restored},
    id::NodeId,
    message::Liveness,
};
use proto::{control::Incoming, net::TcpListener};
use thiserror::Error;
use tokio::{
    sync::{oneshot, watch},
    task::{JoinHandle, JoinSet},
};

use self::{
    keeper::Keeper,
    lead::Lead,
    owner::{Owner, OwnerHandle},
    plugins::{PluginOptions, Plugins},
    security::{Gate, Security, TrustService},
    sessions::Sessions,
    store::{Store, epoch_by_the_clock},
};
pub use self::{
    lead::{Vacancy, stand_by},
    security::{AUTHORITY_FILE, initialise},
};

/// How long `shutdown` waits for connections to close by themselves before it cuts them.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(2);

/// What a coordinator is started with.
#[derive(Clone, Debug)]
pub struct CoordinatorOptions {
    /// gRPC address; port 0 lets the system choose.
    pub listen: SocketAddr,
    /// HTTP address (status page, metrics, health); port 0 lets the system choose.
    pub http: SocketAddr,
    /// Where the epoch and members are kept; `None`: nowhere, the epoch is the time of the start.
    pub state: Option<PathBuf>,
    /// What [`stand_by`] found, for a coordinator that takes over. `None`: nobody uses the state directory, or the start fails.
    pub vacancy: Option<Vacancy>,
    /// Whether members of the farm alone are let in, by the authority in the state directory.
    pub secured: bool,
    /// Whether everyone is let in though the state directory knows of members.
    pub insecure: bool,
    /// Timings told to nodes and applications.
    pub liveness: Liveness,
    /// How long a vanished application keeps its jobs, in milliseconds.
    pub app_lease_ms: u64,
    /// The plug-in policies that applications may choose; `None`: there are none.
    pub plugins: Option<PluginOptions>,
}

impl Default for CoordinatorOptions {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 7700)),
            http: SocketAddr::from(([127, 0, 0, 1], 7701)),
            state: None,
            vacancy: None,
            secured: false,
            insecure: false,
            liveness: Liveness::default(),
            app_lease_ms: 30_000,
            plugins: None,
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
    #[error("cannot listen on {address} ({what})")]
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
    /// Another coordinator has the state directory open.
    #[error("state directory {path}: another coordinator uses it (--standby waits for it)")]
    InUse {
        /// Which.
        path: PathBuf,
    },
    /// Another coordinator took the lead that this one was about to take. It may stand by again.
    #[error("another coordinator leads now")]
    Outrun,
    /// The farm's authority or identities cannot be used.
    #[error("{0}")]
    Trust(String),
    /// The plug-in folder, a plug-in or the plug-ins' host cannot be used.
    #[error("plug-in {path}: {reason}")]
    Plugin {
        /// Folder or file.
        path: PathBuf,
        /// Why not.
        reason: String,
    },
}

/// A running coordinator. Dropping it stops it without waiting.
#[derive(Debug)]
pub struct CoordinatorHandle {
    owner: OwnerHandle,
    grpc_addr: SocketAddr,
    http_addr: SocketAddr,
    /// Dropped: the owner ends every session and stops.
    stop_owner: oneshot::Sender<()>,
    /// Dropped: the listeners take nothing new and end when their connections do.
    stop_servers: watch::Sender<()>,
    /// Owner, what writes for it, gRPC server, HTTP server.
    tasks: Vec<JoinHandle<()>>,
    /// Keeps the state directory locked.
    store: Option<Arc<Store>>,
    /// Renews the coordinator's certificate; ends with the handle.
    renewal: JoinSet<()>,
}

impl CoordinatorHandle {
    /// Where applications and nodes connect.
    #[must_use]
    pub const fn grpc_addr(&self) -> SocketAddr {
        self.grpc_addr
    }

    /// Where the status page is.
    #[must_use]
    pub const fn http_addr(&self) -> SocketAddr {
        self.http_addr
    }

    /// The farm as an operator sees it; `None` once it has stopped.
    pub async fn status(&self) -> Option<FarmStatus> {
        self.owner.status().await
    }

    /// Asks a node to finish what it has and leave. Whether there is such a node; `None` once it has stopped.
    pub async fn drain(&self, node: NodeId) -> Option<bool> {
        self.owner.drain(node).await
    }

    /// Waits until the coordinator has stopped by itself, for a broken invariant, never a peer's fault, or until another one has
    /// taken its farm over: then it is to be dropped. The log says why. Cancel-safe.
    pub async fn stopped(&self) {
        tokio::select! {
            () = self.owner.stopped() => {}
            () = self.taken_over() => {}
        }
    }

    /// Waits until another coordinator has taken the farm over. Cancel-safe.
    pub async fn taken_over(&self) {
        match self.store.as_ref().and_then(|store| store.lead()) {
            Some(lead) => lead.over().await,
            None => std::future::pending().await,
        }
    }

    /// Closes every session and waits (at most two seconds) until all is down.
    pub async fn shutdown(self) {
        let Self { stop_owner, stop_servers, tasks, mut renewal, .. } = self;
        drop(stop_owner);
        drop(stop_servers);
        for mut task in tasks {
            // A connection that does not close in time is cut; a task that failed has said so.
            if tokio::time::timeout(SHUTDOWN_TIMEOUT, &mut task).await.is_err() {
                task.abort();
            }
        }
        // It holds the state directory, too.
        renewal.shutdown().await;
    }
}

/// Reads all that a state directory's control store keeps: one that passes can be started on. Takes no epoch; makes what is
/// not there.
///
/// # Errors
/// The state directory cannot be used; the error names it or its file.
pub fn check_state(directory: &Path) -> Result<(), StartError> {
    Store::open(directory)?.read_all()
}

/// Starts a coordinator on the current tokio runtime.
///
/// # Errors
/// An address or the state directory cannot be had.
pub async fn start(options: CoordinatorOptions) -> Result<CoordinatorHandle, StartError> {
    let (grpc, grpc_addr) = listen("gRPC", options.listen).await?;
    let (http, http_addr) = listen("HTTP", options.http).await?;
    let plugins = match &options.plugins {
        Some(plugins) => Plugins::open(plugins).await?,
        None => Plugins::none(),
    };
    // After the addresses: a second coordinator on them is refused without counting as a life.
    let store = options.state.as_deref().map(|state| lead_by(state, &options)).transpose()?.map(Arc::new);
    let epoch = store.as_deref().map_or_else(|| Ok(epoch_by_the_clock()), Store::begin_epoch)?;
    let restored = store.as_deref().map_or_else(|| Ok(Restored::default()), Store::restore)?;
    // An open farm has one project, and no operator who could give it a quota.
    let quotas = match store.as_deref().filter(|_| options.secured) {
        Some(store) => store.restore_quotas()?,
        None => BTreeMap::new(),
    };
    let gate = match (options.secured, &options.state) {
        (false, _) if !options.insecure && store.as_deref().is_some_and(Store::has_members) => {
            return Err(StartError::Trust(format!(
                "the state directory knows of members, but its {AUTHORITY_FILE} cannot be found: restore it, or secure the farm \
                 anew with `farmctl init`, or let everyone in with --insecure"
            )));
        }
        (false, _) => Gate::Open,
        (true, Some(directory)) => {
            let store = store.clone().ok_or_else(|| StartError::Trust("no control store".to_owned()))?;
            Gate::Members(Security::open(directory, store)?)
        }
        (true, None) => return Err(StartError::Trust("a secured farm needs a state directory".to_owned())),
    };
    let config = CoordinatorConfig {
        liveness: options.liveness,
        app_lease_ms: options.app_lease_ms,
        plugins: plugins.names(),
        restored,
        quotas,
        ..CoordinatorConfig::new(epoch, random_seed())
    };

    let lead = store.as_ref().and_then(|store| store.lead());
    let (owner, commands) = OwnerHandle::new(lead.map(|lead| lead.standbys()).unwrap_or_default());
    let (stop_owner, owner_stops) = oneshot::channel();
    let (stop_servers, servers_stop) = watch::channel(());
    let incoming = match &gate {
        Gate::Open => Incoming::of(grpc),
        Gate::Members(security) => Incoming::secured(grpc, security.identity())
            .map_err(|error| StartError::Trust(error.to_string()))?,
    };
    let mut renewal = JoinSet::new();
    if let Gate::Members(security) = &gate {
        renewal.spawn(Arc::clone(security).stay_valid());
    }
    let machine = CoordinatorMachine::new(config);
    let mut tasks = Vec::new();
    let keeper = store.as_ref().map_or_else(Keeper::none, |store| {
        let (keeper, writes) = Keeper::new(Arc::downgrade(store));
        tasks.push(tokio::spawn(writes));
        keeper
    });
    let owner_task =
        tokio::spawn(Owner::new(machine, plugins, keeper, gate.clone()).run(commands, owner_stops));
    let grpc_task = tokio::spawn(serve_grpc(incoming, owner.clone(), gate, servers_stop.clone()));
    let http_task = tokio::spawn(serve_http(http, owner.clone(), servers_stop));
    if let Some(lead) = lead {
        lead.serves();
    }
    tracing::info!(%epoch, grpc = %grpc_addr, http = %http_addr, secured = options.secured, "coordinator started");
    tasks.splice(0..0, [owner_task, grpc_task, http_task]);
    Ok(CoordinatorHandle { owner, grpc_addr, http_addr, stop_owner, stop_servers, tasks, store, renewal })
}

/// Opens the state directory as the one coordinator that leads by it.
fn lead_by(directory: &Path, options: &CoordinatorOptions) -> Result<Store, StartError> {
    let take = |predecessor| Lead::take(directory, predecessor, options.liveness);
    match options.vacancy {
        Some(Vacancy { term, silent: true }) => Store::copied_by(directory, take(Some(term))?),
        vacancy => {
            // Its lock says that nobody leads.
            let store = Store::open(directory)?;
            store.led_by(directory, take(vacancy.map(|vacancy| vacancy.term))?)
        }
    }
}

/// Whether a coordinator with these options could listen, as a standby will have to.
///
/// # Errors
/// An address cannot be had.
pub async fn check_addresses(options: &CoordinatorOptions) -> Result<(), StartError> {
    listen("gRPC", options.listen).await?;
    listen("HTTP", options.http).await?;
    Ok(())
}

async fn listen(what: &'static str, address: SocketAddr) -> Result<(TcpListener, SocketAddr), StartError> {
    let fault = |source| StartError::Listen { what, address, source };
    let listener = TcpListener::bind(address).await.map_err(fault)?;
    let local = listener.local_addr().map_err(fault)?;
    Ok((listener, local))
}

async fn serve_grpc(incoming: Incoming, owner: OwnerHandle, gate: Gate, mut stop: watch::Receiver<()>) {
    use proto::control::{admin_server, apps_server, nodes_server, server, trust_server};
    let sessions = Sessions::new(owner.clone(), gate.clone());
    let served = server()
        .add_service(apps_server(sessions.clone()))
        .add_service(nodes_server(sessions.clone()))
        .add_service(admin_server(sessions))
        .add_service(trust_server(TrustService::new(gate, owner)))
        .serve_with_incoming_shutdown(incoming, async move {
            // The error is the signal: the handle is gone.
            let _ = stop.changed().await;
        })
        .await;
    if let Err(error) = served {
        tracing::error!(%error, "the gRPC server ended");
    }
}

async fn serve_http(listener: TcpListener, owner: OwnerHandle, mut stop: watch::Receiver<()>) {
    let served =
        axum::serve(web::Listener::of(listener), web::router(owner)).with_graceful_shutdown(async move {
            // The error is the signal: the handle is gone.
            let _ = stop.changed().await;
        });
    if let Err(error) = served.await {
        tracing::error!(%error, "the HTTP server ended");
    }
}

/// A seed that differs from life to life: the standard library's hasher keys come from the system.
fn random_seed() -> u64 {
    RandomState::new().build_hasher().finish()
}
