//! What an application implements for one kernel job: `dispatch()` fills a program, `retrieve()` takes its result
//! (thesis 5.3.2, listings B.1 and B.2). Owns no state; never knows where a job runs.

use std::{error::Error, time::Duration};

use bytes::Bytes;
use farm_core::{
    id::NodeId,
    message::{CostNs, JobFailure, LatencyClass, Priority},
    program::{DispatchError, JobProgram},
};
use thiserror::Error;

/// One independent piece of a task: a command buffer out, a result back.
///
/// `dispatch` is called once, when the window of outstanding jobs has room, perhaps side by side with other jobs of the
/// task. After it exactly one of `retrieve` and `failed` is called, unless the run ends first. All calls of one
/// job come from the run's own threads, never from the async runtime, so they may compute and block.
pub trait Job: Send + 'static {
    /// Fills the job's program. It must be a pure function of the job: the farm may execute it more than once (after a
    /// node is lost) and gives only one result back.
    ///
    /// # Errors
    /// A verb refused its arguments, or the application's own reason; the run ends with
    /// [`FarmError::Dispatch`](crate::FarmError::Dispatch).
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError>;

    /// Takes the result: one section for each `memcpy_dtoh`, in program order. Called exactly once, in order of arrival.
    ///
    /// # Errors
    /// The application cannot use the result; the run ends with [`FarmError::Retrieve`](crate::FarmError::Retrieve).
    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError>;

    /// Hears that the job is over without a result; the run then ends with
    /// [`FarmError::JobFailed`](crate::FarmError::JobFailed).
    fn failed(&mut self, failure: &JobFailure) {
        let _ = failure;
    }

    /// Estimated work. Zero (the default) takes the sum of the program's launch costs.
    fn cost(&self) -> CostNs {
        CostNs(0)
    }

    /// When the job may take a device. An interactive one goes ahead of batch jobs, and takes the device of one that runs
    /// at its next launch boundary, as long as its application has not had more than its fair share.
    fn latency_class(&self) -> LatencyClass {
        LatencyClass::Batch
    }

    /// Order inside the application and class: larger goes first.
    fn priority(&self) -> Priority {
        Priority(0)
    }
}

/// What one execution of a job gave.
#[derive(Clone, Debug)]
pub struct JobResult {
    /// One for each `memcpy_dtoh` of the program, in program order.
    pub sections: Vec<Bytes>,
    /// Measured time on the device.
    pub device_time: Duration,
    /// Who computed it.
    pub node: NodeId,
}

impl JobResult {
    /// Section `index`, checked to be `expected_bytes` long.
    ///
    /// # Errors
    /// There is no such section, or it has another length.
    pub fn section(&self, index: usize, expected_bytes: usize) -> Result<Bytes, RetrieveError> {
        let section = self
            .sections
            .get(index)
            .ok_or(RetrieveError::MissingSection { section: index, sections: self.sections.len() })?;
        if section.len() != expected_bytes {
            return Err(RetrieveError::SectionSize {
                section: index,
                expected_bytes,
                found_bytes: section.len(),
            });
        }
        Ok(section.clone())
    }
}

/// Cuts a payload into its sections; no bytes are copied. Who calls has checked that the lengths add up.
pub(crate) fn split_sections(mut payload: Bytes, sections: &[u64]) -> Vec<Bytes> {
    let cut = |length: &u64| {
        let length = usize::try_from(*length).expect("a section is a part of a payload in memory");
        payload.split_to(length)
    };
    sections.iter().map(cut).collect()
}

/// A result could not be used. Not retried: the same job would give the same result.
#[derive(Debug, Error)]
pub enum RetrieveError {
    /// The program copied fewer sections than asked for.
    #[error("the result has {sections} sections, section {section} was asked for")]
    MissingSection {
        /// The section asked for.
        section: usize,
        /// How many there are.
        sections: usize,
    },
    /// A section has another length than the application computed.
    #[error("section {section} of the result has {found_bytes} B, expected {expected_bytes} B")]
    SectionSize {
        /// The section.
        section: usize,
        /// What the application expected.
        expected_bytes: usize,
        /// What came.
        found_bytes: usize,
    },
    /// The application's own reason.
    #[error("{0}")]
    Application(#[source] Box<dyn Error + Send + Sync>),
}

impl RetrieveError {
    /// The application's own reason: an error or a text.
    pub fn application(reason: impl Into<Box<dyn Error + Send + Sync>>) -> Self {
        Self::Application(reason.into())
    }
}
