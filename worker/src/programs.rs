//! Encoded programs of attempts, until executed or discarded. The machine says when.

use std::collections::HashMap;

use bytes::Bytes;
use farm_core::id::JobAttempt;

/// Programs by attempt. As many as the machine holds jobs at most (`MAX_JOBS`).
#[derive(Debug, Default)]
pub(crate) struct Programs(HashMap<JobAttempt, Bytes>);

impl Programs {
    /// The first program of an attempt stays: a repetition brings the same one, and nobody else may replace it.
    pub(crate) fn keep(&mut self, job: JobAttempt, program: Bytes) {
        self.0.entry(job).or_insert(program);
    }

    pub(crate) fn get(&self, job: JobAttempt) -> Option<Bytes> {
        self.0.get(&job).cloned()
    }

    /// It will not run again, or is not here.
    pub(crate) fn discard(&mut self, job: JobAttempt) {
        self.0.remove(&job);
    }
}
