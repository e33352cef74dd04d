//! Projects: whose an application is, and what the applications of one may have together (20-delivery.md "Security").

use serde::{Deserialize, Serialize};

/// The project of those who were put into no other. It is always there.
pub const DEFAULT_PROJECT: &str = "default";

/// Most projects of a farm.
pub const MAX_PROJECTS: usize = 1_024;

/// What the applications of a project may have together; `None` is as much as there is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quota {
    /// Devices that jobs are on at a time, queued or running.
    pub devices: Option<u32>,
    /// Jobs that are planned at a time and not delivered; further ones wait at the coordinator. With zero nothing is planned.
    pub queued_jobs: Option<u64>,
    /// Bytes of task allocations and modules that batches with a place name, each content once for the farm; and bytes of
    /// results on each node that no application has acknowledged.
    pub bytes: Option<u64>,
    /// What fair-share weights come to; those of more are scaled down. Positive and finite.
    pub weight: Option<f64>,
}

impl Quota {
    /// Whether nothing is planned.
    #[must_use]
    pub fn is_suspension(&self) -> bool {
        self.devices == Some(0) || self.queued_jobs == Some(0)
    }
}

/// What an application may have of a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AppTerms {
    /// Fair-share weight; positive and finite.
    pub weight: f64,
    /// Its project's name.
    pub project: String,
    /// Bytes of results that the project's applications may leave unacknowledged before they get no further device.
    pub result_bytes: Option<u64>,
    /// Its jobs stay on the devices that they were planned for: the project may have so many and no more.
    pub stays: bool,
}

impl AppTerms {
    /// Of an application without a quota.
    #[must_use]
    pub fn unlimited(weight: f64) -> Self {
        Self { weight, project: DEFAULT_PROJECT.to_owned(), result_bytes: None, stays: false }
    }
}

/// A change of a [`Quota`]: what is `None` stays as it is, `Some(None)` lifts a bound.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct QuotaChange {
    /// Of [`Quota::devices`].
    pub devices: Option<Option<u32>>,
    /// Of [`Quota::queued_jobs`].
    pub queued_jobs: Option<Option<u64>>,
    /// Of [`Quota::bytes`].
    pub bytes: Option<Option<u64>>,
    /// Of [`Quota::weight`].
    pub weight: Option<Option<f64>>,
}

impl QuotaChange {
    /// What a quota is after it.
    #[must_use]
    pub fn apply(self, before: Quota) -> Quota {
        Quota {
            devices: self.devices.unwrap_or(before.devices),
            queued_jobs: self.queued_jobs.unwrap_or(before.queued_jobs),
            bytes: self.bytes.unwrap_or(before.bytes),
            weight: self.weight.unwrap_or(before.weight),
        }
    }
}
