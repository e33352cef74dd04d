//! What jobs do when they run: how long they take, what they compute, which of them go wrong.

use std::{collections::BTreeSet, time::Duration};

use farm_core::{
    device::Requirements,
    id::{ContentHash, JobId, JobIndex, TaskId},
    ledger::{Event, SubmittedJob},
    message::{CostNs, LatencyClass, Priority},
    program::Content,
    time::Instant,
};

use super::world::{Happening, MILLISECOND, World};

/// What jobs do when they run.
#[derive(Debug, Default)]
pub struct Work {
    /// Tasks whose jobs crash whatever runs them.
    pub poison: BTreeSet<TaskId>,
    /// Tasks whose jobs never end: their executor ends them at [`JOB_LIMIT`].
    pub hangs: BTreeSet<TaskId>,
    /// Jobs that take the worker's process along when they end.
    pub deadly: BTreeSet<(TaskId, JobIndex)>,
    /// Tasks whose jobs are wrong.
    pub invalid: BTreeSet<TaskId>,
    /// One in this many runs ends with a retryable failure; 0 for none.
    pub(super) crash_one_in: u32,
    /// One in this many fetches fails; 0 for none.
    pub(super) fetch_fails_one_in: u32,
}

/// I3: the payload is a function of the job alone.
pub(super) fn digest(job: JobId) -> ContentHash {
    let mut hash = [7; 32];
    hash[..4].copy_from_slice(&job.index.0.to_le_bytes());
    hash[4..8].copy_from_slice(&job.task.0.to_le_bytes());
    hash[8..16].copy_from_slice(&job.app.0.to_le_bytes());
    ContentHash(hash)
}

/// Device time at speed 1.0: 0.1 to 20 ms, by a hash of the index.
#[must_use]
pub fn cost_ns(index: JobIndex) -> u64 {
    100_000 + u64::from(index.0.wrapping_mul(2_654_435_761) % 19_900) * 1_000
}

/// Lengths of a job's result: a few kilobytes at most.
pub(super) fn result_sections(index: JobIndex) -> Vec<u64> {
    vec![4, u64::from(index.0) * 4]
}

/// What an executor gives a job.
pub const JOB_LIMIT: Duration = Duration::from_secs(10);

/// Most that [`cost_ns`] gives.
pub(super) const MAX_COST_NS: u64 = 20_000_000;

impl World {
    /// Has an application submit a task of `count` jobs at a time. Every other task's costs are known.
    pub fn submit(&mut self, at_ms: u64, app: usize, task: u32, count: u32) {
        self.apps[app].expected += usize::try_from(count).expect("small");
        let interactive = self.setup.interactive && app.is_multiple_of(2);
        let class = if interactive { LatencyClass::Interactive } else { LatencyClass::Batch };
        let jobs = jobs(count, class, task.is_multiple_of(2));
        let event = Event::Submitted { task: TaskId(task), jobs, needs: Requirements::ANY };
        self.at(Instant(at_ms * MILLISECOND), Happening::App { app, event });
    }
}

fn jobs(count: u32, class: LatencyClass, known_cost: bool) -> Vec<SubmittedJob> {
    // The first two are large: nodes take them from each other.
    let content = |tag: u8| Content {
        hash: ContentHash([tag; 32]),
        size_bytes: if tag <= 2 { 2 << 20 } else { 1_024 },
    };
    (0..count)
        .map(|index| SubmittedJob {
            index: JobIndex(index),
            cost: CostNs(if known_cost { cost_ns(JobIndex(index)) } else { 0 }),
            class,
            priority: Priority(i32::from(index % 7 == 0)),
            module: Some(ContentHash([1; 32])),
            contents: vec![content(1), content(u8::try_from(2 + index % 3).expect("small"))],
        })
        .collect()
}
