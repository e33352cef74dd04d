//! What must hold in a worker between any two events.

use std::collections::BTreeMap;

use super::{
    WorkerMachine,
    content::ContentState,
    drain::Drain,
    job::{HeldJob, HeldState, Phase},
    report::Reports,
};
use crate::{
    id::{ContentHash, DeviceIndex},
    message::LatencyClass,
};

impl WorkerMachine {
    /// Asserts what must hold between any two events.
    ///
    /// # Panics
    /// An invariant is broken; the message says which.
    pub fn check_invariants(&self) {
        if self.drain == Drain::Gone {
            return;
        }
        self.check_places();
        self.check_apps();
        self.check_projects();
        self.check_contents();
        assert!(self.jobs.len() <= self.config.max_jobs, "I8: more than {} jobs", self.config.max_jobs);
        assert!(self.reports.kept() <= Reports::max_kept(), "I8: more reports are kept than allowed");
        self.tombstones.check_invariants();
        let spooled: u64 = self.jobs.values().map(HeldJob::spooled_bytes).sum();
        assert_eq!(spooled, self.spool_bytes, "I8: the spool's size is the sum of its results");
    }

    /// I1: each held job is in exactly the one place that its state names.
    fn check_places(&self) {
        let mut fetching: BTreeMap<DeviceIndex, usize> = BTreeMap::new();
        let mut queued = 0;
        let mut handed_over = 0;
        for (id, held) in &self.jobs {
            let device = &self.devices[usize::from(held.device.0)];
            match &held.state {
                HeldState::Fetching { missing } => {
                    assert!(*missing > 0, "I6: {id} waits for nothing");
                    *fetching.entry(held.device).or_default() += 1;
                }
                HeldState::Queued => {
                    let there =
                        device.queues().get(&id.app).is_some_and(|queue| queue.contains(&held.rank(*id)));
                    assert!(there, "I1: {id} is not in the queue of {}", held.device);
                    queued += 1;
                }
                HeldState::HandedOver(_) => {
                    let there = device.handed_over.iter().filter(|other| *other == id).count();
                    assert_eq!(there, 1, "I1: {id} is not with the executor of {}", held.device);
                    handed_over += 1;
                }
                HeldState::Executed(spooled) => {
                    assert_eq!(
                        spooled.header.job.attempt, held.attempt,
                        "I4: {id} keeps another attempt's result"
                    );
                }
            }
        }
        for (index, device) in (0_u16..).map(DeviceIndex).zip(&self.devices) {
            self.check_executor(index);
            let empty = device.queued_jobs == 0 && device.handed_over.is_empty() && device.waiting_jobs == 0;
            assert!(!device.lost || empty, "I1: {index} is lost and holds jobs");
            assert_eq!(
                device.waiting_jobs,
                fetching.remove(&index).unwrap_or_default(),
                "waiting jobs of {index}"
            );
            let idle = !device.lost && device.handed_over.is_empty();
            let waits = device.queues().keys().any(|app| self.takes_results(*app));
            assert!(!idle || !waits, "I6: {index} is idle while jobs are in its queue");
            assert!(
                device.queues().values().all(|queue| !queue.is_empty()),
                "I8: {index} keeps an empty queue"
            );
        }
        let in_queues: usize = self
            .devices
            .iter()
            .flat_map(|device| device.queues().values())
            .map(std::collections::BTreeSet::len)
            .sum();
        assert_eq!(in_queues, queued, "I1: queues hold exactly the queued jobs");
        assert_eq!(
            self.devices.iter().map(|device| device.queued_jobs).sum::<usize>(),
            queued,
            "queued jobs"
        );
        let with_executors: usize = self.devices.iter().map(|device| device.handed_over.len()).sum();
        assert_eq!(with_executors, handed_over, "I1: executors hold exactly the jobs handed over");
    }

    /// One runs, one is staged, and a third one only for the sake of an interactive job.
    fn check_executor(&self, index: DeviceIndex) {
        let there = &self.devices[usize::from(index.0)].handed_over;
        let urgent = there.iter().any(|id| self.jobs[id].class == LatencyClass::Interactive);
        assert!(there.len() <= 2 + usize::from(urgent), "{index} holds {} jobs", there.len());
        let phases = there.iter().filter_map(|id| match &self.jobs[id].state {
            HeldState::HandedOver(handed) => Some(handed.phase),
            HeldState::Fetching { .. } | HeldState::Queued | HeldState::Executed(_) => None,
        });
        let running = |phase: &Phase| matches!(phase, Phase::Running { .. });
        assert!(!phases.skip(1).any(|phase| running(&phase)), "{index}: what runs is first, and alone");
    }

    fn check_apps(&self) {
        for (link, app) in &self.links {
            let known = self.apps.get(app).is_some_and(|app| app.link == Some(*link));
            assert!(known, "{link} is not the link of {app}");
        }
        for (id, app) in &self.apps {
            let held: Vec<_> =
                self.jobs.iter().filter(|(job, _)| job.app == *id).map(|(_, held)| held).collect();
            assert_eq!(held.len(), app.held_jobs, "jobs of {id}");
            let active = held
                .iter()
                .filter(|held| matches!(held.state, HeldState::Queued | HeldState::HandedOver(_)))
                .count();
            assert_eq!(active, app.active_jobs, "active jobs of {id}");
            let spooled = held.iter().map(|held| held.spooled_bytes()).sum::<u64>();
            assert_eq!(spooled, app.spool_bytes, "I8: the results of {id}");
            let awake = active > 0 && self.takes_results(*id);
            assert_eq!(app.awake, awake, "whether {id} has a share");
        }
        let known = self.jobs.keys().all(|job| self.apps.contains_key(&job.app));
        assert!(known, "I8: jobs of an application that is gone");
    }

    fn check_contents(&self) {
        let mut references: BTreeMap<ContentHash, usize> = BTreeMap::new();
        for held in self.jobs.values() {
            let mut missing_now = 0;
            for content in &held.contents {
                *references.entry(content.hash).or_default() += 1;
                let state = self.contents.get(&content.hash).map(|holding| holding.state);
                missing_now += usize::from(state != Some(ContentState::Ready));
            }
            match held.state {
                HeldState::Fetching { missing } => {
                    assert_eq!(missing, missing_now, "contents that a job waits for")
                }
                HeldState::Queued | HeldState::HandedOver(_) => {
                    assert_eq!(missing_now, 0, "contents of a ready job")
                }
                HeldState::Executed(_) => {
                    assert!(held.contents.is_empty(), "an executed job needs no contents")
                }
            }
        }
        let counted: BTreeMap<ContentHash, usize> =
            self.contents.iter().map(|(&hash, holding)| (hash, holding.references)).collect();
        assert_eq!(references, counted, "I8: exactly the contents that jobs name are held");
    }
}
