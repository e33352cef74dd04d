//! What the coordinator is told of ended jobs: batched, and kept until a heartbeat's answer says that it arrived.

use std::{collections::VecDeque, time::Duration};

use super::{WorkerMachine, job::HeldState};
use crate::{
    id::JobAttempt,
    message::{Executed, NodeToCoordinator},
    time::Instant,
};

/// Longest time that a report waits for company, in milliseconds.
const REPORT_MS: u64 = 5;

/// Most entries in one report.
const MAX_REPORT_ENTRIES: usize = 64;

/// Most entries kept unsent or unconfirmed; beyond it the oldest are forgotten, and the coordinator finds out by the
/// inventory of the next hello.
const MAX_KEPT_ENTRIES: usize = 262_144;

/// One thing to tell.
#[derive(Clone, Debug)]
enum Entry {
    Executed(Executed),
    Delivered(JobAttempt),
}

/// Reports not yet known to have arrived.
#[derive(Debug, Default)]
pub(super) struct Reports {
    /// In order.
    unsent: VecDeque<Entry>,
    /// When `unsent` must leave.
    due: Option<Instant>,
    /// In order, each with the number of the last heartbeat before it. The connection keeps order: when a later
    /// heartbeat is answered, the entry has arrived.
    unconfirmed: VecDeque<(u64, Entry)>,
    last_heartbeat: u64,
    /// A failure is among the unsent: somebody waits for a new attempt.
    urgent: bool,
}

impl Reports {
    pub(super) fn executed(&mut self, now: Instant, executed: Executed) {
        self.urgent |= executed.failure.is_some();
        self.push(now, Entry::Executed(executed));
    }

    pub(super) fn delivered(&mut self, now: Instant, job: JobAttempt) {
        self.push(now, Entry::Delivered(job));
    }

    pub(super) const fn due(&self) -> Option<Instant> {
        self.due
    }

    pub(super) fn heartbeat_said(&mut self, sequence: u64) {
        self.last_heartbeat = sequence;
    }

    /// A heartbeat was answered: what was sent before it has arrived.
    pub(super) fn confirm(&mut self, sequence: u64) {
        while self.unconfirmed.pop_front_if(|(before, _)| *before < sequence).is_some() {}
    }

    /// The connection is another one: what is not known to have arrived is sent again.
    pub(super) fn unsend(&mut self) {
        while let Some((_, entry)) = self.unconfirmed.pop_back() {
            self.unsent.push_front(entry);
        }
        if !self.unsent.is_empty() {
            self.due = Some(Instant::ZERO);
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.unsent.is_empty()
    }

    pub(super) fn kept(&self) -> usize {
        self.unsent.len() + self.unconfirmed.len()
    }

    pub(super) const fn max_kept() -> usize {
        MAX_KEPT_ENTRIES
    }

    fn push(&mut self, now: Instant, entry: Entry) {
        self.unsent.push_back(entry);
        self.due.get_or_insert_with(|| now.after(Duration::from_millis(REPORT_MS)));
        if self.kept() > MAX_KEPT_ENTRIES && self.unconfirmed.pop_front().is_none() {
            self.unsent.pop_front();
        }
    }

    fn take_message(&mut self, sent_at: Instant) -> NodeToCoordinator {
        let mut executed = Vec::new();
        let mut delivered = Vec::new();
        for entry in self.unsent.drain(..self.unsent.len().min(MAX_REPORT_ENTRIES)) {
            match &entry {
                Entry::Executed(ended) => executed.push(ended.clone()),
                Entry::Delivered(job) => delivered.push(*job),
            }
            self.unconfirmed.push_back((self.last_heartbeat, entry));
        }
        NodeToCoordinator::Report { sent_at, executed, delivered }
    }
}

impl WorkerMachine {
    /// Sends reports that are due, full, urgent, or that nothing will come to join.
    pub(super) fn flush_reports(&mut self, now: Instant) {
        if self.reports.is_empty() || !self.session.is_registered() {
            return;
        }
        let due = self.reports.due.is_some_and(|due| due <= now);
        if due || self.reports.urgent || self.is_idle() {
            self.flush_all_reports(now);
            return;
        }
        while self.reports.unsent.len() >= MAX_REPORT_ENTRIES {
            let message = self.reports.take_message(now);
            self.tell_coordinator(message);
        }
        if self.reports.unsent.is_empty() {
            self.reports.due = None;
        }
    }

    pub(super) fn flush_all_reports(&mut self, now: Instant) {
        while !self.reports.unsent.is_empty() {
            let message = self.reports.take_message(now);
            self.tell_coordinator(message);
        }
        self.reports.due = None;
        self.reports.urgent = false;
    }

    /// Nothing runs and nothing is queued.
    fn is_idle(&self) -> bool {
        self.devices.iter().all(|device| {
            device.queued_jobs == 0 && device.waiting_jobs == 0 && device.handed_over.is_empty()
        })
    }

    /// Whether every held job is executed.
    pub(super) fn holds_only_results(&self) -> bool {
        self.is_idle() && self.jobs.values().all(|held| matches!(held.state, HeldState::Executed(_)))
    }
}
