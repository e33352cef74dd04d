//! What projects may have.

use farm_core::project::{Quota, QuotaChange};

use super::{WireError, invalid, name, weight};
use crate::control::v1;

impl From<Quota> for v1::Quota {
    fn from(quota: Quota) -> Self {
        let Quota { devices, queued_jobs, bytes, weight } = quota;
        Self { devices, queued_jobs, bytes, weight }
    }
}

impl TryFrom<v1::Quota> for Quota {
    type Error = WireError;

    fn try_from(wire: v1::Quota) -> Result<Self, WireError> {
        let v1::Quota { devices, queued_jobs, bytes, weight: most } = wire;
        let weight = most.map(|most| weight("Quota.weight", most)).transpose()?;
        Ok(Self { devices, queued_jobs, bytes, weight })
    }
}

/// A project's change, outwards.
pub(in crate::control) fn set_project_request(project: &str, change: QuotaChange) -> v1::SetProjectRequest {
    let bound = |most| v1::Bound { most };
    v1::SetProjectRequest {
        project: project.to_owned(),
        devices: change.devices.map(|most| bound(most.map(u64::from))),
        queued_jobs: change.queued_jobs.map(bound),
        bytes: change.bytes.map(bound),
        weight: change.weight.map(|most| v1::WeightBound { most }),
    }
}

/// A project's change, inwards.
///
/// # Errors
/// A bound is not one.
pub fn quota_change(wire: v1::SetProjectRequest) -> Result<(String, QuotaChange), WireError> {
    let devices = |most: u64| u32::try_from(most).map_err(|_| invalid("SetProjectRequest.devices", most));
    let most_weight = |most| weight("SetProjectRequest.weight", most);
    let change = QuotaChange {
        devices: wire.devices.map(|bound| bound.most.map(devices).transpose()).transpose()?,
        queued_jobs: wire.queued_jobs.map(|bound| bound.most),
        bytes: wire.bytes.map(|bound| bound.most),
        weight: wire.weight.map(|bound| bound.most.map(most_weight).transpose()).transpose()?,
    };
    Ok((name("SetProjectRequest.project", wire.project)?, change))
}
