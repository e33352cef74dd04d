//! What must hold in a coordinator between any two events.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    CoordinatorMachine,
    model::{Batch, JobState, Peer},
    rates::Module,
    steal::MAX_STEALS,
};
use crate::id::{AppId, Attempt, DeviceIndex, JobKey};

impl CoordinatorMachine {
    /// Asserts what must hold between any two events.
    ///
    /// # Panics
    /// An invariant is broken; the message says which.
    pub fn check_invariants(&self) {
        assert!(self.fresh.is_empty() && self.lost.is_empty(), "I1: jobs are left between two events");
        self.check_links();
        self.check_jobs();
        self.check_books();
        self.check_queue();
        self.check_steals();
        self.check_backups();
        self.check_spreads();
        self.check_projects();
    }

    fn check_links(&self) {
        for (link, peer) in &self.links {
            let known = match peer {
                Peer::App(app) => self.apps.get(app).is_some_and(|app| app.link == Some(*link)),
                Peer::Node(node) => self.nodes.get(node).is_some_and(|node| node.link == Some(*link)),
            };
            assert!(known, "{link} leads to nobody");
        }
        let linked = self.apps.values().filter(|app| app.link.is_some()).count()
            + self.nodes.values().filter(|node| node.link.is_some()).count();
        assert_eq!(linked, self.links.len(), "each connected peer has one link");
    }

    fn check_jobs(&self) {
        let mut attempts = BTreeSet::new();
        for (id, app) in &self.apps {
            let mut open: BTreeMap<_, (u32, u32)> = BTreeMap::new();
            let mut waiting = 0;
            for (key, job) in &app.jobs {
                let (jobs, placed) = open.entry(job.batch).or_default();
                *jobs += 1;
                *placed += u32::from(matches!(job.state, JobState::Placed(_)));
                match job.state.holder() {
                    None => waiting += 1,
                    Some((node, attempt)) => {
                        assert!(attempts.insert(attempt), "I4: {attempt} was issued twice");
                        let next = Attempt { epoch: self.config.epoch, sequence: self.next_attempt };
                        assert!(attempt < next, "I4: {attempt} was never issued");
                        let booked =
                            self.nodes.get(&node).is_some_and(|node| node.jobs.contains(&key.in_app(*id)));
                        assert!(booked, "I1: {id} {key} is on {node}, which does not know it");
                    }
                }
                assert!(!app.failed.contains_key(key), "I2: {id} {key} is open and failed");
            }
            assert_eq!(waiting, app.waiting_jobs, "I1: {id} counts its waiting jobs");
            let counts = |batch: &Batch| (batch.open_jobs, batch.placed_jobs);
            let batches: BTreeMap<_, _> =
                app.batches.iter().map(|(&id, batch)| (id, counts(batch))).collect();
            assert_eq!(open, batches, "I8: {id} keeps exactly the batches that have open jobs");
        }
    }

    fn check_books(&self) {
        for (id, node) in &self.nodes {
            let mut loads: BTreeMap<DeviceIndex, (BTreeMap<Module, u128>, u64)> = BTreeMap::new();
            for job in &node.jobs {
                let state = self
                    .apps
                    .get(&job.app)
                    .and_then(|app| app.jobs.get(&JobKey::of(*job)))
                    .map(|job| job.state);
                let backup = self.backups.get(job).copied().filter(|backup| backup.node == *id);
                let state = backup.map(JobState::Placed).or(state);
                let held = state.and_then(JobState::holder).map(|(node, _)| node);
                assert_eq!(held, Some(*id), "I1: {id} has {job} on its books, which is elsewhere");
                if let Some(JobState::Placed(place)) = state {
                    let (queued, jobs) = loads.entry(place.device).or_default();
                    *queued.entry(place.load.module).or_default() += u128::from(place.load.amount);
                    *jobs += 1;
                }
            }
            for (index, device) in (0_u16..).zip(&node.devices) {
                let expected = loads.remove(&DeviceIndex(index)).unwrap_or_default();
                let booked = (device.throughput.queued().collect(), device.planned_jobs);
                assert_eq!(booked, expected, "load of {id} {}", DeviceIndex(index));
            }
            assert!(loads.is_empty(), "{id} holds jobs of devices it does not have");
        }
    }

    /// I9: at most one order per thief, each job in one order at most and stolen at most three times.
    fn check_steals(&self) {
        let mut thieves = BTreeSet::new();
        for (id, steal) in &self.steals {
            assert!(thieves.insert(steal.thief), "I9: {} has two steals at once", steal.thief);
            assert_ne!(steal.thief, steal.victim, "I9: {id} is from a node to itself");
            assert!(
                self.nodes.contains_key(&steal.victim),
                "I8: {id} waits for {}, which left",
                steal.victim
            );
            let timed = self.wake.is_some_and(|wake| wake <= steal.answer_by);
            assert!(timed, "I1: {id} waits without a timer");
        }
        for (id, app) in &self.apps {
            for (key, job) in &app.jobs {
                assert!(job.stolen_from.len() <= MAX_STEALS, "I9: {id} {key} was stolen too often");
                let JobState::Placed(place) = job.state else { continue };
                let Some(steal) = place.retracting else { continue };
                let order = self.steals.get(&steal);
                let named = order.is_some_and(|order| {
                    order.victim == place.node && order.jobs.get(&key.in_app(*id)) == Some(&place.attempt)
                });
                assert!(named, "I9: {id} {key} waits for {steal}, which does not name it");
            }
        }
    }

    /// I1: each waiting job is in line once.
    fn check_queue(&self) {
        let mut queued: BTreeSet<(AppId, JobKey)> = BTreeSet::new();
        let asked = self.questions.values().map(|asked| &asked.pending);
        for (id, pending) in &self.reserved {
            let batch = self.apps.get(&id.0).and_then(|app| app.batches.get(&id.1));
            let waits = batch.is_some_and(|batch| batch.placed_jobs > 0);
            assert!(waits, "I1: {} of {} has jobs held back, and nothing to wait for", id.1, id.0);
            assert_eq!(*id, (pending.app, pending.batch), "I8: what is held back is of another batch");
        }
        for pending in
            self.stuck.iter().chain(self.projects.lines()).chain(asked).chain(self.reserved.values())
        {
            let Some(app) = self.apps.get(&pending.app) else {
                panic!("I8: jobs of {}, which left, are in line", pending.app)
            };
            for &key in &pending.keys {
                if app.waiting_job(key, pending.batch).is_some() {
                    assert!(queued.insert((pending.app, key)), "I1: {} {key} is in line twice", pending.app);
                }
            }
        }
        for (app, key, batch) in self.recovery.awaited() {
            if self.apps.get(&app).and_then(|app| app.waiting_job(key, batch)).is_some() {
                assert!(queued.insert((app, key)), "I1: {app} {key} is in line, and waits for its node");
            }
        }
        let waiting: u64 = self.apps.values().map(|app| app.waiting_jobs).sum();
        assert_eq!(queued.len() as u64, waiting, "I1: each waiting job is in line");
    }
}
