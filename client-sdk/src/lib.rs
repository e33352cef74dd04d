//! What an application links: [`Farm`], [`Task`], [`Job`], `dispatch` and `retrieve`.

mod content;
mod driver;
mod error;
mod farm;
mod graph;
mod job;
mod options;
mod progress;
mod run;
mod task;

pub use bytes::Bytes;
pub use farm_core::{
    device::{Features, Limits, Requirements, SimulatedDevices},
    id::{ContentHash, JobIndex, NodeId},
    message::{CostNs, JobFailure, Priority, WaitReason},
    program::{Access, Buffer, Content, DispatchError, JobProgram, Kernel, ProgramError, Slicing},
};

pub use crate::{
    content::TaskData,
    error::FarmError,
    farm::{Farm, StopHandle},
    graph::{GraphError, TaskGraph},
    job::{Job, JobResult, RetrieveError},
    options::{FarmOptions, Window},
    progress::{CoordinatorLink, Progress, RunSummary, TaskSummary},
    task::{Task, TaskError, TaskProgress},
};
