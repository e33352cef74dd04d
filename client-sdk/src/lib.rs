//! What an application links: [`Farm`], [`Task`], [`Job`], `dispatch` and `retrieve` (thesis 5.3).
//!
//! An application is a graph of **tasks**; a task makes independent **jobs**; a job is a command buffer of kernel launches
//! that `dispatch()` fills with the verbs of [`JobProgram`] and whose result `retrieve()` takes. The farm decides where
//! jobs run, moves them when machines come and go, and gives each result back exactly once.
//!
//! ```no_run
//! use std::sync::{Arc, Mutex};
//!
//! use client_sdk::{
//!     Content, DispatchError, Farm, FarmError, FarmOptions, Job, JobProgram, JobResult, RetrieveError, Task, TaskData,
//!     TaskError, TaskGraph,
//! };
//!
//! const SQUARE: &str = "
//! @group(0) @binding(0) var<storage, read_write> value: array<u32>;
//! @compute @workgroup_size(1)
//! fn square() { value[0] = value[0] * value[0]; }
//! ";
//!
//! #[derive(Default)]
//! struct Squares {
//!     module: Option<Content>,
//!     total: Arc<Mutex<u64>>,
//! }
//!
//! impl Task for Squares {
//!     fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
//!         self.module = Some(data.module(SQUARE));
//!         Ok(())
//!     }
//!
//!     fn jobs(&mut self) -> Vec<Box<dyn Job>> {
//!         let module = self.module.expect("prepare comes first");
//!         (0..100).map(|value| Box::new(Square { value, module, total: self.total.clone() }) as Box<dyn Job>).collect()
//!     }
//! }
//!
//! struct Square {
//!     value: u32,
//!     module: Content,
//!     total: Arc<Mutex<u64>>,
//! }
//!
//! impl Job for Square {
//!     fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
//!         let square = cmd.function(self.module, "square");
//!         let value = cmd.malloc(4)?;
//!         cmd.memcpy_htod_buffer(value, 0, &self.value.to_le_bytes())?;
//!         cmd.param_in_out(square, 0, value)?;
//!         cmd.launch(square, [1, 1, 1])?;
//!         cmd.memcpy_dtoh(value, 0, 4)
//!     }
//!
//!     fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
//!         let square = result.section(0, 4)?;
//!         *self.total.lock().unwrap() += u64::from(u32::from_le_bytes([square[0], square[1], square[2], square[3]]));
//!         Ok(())
//!     }
//! }
//!
//! # #[tokio::main]
//! # async fn main() -> Result<(), FarmError> {
//! let farm = Farm::connect(FarmOptions::new("127.0.0.1:7700", "squares")).await?;
//! let total = Arc::new(Mutex::new(0));
//! let task = Squares { total: total.clone(), ..Squares::default() };
//! let summary = farm.run(TaskGraph::new().task("squares", task)).await?;
//! println!("{} jobs, sum {}", summary.jobs, total.lock().unwrap());
//! farm.close().await;
//! # Ok(())
//! # }
//! ```
//!
//! Who runs what: one async task owns the application's job ledger (`farm_core::ledger`) and all connections; each run has
//! a thread of its own that calls the application's methods, so these may compute and block. Memory is bounded by
//! [`Window`]: only so many jobs are dispatched and not yet retrieved.
//!
//! `docs/sdk.md` says how to bring a kernel, `docs/porting.md` how to port a CUDA application, and
//! `examples/vector_add.rs` is a whole one.

mod content;
mod driver;
mod error;
mod farm;
mod graph;
mod job;
mod journal;
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
pub use proto::trust::Identity;

pub use crate::{
    content::TaskData,
    error::FarmError,
    farm::{Farm, StopHandle},
    graph::{GraphError, TaskGraph},
    job::{Job, JobResult, RetrieveError},
    journal::{Journal, JournalError},
    options::{FarmOptions, Window},
    progress::{CoordinatorLink, Progress, RunSummary, TaskSummary},
    task::{Task, TaskError, TaskProgress},
};
