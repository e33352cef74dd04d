//! What can go wrong, and what it does to the world.

use std::time::Duration;

use farm_core::{
    coordinator,
    id::{DeviceIndex, LinkId, NodeId},
    project::Quota,
    worker,
};

use super::{
    network::{Duplicates, Proc},
    world::{Happening, World},
};

/// How long a dead connection stands: HTTP/2 pings every 5 s wait 5 s for their answer, QUIC's idle time is 5 s from the last
/// ping, one every second (`proto/src/control/transport.rs`, `proto/src/link/connect.rs`).
#[must_use]
pub const fn keepalive(one: Proc, other: Proc) -> Duration {
    match (one, other) {
        (Proc::Coordinator, _) | (_, Proc::Coordinator) => Duration::from_secs(10),
        (Proc::Worker(_) | Proc::App(_), Proc::Worker(_) | Proc::App(_)) => Duration::from_secs(6),
    }
}

/// One thing that goes wrong, or comes right.
#[derive(Clone, Debug)]
pub enum Fault {
    /// This connection breaks.
    Break(LinkId),
    /// Some connection breaks.
    BreakAny,
    /// Some connection falls silent, and breaks after this time.
    SilenceAny(Duration),
    /// Some connection holds everything back for this time.
    StallAny(Duration),
    /// Every connection of a process holds everything back for this time.
    Stall {
        /// Whose.
        proc: Proc,
        /// For how long.
        duration: Duration,
    },
    /// An application reads no results for this time.
    Deafen {
        /// Which.
        app: usize,
        /// For how long.
        duration: Duration,
    },
    /// The keepalives of two processes give up the connections between them.
    TimeOut {
        /// One of the two.
        one: Proc,
        /// The other one.
        other: Proc,
    },
    /// Nothing gets through from one process to another for this time, and nobody is told.
    Partition {
        /// Who is not heard.
        from: Proc,
        /// By whom.
        to: Proc,
        /// For how long.
        duration: Duration,
    },
    /// The partition is over.
    Heal {
        /// Who is heard again.
        from: Proc,
        /// By whom.
        to: Proc,
    },
    /// A worker's process is killed, and started again after this time, if at all.
    Kill {
        /// Which.
        worker: usize,
        /// Its pause.
        restart: Option<Duration>,
    },
    /// A worker's process is gone as in [`Self::Kill`], but what it said is still on its way, and arrives; nobody learns of its
    /// end before.
    Abandon {
        /// Which.
        worker: usize,
        /// Its pause.
        restart: Duration,
    },
    /// A worker's machine is off, for good: its connections fall silent, until its peers' keepalives give them up.
    PowerOff {
        /// Which.
        worker: usize,
    },
    /// A killed worker is started again.
    Start {
        /// Which.
        worker: usize,
    },
    /// Most workers are killed at once, and started again after this time. The first one stays.
    KillMost {
        /// Their pause.
        restart: Duration,
    },
    /// A worker joins.
    Join {
        /// Its devices.
        speeds: Vec<f64>,
    },
    /// A worker's process is asked to end.
    Terminate {
        /// Which.
        worker: usize,
    },
    /// An operator drains a worker.
    Drain {
        /// Which.
        worker: usize,
    },
    /// A device is gone.
    LoseDevice {
        /// Whose.
        worker: usize,
        /// Which.
        device: DeviceIndex,
    },
    /// A device becomes slow, and says nothing of it.
    Slow {
        /// Whose.
        worker: usize,
        /// Which.
        device: DeviceIndex,
        /// How many times slower.
        slowness: f64,
    },
    /// An application and a worker cannot reach each other.
    Cut {
        /// The application.
        app: usize,
        /// The worker.
        worker: usize,
    },
    /// They can again.
    Mend {
        /// The application.
        app: usize,
        /// The worker.
        worker: usize,
    },
    /// The coordinator dies, and another one takes its place at once.
    NewCoordinator,
    /// The coordinator dies, and is started again after this time.
    KillCoordinator {
        /// Its pause.
        restart: Duration,
    },
    /// A killed coordinator is started again.
    StartCoordinator,
    /// An application's process is killed, and started again after this time, if at all.
    Vanish {
        /// Which.
        app: usize,
        /// Its pause.
        back: Option<Duration>,
    },
    /// A killed application is started again.
    Return {
        /// Which.
        app: usize,
    },
    /// An operator changes what a project may have.
    Quota {
        /// Which.
        project: &'static str,
        /// What it may have.
        quota: Quota,
    },
    /// No fault follows.
    Calm,
}

