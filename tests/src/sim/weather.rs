//! What a seed has in store: a farm, its work, and which kinds of trouble come when.

use std::{collections::BTreeSet, time::Duration};

use farm_core::{
    coordinator::policy::{HISTORY, NEIGHBOURS},
    id::{DeviceIndex, TaskId},
    ledger::Event,
    project::Quota,
    time::Instant,
};
use rand::{Rng, SeedableRng, rngs::SmallRng};

use super::{
    faults::Fault,
    hosts::{PLUGIN, PROJECTS},
    network::{Distances, Duplicates, Proc},
    world::{Happening, MILLISECOND, Setup, World},
};

/// How long faults come, in milliseconds. Work is submitted in the first half of it.
const TROUBLE_MS: u64 = 3_000;

/// A kind of trouble, on or off for a seed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    /// Connections break.
    Breaks,
    /// Connections fall silent, then break.
    Silence,
    /// Connections hold messages back.
    Stalls,
    /// Nothing gets through in one direction.
    OneWay,
    /// Applications and workers cannot reach each other, and know it.
    Cuts,
    /// Some connections are long.
    Distance,
    /// Messages arrive twice.
    Doubles,
    /// Messages are lost on connections that stand. As `Plugins`.
    Losses,
    /// Workers are killed and started again.
    Restarts,
    /// Workers are killed for good.
    Deaths,
    /// Most workers are killed at once.
    Collapse,
    /// The coordinator is killed and started again.
    Coordinator,
    /// An application is killed for good.
    Orphans,
    /// Applications are killed and resume.
    Resumes,
    /// Devices become slow.
    Grey,
    /// Devices are lost.
    DeviceLoss,
    /// Some jobs crash whatever runs them.
    Poison,
    /// Runs end with a failure, by chance.
    Crashes,
    /// Contents cannot be had, by chance.
    Fetches,
    /// Workers are drained, by an operator or from within.
    Drains,
    /// Workers join.
    Joins,
    /// Clocks are too fast or too slow.
    Skew,
    /// A task is given up.
    Cancels,
    /// Announced scores are wrong.
    Scores,
    /// Applications allow stealing between nodes.
    Stealing,
    /// Every other application is interactive. As `Plugins`.
    Classes,
    /// Applications choose a plug-in. Not in [`Self::ALL`]: it has a scenario of its own, in every seed.
    Plugins,
    /// Applications choose a policy that learns. As `Plugins`.
    Parts,
    /// Applications belong to projects with quotas, which change. As `Plugins`.
    Projects,
}

impl Kind {
    /// All of them.
    pub(super) const ALL: [Self; 24] = [
        Self::Breaks,
        Self::Silence,
        Self::Stalls,
        Self::OneWay,
        Self::Cuts,
        Self::Distance,
        Self::Doubles,
        Self::Restarts,
        Self::Deaths,
        Self::Collapse,
        Self::Coordinator,
        Self::Orphans,
        Self::Resumes,
        Self::Grey,
        Self::DeviceLoss,
        Self::Poison,
        Self::Crashes,
        Self::Fetches,
        Self::Drains,
        Self::Joins,
        Self::Skew,
        Self::Cancels,
        Self::Scores,
        Self::Stealing,
    ];
}

/// What a seed has in store.
#[derive(Debug)]
pub(super) struct Weather {
    pub(super) setup: Setup,
    kinds: BTreeSet<Kind>,
    /// Of everything that is drawn before the farm runs.
    rng: SmallRng,
}

impl Weather {
    /// Draws a farm, and which of the `kinds` it has. The share of them is drawn too: some seeds have one kind of
    /// trouble, some nearly all.
    pub(super) fn forecast(seed: u64, kinds: &[Kind]) -> Self {
        // Another generator than the world's: what happens in it does not depend on how it was drawn.
        let mut rng = SmallRng::seed_from_u64(!seed);
        let density = [0.1, 0.3, 0.6][rng.random_range(0..3)];
        let policy = policy_of(seed, kinds);
        let interactive = kinds.contains(&Kind::Classes);
        let projects = kinds.contains(&Kind::Projects);
        let mut drawn: BTreeSet<Kind> = kinds.iter().copied().filter(|_| rng.random_bool(density)).collect();
        for always in [Kind::Losses, Kind::Projects] {
            if kinds.contains(&always) {
                drawn.insert(always);
            }
        }
        let kinds = drawn;
        let has = |kind| kinds.contains(&kind);
        let workers = rng.random_range(2..=5);
        let speeds = |rng: &mut SmallRng| {
            let devices = rng.random_range(1..=3);
            (0..devices).map(|_| rng.random_range(0.2..1.0)).collect()
        };
        let workers = (0..workers).map(|_| speeds(&mut rng)).collect();
        let apps = rng.random_range(1..=3);
        let setup = Setup {
            // What fails by chance adds up to poison sooner or later; there poison is not looked for.
            max_crashes: if has(Kind::Crashes) || has(Kind::Fetches) { 1_000 } else { 3 },
            max_jobs: if rng.random_bool(0.3) { 40 } else { 10_000 },
            global_stealing: has(Kind::Stealing),
            interactive,
            projects,
            policy,
            score_error: if has(Kind::Scores) { 3.0 } else { 1.0 },
            skewed_clocks: has(Kind::Skew),
            distances: if has(Kind::Distance) { Distances::Mixed } else { Distances::Lan },
            ..Setup::calm(seed, workers, apps)
        };
        Self { setup, kinds, rng }
    }

    fn has(&self, kind: Kind) -> bool {
        self.kinds.contains(&kind)
    }

    fn has_poison(&self) -> bool {
        self.has(Kind::Poison) && self.setup.max_crashes < 1_000
    }

