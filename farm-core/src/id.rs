//! Identities that cross process boundaries. Each is a newtype with `Display`; a raw integer never crosses a
//! function boundary.

use std::{borrow::Cow, fmt, str::FromStr};

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use thiserror::Error;

/// Of a text that is no id, shown in the error.
const SHOWN_CHARACTERS: usize = 64;

/// A text is not an id as it is shown.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("{text:?} is no id")]
pub struct NoId {
    /// Its first characters.
    pub text: String,
}

macro_rules! id {
    ($(#[$doc:meta])* $name:ident($raw:ty), $prefix:literal) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub struct $name(pub $raw);

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, concat!($prefix, "{}"), self.0)
            }
        }
    };
}

/// An id that a coordinator issues: its epoch less one in the upper half, a running number in the lower. Shown as
/// `epoch.number`, in the first epoch as the number alone. What people read (JSON) has it as it is shown: as a number it can be over
/// 2^53, where JavaScript and jq round.
macro_rules! issued_id {
    ($(#[$doc:meta])* $name:ident, $prefix:literal) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name(pub u64);

        impl $name {
            /// The running number alone: that of another epoch may be the same.
            #[must_use]
            #[expect(clippy::cast_possible_truncation, reason = "the lower half")]
            pub const fn number(self) -> u32 {
                self.0 as u32
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self.0 >> 32 {
                    0 => write!(f, concat!($prefix, "{}"), self.number()),
                    before => write!(f, concat!($prefix, "{}.{}"), before + 1, self.number()),
                }
            }
        }

        impl FromStr for $name {
            type Err = NoId;

            fn from_str(text: &str) -> Result<Self, NoId> {
                let issued = text.strip_prefix($prefix).and_then(|rest| match rest.split_once('.') {
                    None => rest.parse::<u32>().ok().map(u64::from),
                    Some((epoch, number)) => {
                        let before = u32::try_from(epoch.parse::<u64>().ok()?.checked_sub(1)?).ok()?;
                        Some(u64::from(before) << 32 | u64::from(number.parse::<u32>().ok()?))
                    }
                });
                // Another spelling is none of ours.
                let issued = issued.map(Self).filter(|id| id.to_string() == text);
                issued.ok_or_else(|| NoId { text: text.chars().take(SHOWN_CHARACTERS).collect() })
            }
        }

        impl Serialize for $name {
            fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                match serializer.is_human_readable() {
                    true => serializer.collect_str(self),
                    false => self.0.serialize(serializer),
                }
            }
        }

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                if deserializer.is_human_readable() {
                    let text = Cow::<'de, str>::deserialize(deserializer)?;
                    return text.parse().map_err(de::Error::custom);
                }
                u64::deserialize(deserializer).map(Self)
            }
        }
    };
}

id!(
    /// One life of the coordinator: +1 at each start. Messages of a smaller epoch are refused.
    Epoch(u32), "epoch-"
);
issued_id!(
    /// A worker node, named by the coordinator at registration.
    NodeId, "node-"
);
id!(
    /// One life of a worker process; drawn by the worker's driver at its start.
    NodeSession(u64), "session-"
);
issued_id!(
    /// A registered application, cluster-wide unique, never reused (thesis 5.4.1).
    AppId, "app-"
);
id!(
    /// One life of an application that keeps its [`AppId`] over restarts.
    AppIncarnation(u32), "incarnation-"
);
id!(
    /// A task, unique inside its application.
    TaskId(u32), "task-"
);
id!(
    /// A job's index inside its task.
    JobIndex(u32), "job-"
);
id!(
    /// A device's index inside its node.
    DeviceIndex(u16), "device-"
);
id!(
    /// One plan request of an application.
    BatchId(u64), "batch-"
);
id!(
    /// One try of the coordinator to move queued jobs from a node to another; never reused inside one epoch.
    StealId(u64), "steal-"
);
id!(
    /// A driver's handle of one connection; means nothing outside the process that drew it.
    LinkId(u64), "link-"
);

/// A job, cluster-wide: application, task, index.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct JobId {
    /// The application that owns the job.
    pub app: AppId,
    /// The task inside the application.
    pub task: TaskId,
    /// The job inside the task.
    pub index: JobIndex,
}

impl fmt::Display for JobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/{}", self.app.0, self.task.0, self.index.0)
    }
}

/// A job inside its application.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct JobKey {
    pub(crate) task: TaskId,
    pub(crate) index: JobIndex,
}

impl JobKey {
    pub(crate) const fn of(job: JobId) -> Self {
        Self { task: job.task, index: job.index }
    }

    pub(crate) const fn in_app(self, app: AppId) -> JobId {
        JobId { app, task: self.task, index: self.index }
    }

    /// First and last key that a job of `task` can have.
    pub(crate) const fn range_of(task: TaskId) -> std::ops::RangeInclusive<Self> {
        Self { task, index: JobIndex(0) }..=Self { task, index: JobIndex(u32::MAX) }
    }
}

impl fmt::Display for JobKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.task.0, self.index.0)
    }
}

impl JobId {
    /// First and last id that a job of `app` can have.
    pub(crate) const fn range_of(app: AppId) -> std::ops::RangeInclusive<Self> {
        Self { app, task: TaskId(0), index: JobIndex(0) }..=Self {
            app,
            task: TaskId(u32::MAX),
            index: JobIndex(u32::MAX),
        }
    }
}

/// One try at executing a job. Compared lexicographically, so a coordinator that lost its job state still issues
/// larger attempts than any before it: fencing without per-job durability.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Attempt {
    /// The coordinator's epoch that issued the attempt.
    pub epoch: Epoch,
    /// Issued in increasing order inside one epoch.
    pub sequence: u64,
}

impl fmt::Display for Attempt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.epoch.0, self.sequence)
    }
}

/// A job together with the attempt at it: what queues, executors and results are keyed by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct JobAttempt {
    /// The job.
    pub job: JobId,
    /// The attempt at it.
    pub attempt: Attempt,
}

impl fmt::Display for JobAttempt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.job, self.attempt)
    }
}

/// The blake3 digest of some bytes: the name of a task allocation, a module or a result payload. Computed by drivers.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ContentHash(pub [u8; 32]);

impl ContentHash {
    /// blake3 of no bytes: the digest of a failed attempt's payload.
    pub const EMPTY: Self = Self([
        0xaf, 0x13, 0x49, 0xb9, 0xf5, 0xf9, 0xa1, 0xa6, 0xa0, 0x40, 0x4d, 0xea, 0x36, 0xdc, 0xc9, 0x49, 0x9b,
        0xcb, 0x25, 0xc9, 0xad, 0xc1, 0x12, 0xb7, 0xcc, 0x9a, 0x93, 0xca, 0xe4, 0x1f, 0x32, 0x62,
    ]);
}

impl fmt::Display for ContentHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for ContentHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Eight hex digits tell contents apart in a log line.
        self.0[..4].iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn issued_ids_are_read_as_they_are_shown() {
        for (id, shown) in
            [(0, "app-0"), (7, "app-7"), (1 << 32 | 7, "app-2.7"), (u64::MAX, "app-4294967296.4294967295")]
        {
            let id = AppId(id);
            assert_eq!(id.to_string(), shown);
            assert_eq!(shown.parse(), Ok(id));
        }
        for text in [
            "",
            "app-",
            "7",
            "node-7",
            "app-1.7",
            "app-0.7",
            "app-07",
            "app-4294967296",
            "app-2.7.1",
            "app- 7",
        ] {
            assert_eq!(text.parse::<AppId>(), Err(NoId { text: text.to_owned() }), "{text}");
        }
    }
}
