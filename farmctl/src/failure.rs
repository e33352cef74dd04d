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

    /// The causes in one line, for stderr; one whose words are in the one before already is not repeated.
    pub(crate) fn describe(&self) -> String {
        let (Self::Work(error) | Self::Usage(error) | Self::Unreachable(error)) = self;
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

impl<E: Into<anyhow::Error>> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Work(error.into())
    }
}
