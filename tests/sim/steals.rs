//! Stealing between nodes: what it gains, what it may cost, and that it loses nothing.

use std::time::Duration;

use farm_core::{id::JobIndex, time::Instant};
use tests::sim::{
    faults::Fault,
    work::cost_ns,
    world::{Happening, MILLISECOND, RECOVERY, Setup, World},
};

use crate::{all_delivered, each_ran_once};

/// Nodes of the makespan tests.
const NODES: u32 = 16;

/// 0.1 to 0.8: a job takes 28 ms on average, almost three steal latencies.
fn speed(node: u32) -> f64 {
    (f64::from(node % 8) + 1.0) / 10.0
}

fn unequal(seed: u64, global_stealing: bool) -> World {
    let workers = (0..NODES).map(|node| vec![speed(node)]).collect();
    let setup =
        Setup { max_jobs: 100_000, global_stealing, score_error: 2.0, ..Setup::calm(seed, workers, 1) };
    World::new(setup)
}

/// Makespan over its lower bound, all work over all speeds, and the executions per job.
fn makespan_ratio(seed: u64, jobs: u32, global_stealing: bool) -> f64 {
    let mut world = unequal(seed, global_stealing);
    world.run_for(Duration::from_millis(200));
    world.submit(200, 0, 0, jobs);
    let begin = world.now;
    let deadline = begin.after(RECOVERY);
    world.run_until(deadline, |world| world.apps[0].is_done());
    let took = world.now.since(begin).as_secs_f64();
    assert!(all_delivered(&world), "{}", world.describe());
    let executions: u64 = world.audit.executions().map(|(_, executions)| u64::from(executions)).sum();
    let second_attempts = world.coordinator.status().speculations;
    assert!(executions <= u64::from(jobs) + second_attempts, "I5: a steal executes nothing twice");
    assert_eq!(world.coordinator.status().stolen_jobs > 0, global_stealing, "only where it is allowed");
    let work_ns: u64 = (0..jobs).map(|index| cost_ns(JobIndex(index))).sum();
    let speed: f64 = (0..NODES).map(speed).sum();
    took * speed / (work_ns as f64 / 1e9)
}

fn mean(jobs: u32, global_stealing: bool) -> f64 {
    const SEEDS: u32 = 3;
    let ratios: Vec<f64> =
        (0..SEEDS).map(|seed| makespan_ratio(seed.into(), jobs, global_stealing)).collect();
    let mean = ratios.iter().sum::<f64>() / f64::from(SEEDS);
    println!("{jobs} jobs, stealing {global_stealing}: {mean:.3} of {ratios:.3?}");
    mean
}

#[test]
fn stealing_makes_up_for_wrong_scores() {
    let (without, with) = (mean(NODES * 100, false), mean(NODES * 100, true));
    assert!(without > 1.3, "the test's farm needs stealing: {without}");
    assert!(with < 1.06, "{with} of the lower bound");
    let with = mean(NODES * 20, true);
    assert!(with < 1.6, "{with} of the lower bound at 20 jobs per node");
}

#[test]
fn a_joining_node_gets_work_within_two_seconds() {
    for global_stealing in [false, true] {
        let setup = Setup { global_stealing, ..Setup::calm(1, vec![vec![1.0]], 1) };
        let mut world = World::new(setup);
        world.submit(0, 0, 0, 1_000);
        let join = Happening::Fault(Fault::Join { speeds: vec![1.0] });
        world.at(Instant(1_000 * MILLISECOND), join);
        world.run_for(Duration::from_secs(3));
        let nodes = world.coordinator.status().nodes;
        let executed: Vec<u64> = nodes.iter().map(|node| node.devices[0].executed_jobs).collect();
        assert!(executed[1] > 100, "executed by now: {executed:?}");
        // A thousand jobs of 10 ms, the first second alone: both end together at 5.5 s.
        world.run_for(Duration::from_secs(4));
        assert!(world.apps[0].is_done(), "{}", world.describe());
        assert!(each_ran_once(&world), "I5: nothing is executed twice");
        world.finish();
    }
}

#[test]
fn without_consent_nothing_moves_between_nodes_that_are_there() {
    let mut world = unequal(1, false);
    world.run_for(Duration::from_millis(200));
    world.submit(200, 0, 0, 1_000);
    world.finish();
    assert_eq!(world.coordinator.status().stolen_jobs, 0, "not allowed");
}

#[test]
fn a_victim_that_dies_while_asked_loses_no_job() {
    for at_ms in (100..900).step_by(25) {
        let setup = Setup {
            max_crashes: 1_000,
            global_stealing: true,
            score_error: 3.0,
            ..Setup::calm(at_ms, vec![vec![0.5], vec![4.0], vec![4.0]], 2)
        };
        let mut world = World::new(setup);
        world.submit(0, 0, 0, 300);
        world.submit(0, 1, 1, 300);
        let restart = at_ms.is_multiple_of(2).then_some(Duration::from_millis(20));
        let kill = Fault::Kill { worker: usize::from(at_ms % 3 == 0), restart };
        world.at(Instant(at_ms * MILLISECOND), Happening::Fault(kill));
        world.at(Instant((at_ms + 40) * MILLISECOND), Happening::Fault(Fault::BreakAny));
        world.finish();
        assert!(all_delivered(&world), "{at_ms} ms: {}", world.describe());
    }
}
