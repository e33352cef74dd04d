//! The bytes that belong to attempts: encoded programs until executed, results until discarded. The machine says when.

use std::collections::HashMap;

use bytes::Bytes;
use farm_core::id::JobAttempt;

/// Programs and results by attempt. As many as the machine holds jobs (`MAX_JOBS`), one of the two each at rest.
#[derive(Debug, Default)]
pub(crate) struct Payloads {
    programs: HashMap<JobAttempt, Bytes>,
    results: HashMap<JobAttempt, Vec<Bytes>>,
}

impl Payloads {
    /// The first program of an attempt stays: a repetition brings the same one, and nobody else may replace it.
    pub(crate) fn keep_program(&mut self, job: JobAttempt, program: Bytes) {
        self.programs.entry(job).or_insert(program);
    }

    pub(crate) fn program(&self, job: JobAttempt) -> Option<Bytes> {
        self.programs.get(&job).cloned()
    }

    /// A result takes its program's place: it will not run again.
    pub(crate) fn keep_result(&mut self, job: JobAttempt, sections: Vec<Bytes>) {
        self.programs.remove(&job);
        self.results.insert(job, sections);
    }

    /// A result's bytes; none for a failure.
    pub(crate) fn result(&self, job: JobAttempt) -> Vec<Bytes> {
        self.results.get(&job).cloned().unwrap_or_default()
    }

    pub(crate) fn discard(&mut self, job: JobAttempt) {
        self.programs.remove(&job);
        self.results.remove(&job);
    }
}
