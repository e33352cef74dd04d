//! What a run tells while it goes and when it is over. Data only.

use std::{sync::Arc, time::Duration};

use farm_core::message::WaitReason;

/// How the farm's work for this application stands; the newest value replaces older ones.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Progress {
    /// Jobs whose results were retrieved, over all runs of this connection.
    pub jobs_done: u64,
    /// Of these, those whose results an earlier process had left in a journal.
    pub jobs_journalled: u64,
    /// Jobs that the tasks have made so far; grows while tasks make more.
    pub jobs_known: u64,
    /// New attempts after losses and steals.
    pub replanned: u64,
    /// Measured device time of the jobs done.
    pub device_time: Duration,
    /// Nodes that this application is connected to now.
    pub nodes: usize,
    /// Names of the tasks that are preparing or have jobs, in the order of their start.
    pub active_tasks: Vec<Arc<str>>,
    /// Why jobs wait for a device, if they do.
    pub waiting: Option<WaitReason>,
    /// Whether no node lets us in, though jobs are planned on some.
    pub out_of_reach: bool,
    /// Whether the coordinator is connected; while it is not, work on the nodes goes on.
    pub coordinator: CoordinatorLink,
}

/// How the connection to the coordinator stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CoordinatorLink {
    /// Registered.
    #[default]
    Up,
    /// Lost; being tried again with back-off.
    Reconnecting,
}

/// What a complete run came to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RunSummary {
    /// Jobs retrieved.
    pub jobs: u64,
    /// Of these, those whose results an earlier process had left in the journal.
    pub journalled: u64,
    /// New attempts after losses and steals (of this connection while the run went).
    pub replanned: u64,
    /// Measured device time of the jobs.
    pub device_time: Duration,
    /// Bytes of task allocations and modules that nodes fetched from this application while the run went (for all its
    /// runs); what they took from each other does not count.
    pub uploaded_bytes: u64,
    /// Time from the call of `run` to its return.
    pub wall_time: Duration,
    /// By task, in the order they were added to the graph.
    pub tasks: Vec<TaskSummary>,
}

/// One task of a complete run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TaskSummary {
    /// Its name in the graph.
    pub name: String,
    /// Jobs retrieved.
    pub jobs: u64,
    /// Measured device time of the jobs.
    pub device_time: Duration,
    /// Time its `prepare` took.
    pub prepare_time: Duration,
}