impl World {
    /// Something goes wrong, now.
    pub fn fault(&mut self, fault: Fault) {
        self.log.remark(self.now, &fault);
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
            Fault::StallAny(duration) => {
                if let Some(link) = self.any_link() {
                    self.stall_link(link, duration);
                }
            }
            Fault::Stall { proc, duration } => {
                self.links_of(proc).into_iter().for_each(|link| self.stall_link(link, duration));
            }
            Fault::Deafen { app, duration } => self.deafen(app, duration),
            Fault::TimeOut { one, other } => self.break_links(one, other),
            Fault::Partition { from, to, duration } => {
                self.block(from, to);
                self.after(duration, Happening::Fault(Fault::Heal { from, to }));
            }
            Fault::Heal { from, to } => self.unblock(from, to),
            Fault::Kill { worker, restart } => {
                self.kill_worker(worker);
                if let Some(pause) = restart {
                    self.after(pause, Happening::Fault(Fault::Start { worker }));
                }
            }
            Fault::Abandon { worker, restart } => {
                self.abandon_worker(worker);
                self.after(restart, Happening::Fault(Fault::Start { worker }));
            }
            Fault::PowerOff { worker } => {
                for (link, patience) in self.power_off(worker) {
                    self.after(patience, Happening::Fault(Fault::Break(link)));
                }
            }
            Fault::Start { worker } => self.start_worker(worker),
            Fault::KillMost { restart } => {
                for worker in 1..self.workers.len() {
                    self.fault(Fault::Kill { worker, restart: Some(restart) });
                }
            }
            Fault::Join { speeds } => self.add_worker(&speeds),
            Fault::Terminate { worker } => self.worker_event(worker, worker::Event::DrainRequested),
            Fault::Drain { worker } => self.drain(worker),
            Fault::LoseDevice { worker, device } => self.lose_device(worker, device),
            Fault::Slow { worker, device, slowness } => self.slow_device(worker, device, slowness),
            Fault::Cut { app, worker } => {
                self.cuts.insert((app, worker));
                self.audit.disturbed(self.now, Proc::App(app), Proc::Worker(worker));
                for link in self.links_between(Proc::App(app), Proc::Worker(worker)) {
                    self.break_link(link);
                }
            }
            Fault::Mend { app, worker } => {
                self.cuts.remove(&(app, worker));
            }
            Fault::NewCoordinator => self.restart_coordinator(),
            Fault::KillCoordinator { restart } => {
                if self.coordinator_up {
                    self.stop_coordinator();
                    self.after(restart, Happening::Fault(Fault::StartCoordinator));
                }
            }
            Fault::StartCoordinator => self.start_coordinator(),
            Fault::Vanish { app, back } => self.vanish_app(app, back),
            Fault::Return { app } => self.return_app(app),
            Fault::Quota { project, quota } => self.set_quota(project, quota),
            Fault::Calm => self.calm_down(),
        }
    }

    fn drain(&mut self, worker: usize) {
        let name = format!("worker-{worker}");
        let nodes = self.coordinator.status().nodes;
        let node: Option<NodeId> = nodes.iter().find(|node| node.name == name).map(|node| node.node);
        if let Some(node) = node {
            self.coordinator_event(coordinator::Event::DrainRequested { node });
        }
    }

    fn calm_down(&mut self) {
        self.work.crash_one_in = 0;
        self.work.fetch_fails_one_in = 0;
        self.duplicates = Duplicates::Never;
        self.lost_one_in = 0;
        self.cuts.clear();
        for (from, to) in self.blocked.clone() {
            self.unblock(from, to);
        }
        self.heal_devices();
        self.start_coordinator();
        for (project, quota) in self.store.quotas.clone() {
            let devices = quota.devices.map(|most| most.max(1));
            let queued_jobs = quota.queued_jobs.map(|most| most.max(1));
            self.set_quota(&project, Quota { devices, queued_jobs, ..quota });
        }
    }
}
