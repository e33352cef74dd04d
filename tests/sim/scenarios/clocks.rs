//! Clocks that are wrong, and runs that are the same: scenarios 32 and 34.

use std::{collections::BTreeMap, thread};

use farm_core::coordinator::NodeState;
use tests::sim::{scenario::Scenario, world::Setup};
use tracing::Level;

use super::{
    alarms::logged_while,
    farm::{SPEED, farm, seconds, setup},
    figures::{Bar, count, figure},
};
use crate::all_delivered;

/// 32: each process's clock runs up to 10 % too fast or too slow, and starts at another time than all others: no node is ever
/// suspected, none registers twice, nothing is planned anew or executed again. Wall clocks are of no account: the machines are
/// given none (`farm-core/clippy.toml`); of certificates and capabilities `proto/src/trust` has the tests.
#[test]
fn s32_clocks_are_wrong_by_a_tenth() {
    let (mut suspected, mut registrations, mut replanned, mut again) = (0, 0, 0, 0);
    for seed in 0..3 {
        // 25 s of work, in which reports tell that nodes are there, and 15 s of heartbeats alone.
        let mut world = farm(Setup { skewed_clocks: true, ..setup(seed, SPEED) });
        for _ in 0..400 {
            world.run_for(seconds(0.1));
            let nodes = world.coordinator.status().nodes;
            suspected += nodes.iter().filter(|node| node.state == NodeState::Suspect).count();
        }
        world.finish();
        assert!(all_delivered(&world), "{}", world.describe());
        registrations += world.diary.registrations.len();
        replanned += world.coordinator.status().replanned_jobs;
        again += world.diary.executed_again();
    }
    count("s32", "times a node was seen suspect, of 4,800 looks", suspected, Bar::Exactly(0.0));
    count("s32", "registrations of 12 nodes", registrations, Bar::Exactly(12.0));
    figure("s32", "jobs planned anew", replanned as f64, "", Bar::Exactly(0.0));
    count("s32", "executed again", again, Bar::Exactly(0.0));
}

/// Runs of a seed are told apart by these.
type Trace = (u64, u64);

const SEEDS: u64 = 50;

fn traces(seeds: impl Iterator<Item = u64>) -> BTreeMap<u64, Trace> {
    let weather = Scenario::named("weather").expect("a scenario of this name");
    let trace = |seed| {
        let outcome = weather.run(seed, None);
        assert_eq!(outcome.verdict, Ok(()), "seed {seed}");
        (seed, (outcome.events, outcome.log_hash))
    };
    seeds.map(trace).collect()
}

/// 34: fifty seeds of all kinds of trouble twice: the second time on four threads, in another order, with everything logged. The
/// event logs have the same hashes.
#[test]
fn s34_the_same_seed_is_the_same_run() {
    let first = traces(0..SEEDS);
    let others: Vec<_> = (0..4)
        .map(|part| {
            let seeds = (0..SEEDS).rev().filter(move |seed| seed % 4 == part);
            thread::spawn(move || logged_while(Level::TRACE, || traces(seeds)))
        })
        .collect();
    let (mut logged, mut second) = (0, BTreeMap::new());
    for other in others {
        let (events, part) = other.join().expect("its seeds are fine");
        logged += events;
        second.extend(part);
    }
    let same = first.iter().filter(|(seed, trace)| second.get(*seed) == Some(*trace)).count();
    let mut distinct: Vec<&Trace> = first.values().collect();
    distinct.sort_unstable();
    distinct.dedup();
    count("s34", "seeds whose two runs have one hash, of 50", same, Bar::Exactly(50.0));
    count("s34", "different hashes among the seeds", distinct.len(), Bar::Exactly(50.0));
    count("s34", "lines logged in the second runs, none in the first", logged, Bar::AtLeast(1_000.0));
}
