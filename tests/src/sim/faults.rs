//! What can go wrong, and a schedule of it drawn from a seed.

use std::time::Duration;

use farm_core::{
    coordinator,
    id::{LinkId, NodeId},
    time::Instant,
    worker,
};
use rand::Rng;

use crate::world::{Happening, Proc, World};

/// One thing that goes wrong, or comes right.
#[derive(Clone, Debug)]
pub(crate) enum Fault {
    /// This connection breaks.
    Break(LinkId),
    /// Some connection breaks.
    BreakAny,
    /// Some connection falls silent, and breaks after this time.
    SilenceAny(Duration),
    /// A worker's process is killed, and started again after this time, if at all.
    Kill { worker: usize, restart: Option<Duration> },
    /// A killed worker is started again.
    Start { worker: usize },
    /// A worker joins.
    Join { speeds: Vec<f64> },
    /// A worker's process is asked to end.
    Terminate { worker: usize },
    /// An operator drains a worker.
    Drain { worker: usize },
    /// A device is gone.
    LoseDevice { worker: usize, device: usize },
    /// An application and a worker cannot reach each other.
    Cut { app: usize, worker: usize },
    /// They can again.
    Mend { app: usize, worker: usize },
    /// The coordinator dies, and another one takes its place.
    NewCoordinator,
    /// No fault follows.
    Calm,
}

impl World {
    pub(crate) fn fault(&mut self, fault: Fault) {
        match fault {
            Fault::Break(link) => self.break_link(link),
            Fault::BreakAny => {
                if let Some(link) = self.any_link() {
                    self.break_link(link);
                }
            }
            Fault::SilenceAny(duration) => {
                if let Some(link) = self.any_link() {
                    self.silence_link(link);
                    self.after(duration, Happening::Fault(Fault::Break(link)));
                }
            }
            Fault::Kill { worker, restart } => {
                for link in self.links_of(Proc::Worker(worker)) {
                    self.break_link(link);
                }
                self.workers[worker].stop();
                if let Some(pause) = restart {
                    self.after(pause, Happening::Fault(Fault::Start { worker }));
                }
            }
            Fault::Start { worker } => {
                if !self.workers[worker].is_up() {
                    let seed = self.rng.random();
                    self.workers[worker].start(seed);
                    let life = self.workers[worker].life;
                    self.after(Duration::ZERO, Happening::Dial { proc: Proc::Worker(worker), life });
                }
            }
            Fault::Join { speeds } => self.add_worker(&speeds),
            Fault::Terminate { worker } => self.worker_event(worker, worker::Event::DrainRequested),
            Fault::Drain { worker } => {
                let name = format!("worker-{worker}");
                let node: Option<NodeId> = self
                    .coordinator
                    .status()
                    .nodes
                    .iter()
                    .find(|node| node.name == name)
                    .map(|node| node.node);
                if let Some(node) = node {
                    self.coordinator_event(coordinator::Event::DrainRequested { node });
                }
            }
            Fault::LoseDevice { worker, device } => self.lose_device(worker, device),
            Fault::Cut { app, worker } => {
                self.cuts.insert((app, worker));
                for link in self.links_between(Proc::App(app), Proc::Worker(worker)) {
                    self.break_link(link);
                }
            }
            Fault::Mend { app, worker } => {
                self.cuts.remove(&(app, worker));
            }
            Fault::NewCoordinator => self.restart_coordinator(),
            Fault::Calm => {
                self.work.crash_one_in = 0;
                self.work.fetch_fails_one_in = 0;
                self.duplicate_one_in = 0;
                self.cuts.clear();
            }
        }
    }

    /// Draws which kinds of faults this seed has, and when they come. Worker 0 stays, whole, for the others' jobs.
    pub(crate) fn schedule_faults(&mut self, until: Instant) {
        let apps = self.apps.len();
        for kind in 0..11 {
            if self.rng.random_bool(0.5) {
                continue;
            }
            for _ in 0..self.rng.random_range(1..4) {
                let at = Instant(self.rng.random_range(0..until.0));
                let worker = self.rng.random_range(0..self.workers.len());
                let other = self.rng.random_range(1..self.workers.len().max(2)).min(self.workers.len() - 1);
                let millis = Duration::from_millis(self.rng.random_range(10..2_000));
                let fault = match kind {
                    0 => Fault::BreakAny,
                    1 => Fault::SilenceAny(millis),
                    2 => Fault::Kill { worker, restart: Some(millis) },
                    3 if other > 0 => Fault::Kill { worker: other, restart: None },
                    4 => Fault::Join { speeds: vec![self.rng.random_range(0.5..4.0)] },
                    5 if other > 0 => Fault::Terminate { worker: other },
                    6 if other > 0 => Fault::Drain { worker: other },
                    7 if other > 0 => {
                        Fault::LoseDevice { worker: other, device: self.rng.random_range(0..3) }
                    }
                    8 => {
                        let app = self.rng.random_range(0..apps);
                        self.at(at.after(millis), Happening::Fault(Fault::Mend { app, worker }));
                        Fault::Cut { app, worker }
                    }
                    9 => Fault::NewCoordinator,
                    _ => {
                        self.work.crash_one_in = 20;
                        self.work.fetch_fails_one_in = 4;
                        self.duplicate_one_in = 5;
                        Fault::BreakAny
                    }
                };
                self.at(at, Happening::Fault(fault));
            }
        }
        self.at(until, Happening::Fault(Fault::Calm));
    }
}
