//! How a command ends badly: exit codes 1 work failed, 2 usage, 3 unreachable, 4 denied (70-users.md).

use std::process::ExitCode;

use client_sdk::FarmError;

use crate::journal;

/// Why a command failed, as its exit code sees it.
#[derive(Debug)]
pub(crate) enum Failure {
    /// The work failed or is incomplete.
    Work(anyhow::Error),
    /// The command was called wrongly.
    Usage(anyhow::Error),
    /// The coordinator cannot be reached.
    Unreachable(anyhow::Error),
    /// The farm does not let us, or is not ours.
    Denied(anyhow::Error),
}

impl Failure {
    /// The process's exit code.
    pub(crate) fn exit_code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Work(_) => 1,
            Self::Usage(_) => 2,
            Self::Unreachable(_) => 3,
            Self::Denied(_) => 4,
        })
    }

    /// The causes in one line, for stderr; one whose words are in the one before already is not repeated.
    pub(crate) fn describe(&self) -> String {
        let (Self::Work(error) | Self::Usage(error) | Self::Unreachable(error) | Self::Denied(error)) = self;
        let mut text = String::new();
        for cause in error.chain().map(ToString::to_string) {
            if text.is_empty() {
                text = cause;
            } else if !text.contains(&cause) {
                text = format!("{text}: {cause}");
            }
        }
        text
    }
}

/// A run that failed, by its cause.
impl Failure {
    pub(crate) fn of_run(error: FarmError) -> Self {
        match error {
            FarmError::Unreachable { .. }
            | FarmError::CoordinatorLost { .. }
            | FarmError::NoNodeReached { .. } => Self::Unreachable(error.into()),
            FarmError::Denied { .. } => Self::Denied(error.into()),
            FarmError::Journal(error) => journal::failure(error),
            error => Self::Work(error.into()),
        }
    }
}

impl<E: Into<anyhow::Error>> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Work(error.into())
    }
}
