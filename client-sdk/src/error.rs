//! Why a farm call failed. Each variant names its cause; [`FarmError::can_be_retried`] says what trying again may help.

use std::time::Duration;

use farm_core::{
    id::JobIndex,
    message::{JobFailure, WaitReason},
    program::{Content, DispatchError, ProgramError},
};
use thiserror::Error;

use crate::{graph::GraphError, job::RetrieveError, journal::JournalError, task::TaskError};

/// Why connecting or a run failed.
#[derive(Debug, Error)]
pub enum FarmError {
    /// An option is out of its range.
    #[error("option `{option}`: {reason}")]
    Options {
        /// Its name.
        option: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// The coordinator could not be reached.
    #[error("coordinator {address} cannot be reached: {reason}")]
    Unreachable {
        /// What was tried.
        address: String,
        /// Why it failed.
        reason: String,
    },
    /// The coordinator answered and does not want us.
    #[error("coordinator {address} refused this application: {reason}")]
    Refused {
        /// Who.
        address: String,
        /// Its reason.
        reason: String,
    },
    /// The farm does not let this application in, or is not the application's.
    #[error("coordinator {address} denies: {reason}")]
    Denied {
        /// Who.
        address: String,
        /// Why.
        reason: String,
    },
    /// The coordinator was lost during a run and did not come back in time.
    #[error("coordinator {address} was lost and did not come back within {waited:.1?}: {reason}")]
    CoordinatorLost {
        /// Who.
        address: String,
        /// How long it was tried.
        waited: Duration,
        /// Why the last try failed.
        reason: String,
    },
    /// No device of the farm can take the jobs, and none came within the patience.
    #[error("task `{task}` has waited {waited:.1?} for a device: {}", describe_wait(*reason))]
    NoFittingDevice {
        /// The task.
        task: String,
        /// What is missing.
        reason: WaitReason,
        /// How long it waited.
        waited: Duration,
    },
    /// Jobs were planned on nodes, and within the patience none of them let us in: a firewall between, say, or addresses that
    /// only other machines know.
    #[error("no node of the farm could be reached for {waited:.1?}; the last one tried: {reason}")]
    NoNodeReached {
        /// How long it was tried.
        waited: Duration,
        /// Which node, and why not.
        reason: String,
    },
    /// The graph cannot be run.
    #[error(transparent)]
    Graph(#[from] GraphError),
    /// The run's journal cannot be read, or not be added to: what the disk had no room for, say, is retrieved, but will be computed
    /// again by a process that resumes.
    #[error(transparent)]
    Journal(#[from] JournalError),
    /// A task's `prepare` or `finish` failed.
    #[error("task `{task}`, {stage}: {error}")]
    Task {
        /// The task.
        task: String,
        /// `prepare` or `finish`.
        stage: &'static str,
        /// The application's reason.
        #[source]
        error: TaskError,
    },
    /// A job's `dispatch` failed.
    #[error("task `{task}`, {job}, dispatch: {error}")]
    Dispatch {
        /// The task.
        task: String,
        /// The job.
        job: JobIndex,
        /// The verb or the application's reason.
        #[source]
        error: DispatchError,
    },
    /// A job's program is not valid.
    #[error("task `{task}`, {job}: {error}")]
    Program {
        /// The task.
        task: String,
        /// The job.
        job: JobIndex,
        /// The command at fault.
        #[source]
        error: ProgramError,
    },
    /// A job's program is valid but cannot be sent.
    #[error("task `{task}`, {job}: {reason}")]
    Encode {
        /// The task.
        task: String,
        /// The job.
        job: JobIndex,
        /// Why.
        reason: String,
    },
    /// A job's program names a content that no task of the run has added.
    #[error("task `{task}`, {job}: content {} ({} B) was added by no task of this run", content.hash, content.size_bytes)]
    UnknownContent {
        /// The task.
        task: String,
        /// The job.
        job: JobIndex,
        /// What its program names.
        content: Content,
    },
    /// A job ended without a result.
    #[error("task `{task}`, {job} failed: {}", describe_failure(failure))]
    JobFailed {
        /// The task.
        task: String,
        /// The job.
        job: JobIndex,
        /// Why.
        failure: JobFailure,
    },
    /// A job's `retrieve` failed.
    #[error("task `{task}`, {job}, retrieve: {error}")]
    Retrieve {
        /// The task.
        task: String,
        /// The job.
        job: JobIndex,
        /// Why.
        #[source]
        error: RetrieveError,
    },
    /// A method of the application panicked.
    #[error("task `{task}` panicked in {stage}: {message}")]
    Panicked {
        /// The task.
        task: String,
        /// Which method.
        stage: &'static str,
        /// The panic's text.
        message: String,
    },
    /// The system gave no thread for a run.
    #[error("no thread for the run: {0}")]
    Thread(#[source] std::io::Error),
    /// The run was ended by its stop handle.
    #[error("stopped after {jobs_done} of {jobs_known} jobs")]
    Stopped {
        /// Jobs retrieved.
        jobs_done: u64,
        /// Jobs made by then.
        jobs_known: u64,
    },
    /// The farm was closed, or its owner task is gone.
    #[error("the connection to the farm is closed")]
    Closed,
}

impl FarmError {
    /// Whether the same call may succeed later without a change in the application.
    #[must_use]
    pub const fn can_be_retried(&self) -> bool {
        match self {
            Self::Unreachable { .. }
            | Self::CoordinatorLost { .. }
            | Self::NoFittingDevice { .. }
            | Self::NoNodeReached { .. } => true,
            Self::JobFailed { failure, .. } => failure.can_be_retried(),
            Self::Options { .. }
            | Self::Refused { .. }
            | Self::Denied { .. }
            | Self::Graph(_)
            | Self::Journal(_)
            | Self::Task { .. }
            | Self::Dispatch { .. }
            | Self::Program { .. }
            | Self::Encode { .. }
            | Self::UnknownContent { .. }
            | Self::Retrieve { .. }
            | Self::Panicked { .. }
            | Self::Thread(_)
            | Self::Stopped { .. }
            | Self::Closed => false,
        }
    }
}

/// A wait in words.
pub(crate) const fn describe_wait(reason: WaitReason) -> &'static str {
    match reason {
        WaitReason::NoNode => "no node is registered at the coordinator",
        WaitReason::NoFittingDevice => "no device of the farm fulfils the job's requirements",
        WaitReason::OverQuota => "the application's project has as much of the farm as it may have",
    }
}

fn describe_failure(failure: &JobFailure) -> String {
    match failure {
        JobFailure::InvalidProgram(reason) => format!("the program is not valid: {reason}"),
        JobFailure::Timeout => "a launch ran past its time limit".to_owned(),
        JobFailure::DeviceLost(reason) => format!("the device was lost: {reason}"),
        JobFailure::OutOfMemory(reason) => format!("the device had no memory for it: {reason}"),
        JobFailure::ContentUnavailable(hash) => format!("content {hash} could not be fetched"),
        JobFailure::Poison(reason) => format!("too many attempts ended with their device or node: {reason}"),
        JobFailure::PoisonApplication(reason) => format!("the farm stopped its application: {reason}"),
        JobFailure::OverQuota(reason) => format!("it needs more than its project may have: {reason}"),
        JobFailure::Returned => "its node gave it back".to_owned(),
        JobFailure::Cancelled => "it was cancelled".to_owned(),
    }
}
