//! Encoded programs of attempts, until executed or discarded. The machine says when.

use std::collections::HashMap;

use bytes::Bytes;
use farm_core::id::JobAttempt;
use proto::trust::Scope;

/// A program as it came, and whose contents its names are.
#[derive(Clone, Debug)]
pub(crate) struct Program {
    pub(crate) bytes: Bytes,
    pub(crate) scope: Scope,
}

/// Programs by attempt. As many as the machine holds jobs at most (`MAX_JOBS`).
#[derive(Debug, Default)]
pub(crate) struct Programs(HashMap<JobAttempt, Program>);

impl Programs {
    /// The first program of an attempt stays: a repetition brings the same one, and nobody else may replace it.
    pub(crate) fn keep(&mut self, job: JobAttempt, program: Program) {
        self.0.entry(job).or_insert(program);
    }

    pub(crate) fn get(&self, job: JobAttempt) -> Option<Program> {
        self.0.get(&job).cloned()
    }

    /// It will not run again, or is not here.
    pub(crate) fn discard(&mut self, job: JobAttempt) {
        self.0.remove(&job);
    }
}
