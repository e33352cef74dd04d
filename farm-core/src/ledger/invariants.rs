//! What must hold in a ledger between any two events.

use super::{Ledger, nodes::Link, session::Session};

impl Ledger {
    /// Asserts what must hold between any two events.
    ///
    /// # Panics
    /// An invariant is broken; the message says which.
    pub fn check_invariants(&self) {
        self.check_counts();
        self.check_places();
        self.check_batches();
        self.check_unkept();
        if self.session == Session::Finished {
            let empty = self.jobs.is_empty()
                && self.nodes.is_empty()
                && self.batches.is_empty()
                && self.unkept.is_empty();
            assert!(empty && self.deadlines.is_empty(), "I8: something is kept after goodbye");
        }
    }

    fn check_counts(&self) {
        let open = self.counts.waiting_jobs + self.counts.outstanding_jobs;
        assert_eq!(open, self.jobs.len() as u64, "I1: open jobs are waiting or outstanding");
        let over = self.counts.delivered_jobs + self.counts.failed_jobs;
        assert_eq!(over, self.over.len() as u64, "I2: each job that is over was delivered or failed once");
        for key in self.jobs.keys() {
            assert!(!self.over.contains(key), "I2: {key} is open and over");
        }
    }

    /// I1: each planned job is in exactly one node's set, under its current attempt.
    fn check_places(&self) {
        let mut placed = 0;
        let mut attempts = 0;
        for (key, job) in &self.jobs {
            placed += u64::from(job.place.is_some());
            assert!(
                job.backup.is_none() || job.place.is_some(),
                "I5: {key} has a second attempt and no first one"
            );
            for place in job.placements() {
                attempts += 1;
                let there = self.nodes.get(&place.life).and_then(|node| node.outstanding.get(&place.attempt));
                assert_eq!(there, Some(key), "I1: {key} is not where its plan says");
            }
        }
        assert_eq!(self.counts.outstanding_jobs, placed, "I1: count of placed jobs");
        let held: u64 = self.nodes.values().map(|node| node.outstanding.len() as u64).sum();
        assert_eq!(held, attempts, "I1: nodes hold exactly the attempts planned");
        for (life, node) in &self.nodes {
            match node.link {
                Link::Connecting | Link::Greeting | Link::Backoff => {
                    assert!(self.deadlines.contains_key(life), "I1: {} waits without a timer", life.node);
                }
                Link::Open => {}
                Link::Unreachable => {
                    assert!(!node.outstanding.is_empty(), "I8: {} is kept for nothing", life.node);
                }
            }
        }
        for life in self.deadlines.keys() {
            assert!(self.nodes.contains_key(life), "I8: a timer of {} is kept for nothing", life.node);
        }
    }

    fn check_batches(&self) {
        let mut open = 0;
        let mut requested = 0;
        for batch in self.batches.values() {
            assert!(batch.open_jobs > 0, "I8: a batch is kept for nothing");
            open += u64::from(batch.open_jobs);
            if batch.requested {
                requested += u64::from(batch.open_jobs);
            }
        }
        assert_eq!(open, self.jobs.len() as u64, "I1: each open job is in one batch");
        assert_eq!(requested, self.requested_jobs, "the request window counts the open jobs asked for");
        let waiting: u64 = self.batches.values().map(|batch| u64::from(batch.waiting_jobs)).sum();
        assert_eq!(waiting, self.counts.waiting_jobs, "I1: waiting jobs are in batches");
    }
}
