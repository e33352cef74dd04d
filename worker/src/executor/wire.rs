//! What a worker and its executor processes say to each other, over a socket pair: a length (`u32`, little-endian), a JSON
//! header of that many bytes, then the payload whose size the header says.
//!
//! Both ends are the same binary at the same moment: there is nothing to negotiate.

use std::time::Duration;

use bytes::Bytes;
use farm_core::{
    device::DeviceInfo,
    id::{ContentHash, JobAttempt},
    message::{JobFailure, LatencyClass},
    program::ProgramQuota,
};
use proto::{codec::MAX_PROGRAM_BYTES, trust::Scope};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

/// Bytes of the length field.
pub(super) const LENGTH_BYTES: usize = 4;
/// Longest header, in bytes: a failure's text, or the sections of a result.
const MAX_HEADER_BYTES: usize = 1 << 20;
/// Most bytes of one content; the largest storage buffer of any device is below it.
const MAX_CONTENT_BYTES: u64 = 64 << 30;

/// A message without its payload.
pub(super) trait Header: Serialize + DeserializeOwned {
    /// Bytes that follow the header; an error if a sane peer would not send so many.
    fn payload_bytes(&self) -> Result<usize, String>;
}

/// Worker to executor.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum ToExecutor {
    /// Run this job; the payload is its encoded program.
    Execute { job: JobAttempt, class: LatencyClass, limit: Duration, scope: Scope, program_bytes: u64 },
    /// Take it back.
    Abort(JobAttempt),
    /// The answer to [`FromExecutor::Wants`]; the payload is the content, `None` if it is not here.
    Content { hash: ContentHash, size_bytes: Option<u64> },
}

/// Executor to worker.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum FromExecutor {
    /// First message: the device is open.
    Opened(DeviceInfo),
    /// First and last message: it is not, for this reason.
    Refused(String),
    /// The job's modules are about to be compiled and its bytes uploaded.
    Preparing(JobAttempt),
    /// They are.
    Prepared(JobAttempt),
    /// As `gpu_exec::ExecutorEvent::Started`.
    Started(JobAttempt),
    /// As `gpu_exec::ExecutorEvent::Yielded`.
    Yielded(JobAttempt),
    /// As `gpu_exec::ExecutorEvent::Resumed`.
    Resumed(JobAttempt),
    /// The job left the device, and its result is large: it follows in parts, and other words between them.
    Ended(JobAttempt),
    /// The payload is the next so many bytes of that result, which has `of` in all.
    Part { bytes: u64, of: u64 },
    /// The job ended; the payload is its result, one section after the other, unless it came in parts before.
    Finished { job: JobAttempt, device_time_ns: u64, outcome: Result<Output, JobFailure> },
    /// The device needs a content.
    Wants(ContentHash),
    /// The device does not answer any more: end this process.
    Lost(String),
}

/// What follows as the payload.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Output {
    /// Lengths of the sections, in bytes.
    pub(super) sections: Vec<u64>,
    /// They have come in parts before.
    pub(super) in_parts: bool,
    /// Over all of them.
    pub(super) digest: ContentHash,
}

impl Header for ToExecutor {
    fn payload_bytes(&self) -> Result<usize, String> {
        match self {
            Self::Execute { program_bytes, .. } => bounded(*program_bytes, MAX_PROGRAM_BYTES as u64),
            Self::Abort(_) => Ok(0),
            Self::Content { size_bytes, .. } => bounded(size_bytes.unwrap_or_default(), MAX_CONTENT_BYTES),
        }
    }
}

impl Header for FromExecutor {
    fn payload_bytes(&self) -> Result<usize, String> {
        match self {
            Self::Finished { outcome: Ok(output), .. } if !output.in_parts => output.bytes(),
            Self::Part { bytes, of } => {
                bounded(*of, ProgramQuota::default().result_bytes).and_then(|of| bounded(*bytes, of as u64))
            }
            Self::Opened(_)
            | Self::Refused(_)
            | Self::Preparing(_)
            | Self::Prepared(_)
            | Self::Started(_)
            | Self::Yielded(_)
            | Self::Resumed(_)
            | Self::Ended(_)
            | Self::Finished { .. }
            | Self::Wants(_)
            | Self::Lost(_) => Ok(0),
        }
    }
}

impl Output {
    /// Bytes of all sections.
    pub(super) fn bytes(&self) -> Result<usize, String> {
        let bytes = self.sections.iter().fold(0, |sum: u64, section| sum.saturating_add(*section));
        bounded(bytes, ProgramQuota::default().result_bytes)
    }

    /// The sections as slices of the payload.
    pub(super) fn cut(&self, mut payload: Bytes) -> Vec<Bytes> {
        let length = |section: &u64| {
            usize::try_from(*section).expect("payload_bytes has seen that all of them fit the address space")
        };
        self.sections.iter().map(|section| payload.split_to(length(section))).collect()
    }
}

/// A header with its length before it.
pub(super) fn encode(header: &impl Header) -> Vec<u8> {
    let mut bytes = vec![0; LENGTH_BYTES];
    serde_json::to_writer(&mut bytes, header).expect("plain data goes into memory without an error");
    let length = u32::try_from(bytes.len() - LENGTH_BYTES).expect("a header is far below 4 GiB");
    bytes[..LENGTH_BYTES].copy_from_slice(&length.to_le_bytes());
    bytes
}

/// The header's length.
pub(super) fn header_bytes(length: [u8; LENGTH_BYTES]) -> Result<usize, String> {
    bounded(u32::from_le_bytes(length).into(), MAX_HEADER_BYTES as u64)
}

/// A whole header.
pub(super) fn decode<H: Header>(bytes: &[u8]) -> Result<H, String> {
    serde_json::from_slice(bytes).map_err(|error| format!("a header does not decode: {error}"))
}

fn bounded(bytes: u64, most: u64) -> Result<usize, String> {
    usize::try_from(bytes)
        .ok()
        .filter(|_| bytes <= most)
        .ok_or_else(|| format!("{bytes} B announced where at most {most} come"))
}
