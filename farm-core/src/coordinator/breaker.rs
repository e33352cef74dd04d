//! The circuit breaker of an application whose jobs crash whatever runs them (a poison application): it is stopped as a whole,
//! before each of its jobs has had its own three crashes.
//!
//! What counts is what executors report. The loss of a node counts against jobs that may have caused it (`replan`), never
//! against their application: whoever has long jobs on a node that is powered off would be suspected for each of them.

use std::{collections::BTreeMap, time::Duration};

use super::{CoordinatorMachine, model::Node};
use crate::{
    id::{AppId, DeviceIndex, JobAttempt, JobId, NodeId},
    message::{CoordinatorToApp, JobFailure},
    time::Instant,
};

/// Most attempts that may crash in a row, of an application that has completed nothing yet. Ten are allowed to happen
/// (`tests/README.md`, 19); two may be at their end while the word travels.
const MOST_CRASHES_UNPROVEN: u32 = 8;

/// And of one that has: jobs that crash come in clusters (neighbouring tiles, say).
const MOST_CRASHES_PROVEN: u32 = 32;

/// How long a stopped application gets no devices, in milliseconds. Then it may try again.
pub(super) const STOPPED_MS: u64 = 60_000;

/// Whether an application gets devices.
#[derive(Debug)]
pub(super) enum Breaker {
    Closed {
        /// It has completed a job.
        proven: bool,
        /// Crashes since its last completed job, by node.
        crashes: BTreeMap<NodeId, u32>,
    },
    /// It is stopped.
    Open { until: Instant, reason: String },
}

impl Breaker {
    pub(super) const fn new() -> Self {
        Self::Closed { proven: false, crashes: BTreeMap::new() }
    }

    /// One of its jobs was completed.
    pub(super) fn completed(&mut self) {
        match self {
            Self::Closed { proven, crashes } => {
                *proven = true;
                crashes.clear();
            }
            Self::Open { .. } => {}
        }
    }

    /// An executor crashed with one of its jobs, on this node. Gives the crashes in a row and their nodes, if those are too many.
    fn crashed(&mut self, id: NodeId, node: &Node) -> Option<(u32, usize)> {
        let Self::Closed { proven, crashes } = self else { return None };
        *crashes.entry(id).or_default() += 1;
        let count: u32 = crashes.values().sum();
        let most = if *proven { MOST_CRASHES_PROVEN } else { MOST_CRASHES_UNPROVEN };
        // A driver that fails takes each device of its node along, once.
        let of_one_node = crashes.len() == 1 && count as usize <= node.devices.len();
        (count >= most && !of_one_node).then_some((count, crashes.len()))
    }

    /// Why it is stopped now. One whose time is over starts anew.
    pub(super) fn reason(&mut self, now: Instant) -> Option<&str> {
        if matches!(self, Self::Open { until, .. } if *until <= now) {
            *self = Self::new();
        }
        match self {
            Self::Open { reason, .. } => Some(reason),
            Self::Closed { .. } => None,
        }
    }
}

impl CoordinatorMachine {
    /// An executor crashed with a job: its application is stopped if that is one too many in a row.
    pub(super) fn app_crashed(
        &mut self,
        now: Instant,
        (id, index): (NodeId, DeviceIndex),
        job: JobAttempt,
        failure: &JobFailure,
    ) {
        match failure {
            JobFailure::Timeout | JobFailure::DeviceLost(_) => {}
            JobFailure::InvalidProgram(_)
            | JobFailure::OutOfMemory(_)
            | JobFailure::ContentUnavailable(_)
            | JobFailure::Poison(_)
            | JobFailure::PoisonApplication(_)
            | JobFailure::OverQuota(_)
            | JobFailure::Cancelled
            | JobFailure::Returned => return,
        }
        let Some(node) = self.nodes.get(&id) else { return };
        // A device that is gone for good may have gone by itself.
        if node.devices.get(usize::from(index.0)).is_none_or(|device| device.lost) {
            return;
        }
        let Some(app) = self.apps.get_mut(&job.job.app) else { return };
        let Some((count, nodes)) = app.breaker.crashed(id, node) else { return };
        let reason = format!(
            "{count} attempts in a row ended with their devices, on {nodes} nodes, the last one, {job}, on {id} {index}: {failure:?}"
        );
        self.stop_app(now, job.job.app, reason);
    }

    /// Takes all jobs of an application off the farm. It may stay, and hears why.
    fn stop_app(&mut self, now: Instant, id: AppId, reason: String) {
        tracing::warn!(app = %id, reason, "application stopped");
        let Some(app) = self.apps.get_mut(&id) else { return };
        let until = now.after(Duration::from_millis(STOPPED_MS));
        app.breaker = Breaker::Open { until, reason: reason.clone() };
        let jobs: Vec<JobId> = app.jobs.keys().map(|key| key.in_app(id)).collect();
        self.withdraw(jobs);
        self.keep_stopped(now, id, until, &reason);
        self.tell_app(id, CoordinatorToApp::Stopped { reason });
    }
}
