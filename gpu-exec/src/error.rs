//! Why a device cannot be opened, and why an order is not taken.

use farm_core::id::JobAttempt;
use thiserror::Error;

use crate::spec::DeviceSpec;

/// A device cannot be opened.
#[derive(Debug, Error)]
pub enum OpenError {
    /// The machine has no Vulkan implementation at all.
    #[error(
        "no Vulkan adapter found for `--device {spec}`: install a GPU driver, or on Debian the software one with \
         `apt-get install mesa-vulkan-drivers libvulkan1`"
    )]
    NoAdapter {
        /// What was asked for.
        spec: DeviceSpec,
    },
    /// There are adapters, but not the one asked for.
    #[error("`--device {spec}` is not there; found: {found}")]
    NotFound {
        /// What was asked for.
        spec: DeviceSpec,
        /// The specs that would work, with their names.
        found: String,
    },
    /// The adapter is there, but gives no device.
    #[error("`--device {spec}` ({adapter}) cannot be opened: {reason}")]
    Device {
        /// What was asked for.
        spec: DeviceSpec,
        /// The adapter's name.
        adapter: String,
        /// The driver's words.
        reason: String,
    },
    /// The spec stands for several devices where one is needed.
    #[error("`--device {spec}` stands for several devices; expand() it first")]
    NotSingle {
        /// What was asked for.
        spec: DeviceSpec,
    },
    /// More devices were asked for than one node may have.
    #[error("{count} devices are more than the {most} one node may have")]
    TooMany {
        /// How many.
        count: usize,
        /// How many may be.
        most: usize,
    },
    /// The system gave no thread.
    #[error("no thread for `--device {spec}`: {source}")]
    Thread {
        /// What was asked for.
        spec: DeviceSpec,
        /// The system's words.
        source: std::io::Error,
    },
}

/// An executor holds as many jobs as it may, or its device is gone: the order was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum Busy {
    /// All places are taken. Try again after the next `Finished`.
    #[error("{job} not taken: the device holds three jobs")]
    Full {
        /// Which job was refused.
        job: JobAttempt,
    },
    /// The device was lost for good; do not try again.
    #[error("{job} not taken: the device is lost")]
    Lost {
        /// Which job was refused.
        job: JobAttempt,
    },
}