    /// Lets the weather come over a farm: work, faults, and calm at the end.
    pub(super) fn come_over(mut self, world: &mut World) {
        self.submit(world);
        if self.has(Kind::Projects) {
            for project in PROJECTS {
                let quota = self.quota(false);
                world.fault(Fault::Quota { project, quota });
            }
        }
        if self.has_poison() {
            world.work.poison.insert(TaskId(1));
        }
        if self.has(Kind::Crashes) {
            world.work.crash_one_in = 20;
        }
        if self.has(Kind::Fetches) {
            world.work.fetch_fails_one_in = 4;
        }
        if self.has(Kind::Doubles) {
            world.duplicates = Duplicates::Any(self.rng.random_range(2..20));
        }
        if self.has(Kind::Losses) {
            world.lost_one_in = self.rng.random_range(2..20);
        }
        for kind in self.kinds.clone() {
            for _ in 0..self.rng.random_range(1..4) {
                let at = Instant(self.rng.random_range(0..TROUBLE_MS * MILLISECOND));
                if let Some(happening) = self.draw(kind, world) {
                    world.at(at, happening);
                }
            }
        }
        let until = Instant(TROUBLE_MS * MILLISECOND);
        world.at(until, Happening::Fault(Fault::Calm));
        world.run_until(until.after(Duration::from_secs(1)), |world| world.now > until);
    }

    fn submit(&mut self, world: &mut World) {
        for app in 0..world.apps.len() {
            for task in 0..self.rng.random_range(1..4) {
                let at_ms = self.rng.random_range(0..TROUBLE_MS / 2);
                // Poison costs a run on three nodes each.
                let most = if task == 1 && self.has_poison() { 8 } else { 80 };
                world.submit(at_ms, app, task, self.rng.random_range(1..most));
            }
        }
    }

    /// A fault of this kind; none for kinds that are there from the beginning. Worker 0 and application 0 stay.
    fn draw(&mut self, kind: Kind, world: &World) -> Option<Happening> {
        let rng = &mut self.rng;
        let worker = rng.random_range(0..world.workers.len());
        let other = rng.random_range(1..world.workers.len());
        let app = rng.random_range(0..world.apps.len());
        let device = DeviceIndex(rng.random_range(0..3));
        let short = Duration::from_millis(rng.random_range(10..500));
        let long = Duration::from_millis(rng.random_range(10..2_500));
        let fault = match kind {
            Kind::Breaks => Fault::BreakAny,
            Kind::Silence => Fault::SilenceAny(long),
            Kind::Stalls => Fault::StallAny(long),
            Kind::OneWay => {
                let (one, another) = match rng.random_range(0..3) {
                    0 => (Proc::Worker(worker), Proc::Coordinator),
                    1 => (Proc::App(app), Proc::Coordinator),
                    _ => (Proc::App(app), Proc::Worker(worker)),
                };
                let (from, to) = if rng.random_bool(0.5) { (one, another) } else { (another, one) };
                Fault::Partition { from, to, duration: long }
            }
            Kind::Cuts => Fault::Cut { app, worker },
            Kind::Restarts => Fault::Kill { worker, restart: Some(long) },
            Kind::Deaths => Fault::Kill { worker: other, restart: None },
            Kind::Collapse => Fault::KillMost { restart: long },
            Kind::Coordinator => Fault::KillCoordinator { restart: short },
            Kind::Orphans if app > 0 => Fault::Vanish { app, back: None },
            Kind::Orphans => return None,
            Kind::Resumes => Fault::Vanish { app, back: Some(long) },
            Kind::Grey => Fault::Slow { worker, device, slowness: rng.random_range(5.0..50.0) },
            Kind::DeviceLoss => Fault::LoseDevice { worker: other, device },
            Kind::Drains if rng.random_bool(0.5) => Fault::Drain { worker: other },
            Kind::Drains => Fault::Terminate { worker: other },
            Kind::Projects => {
                let project = PROJECTS[rng.random_range(0..PROJECTS.len())];
                Fault::Quota { project, quota: self.quota(true) }
            }
            Kind::Joins => Fault::Join { speeds: vec![rng.random_range(0.5..2.0)] },
            Kind::Cancels => {
                return Some(Happening::App { app, event: Event::Cancelled(TaskId(rng.random_range(0..3))) });
            }
            Kind::Distance
            | Kind::Doubles
            | Kind::Losses
            | Kind::Poison
            | Kind::Crashes
            | Kind::Fetches
            | Kind::Skew
            | Kind::Scores
            | Kind::Stealing
            | Kind::Classes
            | Kind::Plugins
            | Kind::Parts => return None,
        };
        Some(Happening::Fault(fault))
    }
}

impl Weather {
    /// What a project may have; while there is trouble that may be nothing.
    fn quota(&mut self, nothing: bool) -> Quota {
        let rng = &mut self.rng;
        let least = u32::from(!nothing);
        Quota {
            devices: rng.random_bool(0.5).then(|| rng.random_range(least..5)),
            queued_jobs: rng.random_bool(0.5).then(|| rng.random_range(least..40).into()),
            // Above what a task has.
            bytes: rng.random_bool(0.5).then_some(5 << 20),
            weight: rng.random_bool(0.5).then(|| rng.random_range(0.5..4.0)),
        }
    }
}

/// What the applications of a seed choose.
fn policy_of(seed: u64, kinds: &[Kind]) -> &'static str {
    match (kinds.contains(&Kind::Plugins), kinds.contains(&Kind::Parts)) {
        (true, _) => PLUGIN,
        (false, true) if seed.is_multiple_of(3) => HISTORY,
        (false, true) => NEIGHBOURS,
        (false, false) => "",
    }
}
