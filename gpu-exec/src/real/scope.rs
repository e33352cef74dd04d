//! What the driver answers to a group of calls, as a value.

use farm_core::message::JobFailure;

use super::adapter::Gpu;

/// The device refused a group of calls.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    /// No memory for it.
    OutOfMemory(String),
    /// The calls are wrong: the program is.
    Invalid(String),
}

impl Refusal {
    /// As the job's end, with what was being done in front.
    pub(crate) fn into_failure(self, doing: &str) -> JobFailure {
        match self {
            Self::OutOfMemory(text) => JobFailure::OutOfMemory(format!("{doing}: {text}")),
            Self::Invalid(text) => JobFailure::InvalidProgram(format!("{doing}: {text}")),
        }
    }
}

impl Gpu {
    /// Runs `calls` and gives their first error, if any.
    pub(crate) fn scoped<T>(&self, calls: impl FnOnce() -> T) -> Result<T, Refusal> {
        let memory = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let internal = self.device.push_error_scope(wgpu::ErrorFilter::Internal);
        let validation = self.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let value = calls();
        // The futures of the native backend are ready at once.
        let validation = pollster::block_on(validation.pop());
        let internal = pollster::block_on(internal.pop());
        let memory = pollster::block_on(memory.pop());
        if let Some(error) = memory {
            Err(Refusal::OutOfMemory(error.to_string()))
        } else if let Some(error) = validation.or(internal) {
            Err(Refusal::Invalid(error.to_string()))
        } else {
            Ok(value)
        }
    }
}
