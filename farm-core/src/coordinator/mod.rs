//! The coordinator's state machine: registration, FCFS placement over scored devices, leases, completions.
//!
//! It owns plans, load and fairness; it never owns job payloads, sockets or clocks. A driver feeds events by connection
//! ([`LinkId`]) and carries the effects out.

use serde::{Deserialize, Serialize};

use crate::{
    device::DeviceKind,
    id::{AppId, DeviceIndex, Epoch, LinkId, NodeId},
    message::{AppToCoordinator, CoordinatorToApp, CoordinatorToNode, Liveness, NodeToCoordinator},
    time::Instant,
};

/// Settings of a coordinator.
#[derive(Clone, Debug)]
pub struct CoordinatorConfig {
    /// This life; larger than every earlier one.
    pub epoch: Epoch,
    /// Timings told to nodes and applications, and judged by.
    pub liveness: Liveness,
    /// How long a vanished application keeps its jobs.
    pub app_lease_ms: u64,
    /// Attempts that may end with their device or node before the job counts as poison.
    pub max_crashes: u32,
    /// Seed of the machine's one generator.
    pub seed: u64,
}

impl CoordinatorConfig {
    /// The design's values (20-delivery.md).
    #[must_use]
    pub fn new(epoch: Epoch, seed: u64) -> Self {
        Self { epoch, liveness: Liveness::default(), app_lease_ms: 30_000, max_crashes: 3, seed }
    }
}

/// What happens to a coordinator.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// An application said something.
    FromApp {
        /// On which connection.
        link: LinkId,
        /// What.
        message: AppToCoordinator,
    },
    /// A node said something.
    FromNode {
        /// On which connection.
        link: LinkId,
        /// What.
        message: NodeToCoordinator,
    },
    /// A connection of either kind is gone.
    LinkClosed {
        /// Which.
        link: LinkId,
    },
    /// An operator asks a node to leave.
    DrainRequested {
        /// Which.
        node: NodeId,
    },
}

/// What a coordinator wants done.
#[derive(Clone, Debug, PartialEq)]
pub enum Effect {
    /// Say something to an application.
    ToApp {
        /// On which connection.
        link: LinkId,
        /// What.
        message: CoordinatorToApp,
    },
    /// Say something to a node.
    ToNode {
        /// On which connection.
        link: LinkId,
        /// What.
        message: CoordinatorToNode,
    },
    /// Close a connection after what was said on it.
    Close {
        /// Which.
        link: LinkId,
    },
}

/// How a node stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NodeState {
    /// Heartbeats come.
    Alive,
    /// Silent or disconnected; gets no new work.
    Suspect,
    /// Finishing what it has, takes nothing new.
    Draining,
}

/// A device in [`FarmStatus`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeviceStatus {
    /// Index in its node.
    pub device: DeviceIndex,
    /// For people.
    pub name: String,
    /// How it computes.
    pub kind: DeviceKind,
    /// Announced score, GFLOP/s.
    pub score: f64,
    /// Attempts planned there and not yet executed.
    pub planned_jobs: u64,
    /// Running now, by the last heartbeat.
    pub running_jobs: u32,
    /// Executed so far.
    pub executed_jobs: u64,
    /// Device time of these, nanoseconds.
    pub device_time_ns: u64,
}

/// A node in [`FarmStatus`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeStatus {
    /// The node.
    pub node: NodeId,
    /// For people.
    pub name: String,
    /// How it stands.
    pub state: NodeState,
    /// Its data addresses.
    pub addresses: Vec<String>,
    /// Its devices.
    pub devices: Vec<DeviceStatus>,
}

/// An application in [`FarmStatus`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AppStatus {
    /// The application.
    pub app: AppId,
    /// For people.
    pub name: String,
    /// Fair-share weight.
    pub weight: f64,
    /// Whether its connection stands.
    pub connected: bool,
    /// Jobs asked for and not yet placed.
    pub waiting_jobs: u64,
    /// Jobs placed and not yet delivered.
    pub outstanding_jobs: u64,
    /// Jobs delivered.
    pub delivered_jobs: u64,
    /// Device time received, nanoseconds.
    pub device_time_ns: u64,
}

/// The farm as an operator sees it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FarmStatus {
    /// The coordinator's life.
    pub epoch: Epoch,
    /// Nodes by id.
    pub nodes: Vec<NodeStatus>,
    /// Applications by id.
    pub apps: Vec<AppStatus>,
    /// Jobs delivered since this start.
    pub delivered_jobs: u64,
    /// New attempts after a loss since this start.
    pub replanned_jobs: u64,
}

/// The coordinator.
#[derive(Debug)]
pub struct CoordinatorMachine {
    config: CoordinatorConfig,
}

impl CoordinatorMachine {
    /// A coordinator that knows nobody yet.
    #[must_use]
    pub fn new(config: CoordinatorConfig) -> Self {
        Self { config }
    }

    /// Takes one event in.
    pub fn handle(&mut self, now: Instant, event: Event) {
        let _ = (now, event, &self.config);
    }

    /// Acts on the timers that are due.
    pub fn handle_timeout(&mut self, now: Instant) {
        let _ = now;
    }

    /// When [`Self::handle_timeout`] wants to be called next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        None
    }

    /// The next thing to do; call until `None` after every `handle` and `handle_timeout`.
    pub fn poll_effect(&mut self) -> Option<Effect> {
        None
    }

    /// The farm as an operator sees it.
    #[must_use]
    pub fn status(&self) -> FarmStatus {
        FarmStatus { epoch: self.config.epoch, nodes: Vec::new(), apps: Vec::new(), delivered_jobs: 0, replanned_jobs: 0 }
    }

    /// Asserts what must hold between any two events.
    ///
    /// # Panics
    /// An invariant is broken; the message says which.
    pub fn check_invariants(&self) {}
}
