//! What the services share.

use farm_core::{
    device::{DeviceInfo, DeviceKind, Features, Limits, Requirements, SimulatedDevices},
    id::{AppId, ContentHash, JobId, JobIndex, TaskId},
    message::{CacheFigures, Contact, JobFailure, Liveness},
    program::Content,
};

use super::{
    MAX_ADDRESSES, MAX_CERTIFICATE_BYTES, WireError, cut, enumeration, invalid, name, required, score, text,
    within,
};
use crate::control::v1;

impl From<DeviceKind> for v1::DeviceKind {
    fn from(kind: DeviceKind) -> Self {
        match kind {
            DeviceKind::Gpu => Self::Gpu,
            DeviceKind::Cpu => Self::Cpu,
            DeviceKind::Simulated => Self::Simulated,
        }
    }
}

pub(super) fn device_kind(field: &'static str, kind: i32) -> Result<DeviceKind, WireError> {
    match enumeration(field, kind)? {
        v1::DeviceKind::Unspecified => Err(WireError::Missing { field }),
        v1::DeviceKind::Gpu => Ok(DeviceKind::Gpu),
        v1::DeviceKind::Cpu => Ok(DeviceKind::Cpu),
        v1::DeviceKind::Simulated => Ok(DeviceKind::Simulated),
    }
}

impl From<Limits> for v1::Limits {
    fn from(limits: Limits) -> Self {
        Self {
            memory_bytes: limits.memory_bytes,
            buffer_bytes: limits.buffer_bytes,
            binding_bytes: limits.binding_bytes,
            storage_buffers: limits.storage_buffers,
            workgroup_memory_bytes: limits.workgroup_memory_bytes,
            workgroup_invocations: limits.workgroup_invocations,
        }
    }
}

impl From<v1::Limits> for Limits {
    fn from(wire: v1::Limits) -> Self {
        Self {
            memory_bytes: wire.memory_bytes,
            buffer_bytes: wire.buffer_bytes,
            binding_bytes: wire.binding_bytes,
            storage_buffers: wire.storage_buffers,
            workgroup_memory_bytes: wire.workgroup_memory_bytes,
            workgroup_invocations: wire.workgroup_invocations,
        }
    }
}

impl From<DeviceInfo> for v1::DeviceInfo {
    fn from(device: DeviceInfo) -> Self {
        Self {
            name: device.name,
            kind: v1::DeviceKind::from(device.kind).into(),
            score: device.score,
            features: device.features.0,
            limits: Some(device.limits.into()),
        }
    }
}

impl TryFrom<v1::DeviceInfo> for DeviceInfo {
    type Error = WireError;

    fn try_from(wire: v1::DeviceInfo) -> Result<Self, WireError> {
        Ok(Self {
            name: name("DeviceInfo.name", wire.name)?,
            kind: device_kind("DeviceInfo.kind", wire.kind)?,
            score: score("DeviceInfo.score", wire.score)?,
            features: Features(wire.features),
            limits: required("DeviceInfo.limits", wire.limits)?.into(),
        })
    }
}

impl From<Requirements> for v1::Requirements {
    fn from(needs: Requirements) -> Self {
        Self {
            features: needs.features.0,
            limits: Some(needs.limits.into()),
            simulated_accepted: needs.simulated == SimulatedDevices::Accepted,
        }
    }
}

impl TryFrom<v1::Requirements> for Requirements {
    type Error = WireError;

    fn try_from(wire: v1::Requirements) -> Result<Self, WireError> {
        Ok(Self {
            features: Features(wire.features),
            limits: required("Requirements.limits", wire.limits)?.into(),
            simulated: match wire.simulated_accepted {
                true => SimulatedDevices::Accepted,
                false => SimulatedDevices::Refused,
            },
        })
    }
}

impl From<Contact> for v1::Contact {
    fn from(contact: Contact) -> Self {
        Self { addresses: contact.addresses, certificate_der: contact.certificate_der }
    }
}

impl TryFrom<v1::Contact> for Contact {
    type Error = WireError;

    fn try_from(wire: v1::Contact) -> Result<Self, WireError> {
        within("Contact.certificate_der", wire.certificate_der.len(), MAX_CERTIFICATE_BYTES)?;
        let addresses = addresses("Contact.addresses", wire.addresses)?;
        Ok(Self { addresses, certificate_der: wire.certificate_der })
    }
}

pub(super) fn addresses(field: &'static str, wire: Vec<String>) -> Result<Vec<String>, WireError> {
    within(field, wire.len(), MAX_ADDRESSES)?;
    wire.into_iter().map(|address| name(field, address)).collect()
}

impl From<Liveness> for v1::Liveness {
    fn from(liveness: Liveness) -> Self {
        Self {
            heartbeat_ms: liveness.heartbeat_ms,
            suspect_ms: liveness.suspect_ms,
            dead_ms: liveness.dead_ms,
            reconnect_ms: liveness.reconnect_ms,
            compare_ms: liveness.compare_ms,
        }
    }
}

