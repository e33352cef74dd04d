//! The records of jobs on a node: those it holds, and the tombstones of those it held.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use crate::{
    id::{AppId, Attempt, ContentHash, DeviceIndex, JobAttempt, JobId},
    message::{CostNs, JobFailure, JobTrace, LatencyClass, Priority, ResultHeader},
    program::Content,
    time::Instant,
};

/// Most tombstones. A late duplicate older than this many ended jobs would be executed again; its result is then
/// dropped by the ledger, so this costs time at worst.
const MAX_TOMBSTONES: usize = 65_536;

/// Sizes of results count up to this, in bytes (1 TiB): the sum of a full spool stays far from overflow.
const MAX_RESULT_BYTES: u64 = 1 << 40;

/// A job that a node holds.
#[derive(Debug)]
pub(super) struct HeldJob {
    pub(super) attempt: Attempt,
    /// The device whose queue it is in or on which it is.
    pub(super) device: DeviceIndex,
    pub(super) class: LatencyClass,
    pub(super) priority: Priority,
    pub(super) cost: CostNs,
    /// Each once; empty after execution.
    pub(super) contents: Vec<Content>,
    pub(super) arrival: u64,
    pub(super) state: HeldState,
}

impl HeldJob {
    /// Bytes of its result, if that waits for acknowledgement.
    pub(super) const fn spooled_bytes(&self) -> u64 {
        match &self.state {
            HeldState::Executed(spooled) => spooled.size_bytes,
            HeldState::Fetching { .. } | HeldState::Queued | HeldState::HandedOver(_) => 0,
        }
    }

    /// Its place in a queue: class, priority, then first come, first served.
    pub(super) const fn rank(&self, job: JobId) -> Rank {
        Rank { class: Reverse(self.class), priority: Reverse(self.priority), arrival: self.arrival, job }
    }
}

/// Where a held job is: in exactly one of these.
#[derive(Debug)]
pub(super) enum HeldState {
    /// Waits for `missing` of its contents.
    Fetching {
        /// > 0.
        missing: usize,
    },
    /// In its device's queue.
    Queued,
    /// With its device's executor.
    HandedOver(Handed),
    /// Its result waits for acknowledgement.
    Executed(Spooled),
}

/// How a job came to its executor, and how it is there.
#[derive(Clone, Copy, Debug)]
pub(super) struct Handed {
    pub(super) staged_at: Instant,
    /// When it began to run for the first time.
    started_at: Option<Instant>,
    /// The sibling whose queue it was taken from.
    pub(super) stolen_from: Option<DeviceIndex>,
    pub(super) phase: Phase,
    /// How long it ran before its last interruption.
    ran_before: Duration,
}

/// What a job does at its executor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// Its inputs are brought up.
    Staged,
    /// It has the device.
    Running {
        /// Since then without interruption.
        since: Instant,
    },
    /// Another one has the device; its state stays there.
    Interrupted,
}

impl Handed {
    pub(super) const fn over(staged_at: Instant, stolen_from: Option<DeviceIndex>) -> Self {
        Self { staged_at, started_at: None, stolen_from, phase: Phase::Staged, ran_before: Duration::ZERO }
    }

    pub(super) fn run(&mut self, now: Instant) {
        self.pause(now);
        self.started_at.get_or_insert(now);
        self.phase = Phase::Running { since: now };
    }

    pub(super) fn pause(&mut self, now: Instant) {
        if let Phase::Running { since } = self.phase {
            self.ran_before = self.ran_before.saturating_add(now.since(since));
            self.phase = Phase::Interrupted;
        }
    }

    /// How long it has had the device, interruptions not counted.
    pub(super) fn ran(&self, now: Instant) -> Duration {
        match self.phase {
            Phase::Staged | Phase::Interrupted => self.ran_before,
            Phase::Running { since } => self.ran_before.saturating_add(now.since(since)),
        }
    }

    /// What is told of an attempt that ends now.
    pub(super) fn trace(self, now: Instant) -> JobTrace {
        JobTrace {
            staged_at: self.staged_at,
            started_at: self.started_at.unwrap_or(now),
            ended_at: now,
            stolen_from: self.stolen_from,
        }
    }
}

/// A result that waits for acknowledgement.
#[derive(Debug)]
pub(super) struct Spooled {
    pub(super) header: ResultHeader,
    pub(super) size_bytes: u64,
    /// How often it was acknowledged with a wrong digest.
    pub(super) mismatches: u32,
}

impl Spooled {
    /// A result of sections of these lengths.
    pub(super) fn completed(
        job: JobAttempt,
        device: DeviceIndex,
        device_time_ns: u64,
        sections: Vec<u64>,
        digest: ContentHash,
    ) -> Self {
        let size_bytes =
            sections.iter().fold(0, |sum: u64, part| sum.saturating_add(*part)).min(MAX_RESULT_BYTES);
        let header = ResultHeader { job, device, device_time_ns, outcome: Ok(sections), digest };
        Self { header, size_bytes, mismatches: 0 }
    }

    /// A failure that no further attempt would mend.
    pub(super) const fn failed(
        job: JobAttempt,
        device: DeviceIndex,
        device_time_ns: u64,
        failure: JobFailure,
    ) -> Self {
        let digest = ContentHash::EMPTY;
        let header = ResultHeader { job, device, device_time_ns, outcome: Err(failure), digest };
        Self { header, size_bytes: 0, mismatches: 0 }
    }
}

/// Order of a queue: the least is the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Rank {
    pub(super) class: Reverse<LatencyClass>,
    pub(super) priority: Reverse<Priority>,
    pub(super) arrival: u64,
    pub(super) job: JobId,
}

/// The largest attempt that ended here, for each of the last jobs.
#[derive(Debug, Default)]
pub(super) struct Tombstones {
    attempts: BTreeMap<JobId, Attempt>,
    oldest_first: VecDeque<JobId>,
}

impl Tombstones {
    pub(super) fn insert(&mut self, job: JobId, attempt: Attempt) {
        match self.attempts.insert(job, attempt) {
            Some(before) if before > attempt => {
                self.attempts.insert(job, before);
            }
            Some(_) => {}
            None => self.oldest_first.push_back(job),
        }
        if self.oldest_first.len() > MAX_TOMBSTONES
            && let Some(oldest) = self.oldest_first.pop_front()
        {
            self.attempts.remove(&oldest);
        }
    }

    /// Whether this or a later attempt ended here.
    pub(super) fn cover(&self, job: JobId, attempt: Attempt) -> bool {
        self.attempts.get(&job).is_some_and(|ended| *ended >= attempt)
    }

    /// Ids of an application are never reused: its tombstones are of no use once it left.
    pub(super) fn forget_app(&mut self, app: AppId) {
        let gone: Vec<JobId> = self.attempts.range(JobId::range_of(app)).map(|(&job, _)| job).collect();
        if gone.is_empty() {
            return;
        }
        for job in gone {
            self.attempts.remove(&job);
        }
        self.oldest_first.retain(|job| job.app != app);
    }

    pub(super) fn check_invariants(&self) {
        assert_eq!(self.attempts.len(), self.oldest_first.len(), "I8: tombstones and their order differ");
        assert!(self.attempts.len() <= MAX_TOMBSTONES, "I8: more than {MAX_TOMBSTONES} tombstones");
    }
}
