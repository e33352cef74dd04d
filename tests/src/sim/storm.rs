//! The first generator of trouble, kept as it was: the seeds that once found something still mean the same.

use std::time::Duration;

use farm_core::{
    id::{DeviceIndex, TaskId},
    ledger::Event,
    time::Instant,
};
use rand::Rng;

use super::{
    faults::Fault,
    network::Duplicates,
    world::{Happening, MILLISECOND, Setup, World},
};

/// A farm in trouble, by seed, up to a second after its last fault.
pub(super) fn storm(world: &mut World) {
    let seed = world.setup.seed;
    for app in 0..2 {
        for task in 0..3 {
            let at_ms = world.rng.random_range(0..1_500);
            let count = world.rng.random_range(1..80);
            world.submit(at_ms, app, task, count);
        }
    }
    if seed.is_multiple_of(4) {
        world.at(Instant(700 * MILLISECOND), Happening::App { app: 1, event: Event::Cancelled(TaskId(2)) });
    }
    let until = Instant(3_000 * MILLISECOND);
    schedule(world, until);
    world.run_until(until.after(Duration::from_secs(1)), |world| world.now > until);
}

/// The farm of a storm.
pub(super) fn setup(seed: u64) -> Setup {
    Setup {
        // Crashes here are nobody's fault, so they must not add up to poison.
        max_crashes: 1_000,
        max_jobs: 100,
        global_stealing: !seed.is_multiple_of(3),
        score_error: if seed.is_multiple_of(2) { 1.0 } else { 3.0 },
        ..Setup::calm(seed, vec![vec![0.2], vec![0.4, 0.2], vec![0.6]], 2)
    }
}

/// Draws which kinds of faults this seed has, and when they come. Worker 0 stays, whole, for the others' jobs.
fn schedule(world: &mut World, until: Instant) {
    let apps = world.apps.len();
    for kind in 0..11 {
        if world.rng.random_bool(0.5) {
            continue;
        }
        for _ in 0..world.rng.random_range(1..4) {
            let at = Instant(world.rng.random_range(0..until.0));
            let worker = world.rng.random_range(0..world.workers.len());
            let other = world.rng.random_range(1..world.workers.len().max(2)).min(world.workers.len() - 1);
            let millis = Duration::from_millis(world.rng.random_range(10..2_000));
            let fault = match kind {
                0 => Fault::BreakAny,
                1 => Fault::SilenceAny(millis),
                2 => Fault::Kill { worker, restart: Some(millis) },
                3 if other > 0 => Fault::Kill { worker: other, restart: None },
                4 => Fault::Join { speeds: vec![world.rng.random_range(0.5..4.0)] },
                5 if other > 0 => Fault::Terminate { worker: other },
                6 if other > 0 => Fault::Drain { worker: other },
                7 if other > 0 => {
                    let device = u16::try_from(world.rng.random_range(0..3_usize)).expect("three");
                    Fault::LoseDevice { worker: other, device: DeviceIndex(device) }
                }
                8 => {
                    let app = world.rng.random_range(0..apps);
                    world.at(at.after(millis), Happening::Fault(Fault::Mend { app, worker }));
                    Fault::Cut { app, worker }
                }
                9 => Fault::NewCoordinator,
                _ => {
                    world.work.crash_one_in = 20;
                    world.work.fetch_fails_one_in = 4;
                    world.duplicates = Duplicates::Data(5);
                    Fault::BreakAny
                }
            };
            world.at(at, Happening::Fault(fault));
        }
    }
    world.at(until, Happening::Fault(Fault::Calm));
}