impl From<v1::Liveness> for Liveness {
    fn from(wire: v1::Liveness) -> Self {
        Self {
            heartbeat_ms: wire.heartbeat_ms,
            suspect_ms: wire.suspect_ms,
            dead_ms: wire.dead_ms,
            reconnect_ms: wire.reconnect_ms,
            compare_ms: wire.compare_ms,
        }
    }
}

pub(super) fn content_hash(field: &'static str, bytes: &[u8]) -> Result<ContentHash, WireError> {
    bytes.try_into().map(ContentHash).map_err(|_| invalid(field, format!("a digest of {} B", bytes.len())))
}

impl From<Content> for v1::Content {
    fn from(content: Content) -> Self {
        Self { hash: content.hash.0.to_vec(), size_bytes: content.size_bytes }
    }
}

impl TryFrom<v1::Content> for Content {
    type Error = WireError;

    fn try_from(wire: v1::Content) -> Result<Self, WireError> {
        Ok(Self { hash: content_hash("Content.hash", &wire.hash)?, size_bytes: wire.size_bytes })
    }
}

impl From<JobId> for v1::JobId {
    fn from(job: JobId) -> Self {
        Self { app: job.app.0, task: job.task.0, index: job.index.0 }
    }
}

impl From<v1::JobId> for JobId {
    fn from(wire: v1::JobId) -> Self {
        Self { app: AppId(wire.app), task: TaskId(wire.task), index: JobIndex(wire.index) }
    }
}

impl From<JobFailure> for v1::JobFailure {
    fn from(failure: JobFailure) -> Self {
        use v1::job_failure::Cause;
        let cause = match failure {
            JobFailure::InvalidProgram(reason) => Cause::InvalidProgram(cut(reason)),
            JobFailure::Timeout => Cause::Timeout(v1::Nothing {}),
            JobFailure::DeviceLost(reason) => Cause::DeviceLost(cut(reason)),
            JobFailure::OutOfMemory(reason) => Cause::OutOfMemory(cut(reason)),
            JobFailure::ContentUnavailable(hash) => Cause::ContentUnavailable(hash.0.to_vec()),
            JobFailure::Poison(reason) => Cause::Poison(cut(reason)),
            JobFailure::PoisonApplication(reason) => Cause::PoisonApplication(cut(reason)),
            JobFailure::OverQuota(reason) => Cause::OverQuota(cut(reason)),
            JobFailure::Cancelled => Cause::Cancelled(v1::Nothing {}),
            JobFailure::Returned => Cause::Returned(v1::Nothing {}),
        };
        Self { cause: Some(cause) }
    }
}

impl TryFrom<v1::JobFailure> for JobFailure {
    type Error = WireError;

    fn try_from(wire: v1::JobFailure) -> Result<Self, WireError> {
        use v1::job_failure::Cause;
        Ok(match required("JobFailure.cause", wire.cause)? {
            Cause::InvalidProgram(reason) => {
                Self::InvalidProgram(text("JobFailure.invalid_program", reason)?)
            }
            Cause::Timeout(v1::Nothing {}) => Self::Timeout,
            Cause::DeviceLost(reason) => Self::DeviceLost(text("JobFailure.device_lost", reason)?),
            Cause::OutOfMemory(reason) => Self::OutOfMemory(text("JobFailure.out_of_memory", reason)?),
            Cause::ContentUnavailable(hash) => {
                Self::ContentUnavailable(content_hash("JobFailure.content_unavailable", &hash)?)
            }
            Cause::Poison(reason) => Self::Poison(text("JobFailure.poison", reason)?),
            Cause::PoisonApplication(reason) => {
                Self::PoisonApplication(text("JobFailure.poison_application", reason)?)
            }
            Cause::OverQuota(reason) => Self::OverQuota(text("JobFailure.over_quota", reason)?),
            Cause::Cancelled(v1::Nothing {}) => Self::Cancelled,
            Cause::Returned(v1::Nothing {}) => Self::Returned,
        })
    }
}

impl From<CacheFigures> for v1::CacheFigures {
    fn from(figures: CacheFigures) -> Self {
        Self {
            memory_contents: figures.memory_contents,
            memory_bytes: figures.memory_bytes,
            disk_contents: figures.disk_contents,
            disk_bytes: figures.disk_bytes,
            memory_hits: figures.memory_hits,
            disk_hits: figures.disk_hits,
            fetches: figures.fetches,
            fetched_bytes: figures.fetched_bytes,
            memory_evictions: figures.memory_evictions,
            disk_evictions: figures.disk_evictions,
        }
    }
}

impl From<v1::CacheFigures> for CacheFigures {
    fn from(wire: v1::CacheFigures) -> Self {
        Self {
            memory_contents: wire.memory_contents,
            memory_bytes: wire.memory_bytes,
            disk_contents: wire.disk_contents,
            disk_bytes: wire.disk_bytes,
            memory_hits: wire.memory_hits,
            disk_hits: wire.disk_hits,
            fetches: wire.fetches,
            fetched_bytes: wire.fetched_bytes,
            memory_evictions: wire.memory_evictions,
            disk_evictions: wire.disk_evictions,
        }
    }
}
