//! How the jobs of a batch are spread over the devices that may take them: the policies an application may choose from
//! (10-scheduling.md section 1).
//!
//! A policy sees a batch and the devices, and answers a choice for every job. It keeps no books and changes none. Two
//! are built in; a third kind, the plug-in, is a shared object that the coordinator's driver asks in a process of its
//! own, and its answer comes as an event.

use serde::{Deserialize, Serialize};

use crate::id::{AppId, DeviceIndex, JobIndex, NodeId, TaskId};

/// Name of the policy that takes jobs in their order and each to the device that would finish it first.
pub const FCFS: &str = "fcfs";

/// Name of the policy that knows what the same job took in the application's last task.
pub const HISTORY: &str = "history";

/// One question to a plug-in, never reused in one life of the coordinator.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct QuestionId(pub u64);

/// A batch to be placed, as a policy sees it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Question {
    /// Whose jobs.
    pub app: AppId,
    /// Their task.
    pub task: TaskId,
    /// The jobs, in the order they were asked for.
    pub jobs: Vec<QuestionJob>,
    /// The devices that may take them; at least one.
    pub devices: Vec<QuestionDevice>,
}

/// A job of a [`Question`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct QuestionJob {
    /// Its index in the task.
    pub index: JobIndex,
    /// Estimated work; nanoseconds on a device of speed 1.0 if the application said so, else in a unit of the batch's own.
    pub load_ns: u64,
}

/// A device of a [`Question`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct QuestionDevice {
    /// Its node.
    pub node: NodeId,
    /// Which of the node's.
    pub device: DeviceIndex,
    /// When it will be done with what it has, in nanoseconds from now.
    pub free_at_ns: f64,
    /// Nanoseconds that a unit of load takes there.
    pub time_per_load: f64,
    /// Time to bring what it lacks of the batch's contents, in nanoseconds; zero if it has all of them.
    pub fetch_ns: f64,
}

/// A job's place, by positions in the [`Question`]'s lists.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Choice {
    /// Which of the jobs.
    pub job: u32,
    /// Which of the devices.
    pub device: u32,
}
