//! `farmctl version`.

use farm_core::message::PROTOCOL_VERSION;
use serde::Serialize;

use crate::{cli::Format, failure::Failure, output};

/// What this binary is.
#[derive(Debug, Serialize)]
struct Version {
    version: &'static str,
    protocol: u32,
}

/// Prints the versions.
pub(crate) fn run(format: Format) -> Result<(), Failure> {
    let version = Version { version: env!("CARGO_PKG_VERSION"), protocol: PROTOCOL_VERSION };
    output::print(&version, format, |version, _| {
        format!("gleaner {} (protocol {})\n", version.version, version.protocol)
    })
}
