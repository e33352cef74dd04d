//! What an application implements for one task: its data, its jobs, and what follows from their results
//! (thesis 5.3.1, 5.3.2). Owns no state; never orders tasks (that is the graph's) and never talks to the farm.

use std::{error::Error, time::Duration};

use farm_core::device::Requirements;
use thiserror::Error;

use crate::{content::TaskData, job::Job};

/// A set of independent jobs over one set of task allocations.
///
/// Calls come from the run's own threads, in the order `prepare`, `requirements`, `jobs`, `more_jobs`*, `finish`;
/// never two at a time for one task.
pub trait Task: Send + 'static {
    /// Runs on a thread of its own once the tasks it depends on are done: CPU work (building a BVH), and the task
    /// allocations and modules that the jobs will name.
    ///
    /// # Errors
    /// The application's own reason; the run ends with [`FarmError::Task`](crate::FarmError::Task).
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        let _ = data;
        Ok(())
    }

    /// What every job of the task needs of a device, beyond what its program says (memory, buffer and binding sizes
    /// and the number of storage buffers are read from the programs).
    fn requirements(&self) -> Requirements {
        Requirements::ANY_REAL
    }

    /// The initial set of jobs. Only a window of them is dispatched at a time. An empty set is a task of CPU work
    /// alone, or one whose jobs all come from `more_jobs`.
    fn jobs(&mut self) -> Vec<Box<dyn Job>>;

    /// More jobs on the same data. Asked whenever all known jobs are dispatched and the window has room: after the
    /// initial set went out, and again after results came in. The task is over when this answers with none while
    /// no job is outstanding ([`TaskProgress::is_idle`]).
    fn more_jobs(&mut self, progress: &TaskProgress) -> Vec<Box<dyn Job>> {
        let _ = progress;
        Vec::new()
    }

    /// Runs once, after the last result was retrieved and before dependent tasks are prepared.
    ///
    /// # Errors
    /// The application's own reason; the run ends with [`FarmError::Task`](crate::FarmError::Task).
    fn finish(&mut self) -> Result<(), TaskError> {
        Ok(())
    }
}

/// How far a task's jobs are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TaskProgress {
    /// Jobs that the task has made so far.
    pub jobs_known: u64,
    /// Jobs whose results were retrieved.
    pub jobs_done: u64,
    /// Measured device time of these.
    pub device_time: Duration,
}

impl TaskProgress {
    /// Whether every known job is done.
    #[must_use]
    pub const fn is_idle(&self) -> bool {
        self.jobs_done == self.jobs_known
    }
}

/// A task's preparation or end failed, for the application's own reason.
#[derive(Debug, Error)]
#[error("{0}")]
pub struct TaskError(#[source] Box<dyn Error + Send + Sync>);

impl TaskError {
    /// The application's own reason: an error or a text.
    pub fn application(reason: impl Into<Box<dyn Error + Send + Sync>>) -> Self {
        Self(reason.into())
    }
}
