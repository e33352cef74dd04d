//! What nodes hold, compared with what they should hold: with each hello, and now and then (20-delivery.md, "Who owns the truth").
//!
//! A job that is missing may be on its way, and so may the report of its end: it gets a new attempt when it is missing still at a
//! second look.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use super::CoordinatorMachine;
use crate::{
    holding::Holding,
    id::{AppId, Attempt, JobAttempt, JobId, NodeId},
    message::CoordinatorToNode,
    time::Instant,
};

/// For how many comparisons a job may be missing on a node that was there all the time: it may wait in its application's link
/// behind large ones.
const MISSING_COMPARISONS: u32 = 2;

/// A job that its node did not hold when it said what it holds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Missing {
    attempt: Attempt,
    /// If it is missing then, too, it is lost.
    until: Instant,
}

impl CoordinatorMachine {
    /// A node is back on a new connection, and says what it holds.
    pub(super) fn reconcile(&mut self, now: Instant, id: NodeId, inventory: &[JobAttempt]) {
        let held = inventory.iter().map(|item| (item.job, item.attempt)).collect();
        self.settle_interrupted_steals(id, &held);
        let patience = Duration::from_millis(self.config.liveness.dead_ms);
        self.look_for_missing(now, id, &held, now.after(patience));
        self.drop_stale(id, inventory);
    }

    /// A node says in short what it holds.
    pub(super) fn holding(&mut self, id: NodeId, theirs: Holding) {
        let Some(node) = self.nodes.get(&id) else { return };
        let brought = node.brought.iter().map(|(&job, brought)| brought.of(job));
        let ours: Holding = self.planned_on(id).chain(brought).collect();
        if ours != theirs {
            self.tell_node(id, CoordinatorToNode::SayInventory);
        }
    }

    /// A node says what it holds, because it was asked.
    pub(super) fn inventory(&mut self, now: Instant, id: NodeId, inventory: &[JobAttempt]) {
        let held = inventory.iter().map(|item| (item.job, item.attempt)).collect();
        let patience = self.config.liveness.compare_every().saturating_mul(MISSING_COMPARISONS);
        self.look_for_missing(now, id, &held, now.after(patience));
        self.drop_stale(id, inventory);
    }

    /// Asks nodes again whose missing jobs have had their time.
    pub(super) fn ask_for_missing(&mut self, now: Instant) {
        let due = self.nodes.iter_mut().filter_map(|(&id, node)| {
            node.ask_at.take_if(|at| *at <= now)?;
            Some(id)
        });
        for id in due.collect::<Vec<_>>() {
            self.tell_node(id, CoordinatorToNode::SayInventory);
        }
    }

    /// Jobs that a node should hold and does not: those that are new among them have time until `until`.
    fn look_for_missing(
        &mut self,
        now: Instant,
        id: NodeId,
        held: &BTreeMap<JobId, Attempt>,
        until: Instant,
    ) {
        let missing: Vec<JobAttempt> =
            self.planned_on(id).filter(|item| held.get(&item.job) != Some(&item.attempt)).collect();
        let Some(node) = self.nodes.get_mut(&id) else { return };
        let before = std::mem::take(&mut node.missing);
        let mut lost = Vec::new();
        for JobAttempt { job, attempt } in missing {
            let before = before.get(&job).filter(|before| before.attempt == attempt);
            let until = before.map_or(until, |before| before.until.min(until));
            if until <= now {
                lost.push(JobAttempt { job, attempt });
            } else {
                node.missing.insert(job, Missing { attempt, until });
            }
        }
        node.ask_at = node.missing.values().map(|missing| missing.until).min();
        if let Some(at) = node.ask_at {
            self.arm(at);
        }
        if lost.is_empty() {
            return;
        }
        tracing::warn!(node = %id, jobs = lost.len(), "jobs are missing on their node");
        for JobAttempt { job, attempt } in &lost {
            if self.holder(*job) == Some((id, *attempt)) {
                self.requeue(*job, None);
            } else {
                self.drop_backup(*job);
            }
        }
        self.tell_node(id, CoordinatorToNode::Cancel { jobs: lost });
    }

    /// What a node holds and nobody waits for is dropped there.
    fn drop_stale(&mut self, id: NodeId, inventory: &[JobAttempt]) {
        let mut stale = Vec::new();
        let mut left: BTreeSet<AppId> = BTreeSet::new();
        for item in inventory {
            match self.apps.get(&item.job.app) {
                None => {
                    left.insert(item.job.app);
                }
                Some(_) if !self.answers_for(id, *item) && !self.may_be_adopted(id, *item) => {
                    stale.push(*item);
                }
                Some(_) => {}
            }
        }
        if !stale.is_empty() {
            self.tell_node(id, CoordinatorToNode::Cancel { jobs: stale });
        }
        // Applications of an earlier coordinator may come back to this one; those of our own epoch are gone.
        let issued_before = self.issued_before();
        for app in left.into_iter().filter(|app| app.0 > issued_before) {
            self.tell_node(id, CoordinatorToNode::AppLeft { app });
        }
    }

    /// The attempts that are to be on a node.
    fn planned_on(&self, id: NodeId) -> impl Iterator<Item = JobAttempt> {
        let jobs = self.nodes.get(&id).into_iter().flat_map(|node| &node.jobs);
        jobs.filter_map(move |&job| {
            let first = self.holder(job).filter(|(node, _)| *node == id).map(|(_, attempt)| attempt);
            let second =
                || self.backups.get(&job).filter(|backup| backup.node == id).map(|backup| backup.attempt);
            Some(JobAttempt { job, attempt: first.or_else(second)? })
        })
    }
}
