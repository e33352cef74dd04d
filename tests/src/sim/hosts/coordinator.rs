//! The coordinator's process, and what it finds on its disk when it starts.

use farm_core::{
    coordinator::{CoordinatorConfig, CoordinatorMachine, Effect, Event},
    id::Epoch,
};

use crate::sim::{
    auditor::Auditor,
    network::{Message, Proc},
    world::{World, liveness},
};

/// How long a vanished application keeps its jobs, in milliseconds: three times what a silent node gets, as in the
/// design.
const APP_LEASE_MS: u64 = 3_000;

/// What survives the coordinator's process: what it committed.
#[derive(Clone, Copy, Debug)]
pub(in crate::sim) struct Store {
    pub(in crate::sim) epoch: u32,
}

impl Store {
    /// A process that starts on this store.
    pub(in crate::sim) fn coordinator(self, seed: u64, max_crashes: u32) -> CoordinatorMachine {
        let config = CoordinatorConfig::new(Epoch(self.epoch), seed);
        CoordinatorMachine::new(CoordinatorConfig {
            liveness: liveness(),
            app_lease_ms: APP_LEASE_MS,
            max_crashes,
            ..config
        })
    }
}

impl World {
    /// The coordinator dies and another process, which knows only what is on the disk, takes its address at once.
    pub fn restart_coordinator(&mut self) {
        self.stop_coordinator();
        self.start_coordinator();
    }

    pub(in crate::sim) fn stop_coordinator(&mut self) {
        for link in self.links_of(Proc::Coordinator) {
            self.drop_link(link);
        }
        self.audit.disturbed(self.now, Proc::Coordinator, Proc::Coordinator);
        self.store.epoch += 1;
        self.coordinator_up = false;
        self.rearm(Proc::Coordinator);
    }

    pub(in crate::sim) fn start_coordinator(&mut self) {
        if self.coordinator_up {
            return;
        }
        self.coordinator_up = true;
        self.coordinator_clock = self.new_clock();
        self.coordinator = self.store.coordinator(self.store.epoch.into(), self.setup.max_crashes);
        self.rearm(Proc::Coordinator);
    }

    pub(in crate::sim) fn coordinator_event(&mut self, event: Event) {
        if !self.coordinator_up {
            return;
        }
        let before = self.coordinator.stolen_jobs();
        let answer = Auditor::steal_answer(&event);
        self.coordinator.handle(self.coordinator_clock.shows(self.now), event);
        self.audit.moved(answer, self.coordinator.stolen_jobs() - before);
        self.coordinator_settles();
    }

    pub(in crate::sim) fn coordinator_settles(&mut self) {
        if self.audit.is_due() {
            self.coordinator.check_invariants();
        }
        while let Some(effect) = self.coordinator.poll_effect() {
            self.log.enter(self.now, Proc::Coordinator, &effect);
            match effect {
                Effect::ToApp { link, message } => {
                    self.send(Proc::Coordinator, link, Message::CoordinatorToApp(message));
                }
                Effect::ToNode { link, message } => {
                    self.send(Proc::Coordinator, link, Message::CoordinatorToNode(message));
                }
                Effect::Close { link } => self.hang_up(Proc::Coordinator, link),
                Effect::AskPolicy { plugin, .. } => panic!("nobody chose {plugin}"),
            }
        }
        self.rearm(Proc::Coordinator);
    }
}
