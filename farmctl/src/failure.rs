//! How a command ends badly: exit codes 1 work failed, 2 usage, 3 unreachable, 4 denied (70-users.md).

use std::process::ExitCode;

/// Why a command failed, as its exit code sees it.
#[derive(Debug)]
pub(crate) enum Failure {
    /// The work failed or is incomplete.
    Work(anyhow::Error),
    /// The command was called wrongly.
    Usage(anyhow::Error),
    /// The coordinator cannot be reached.
    Unreachable(anyhow::Error),
}

impl Failure {
    /// The process's exit code.
    pub(crate) fn exit_code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Work(_) => 1,
            Self::Usage(_) => 2,
            Self::Unreachable(_) => 3,
        })
    }

    /// The cause, for stderr.
    pub(crate) const fn error(&self) -> &anyhow::Error {
        match self {
            Self::Work(error) | Self::Usage(error) | Self::Unreachable(error) => error,
        }
    }
}

impl<E: Into<anyhow::Error>> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Work(error.into())
    }
}
