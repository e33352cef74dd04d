//! What moves between nodes, and nodes that come and go: scenarios 20 and 25.

use std::collections::BTreeSet;

use farm_core::{coordinator::NodeState, time::Instant};
use tests::sim::{
    auditor::Checks,
    diary::Run,
    faults::Fault,
    hosts::WorkerHost,
    scenario::Scenario,
    world::{RECOVERY, World},
};

use super::{
    farm::{HALF_SPEED, LONGEST_S, SEEDS, farm, seconds, setup, worst},
    figures::{Bar, count, figure},
};
use crate::{all_delivered, each_ran_once};

/// Seeds of the races here; 10,000 are `simulate --scenario steals --seeds 10000`.
const RACES: u64 = 250;

/// 20: thieves race for the same victim, which starts what they want, dies, hears of cancellations before jobs and of orders
/// twice: I1 to I5 and I9 hold in every seed (the auditor and the lookout judge), and no job is stolen more than 3 times.
#[test]
fn s20_steals_race() {
    let scenario = Scenario::named("steals").expect("a scenario of this name");
    let mut sum = Checks::default();
    for seed in 0..RACES {
        let outcome = scenario.run(seed, None);
        if let Err(broken) = outcome.verdict {
            panic!("simulate --scenario steals --seed {seed}\n{broken}");
        }
        sum = sum.plus(outcome.checks);
    }
    figure("s20", "steals judged (I9)", sum.steals as f64, "", Bar::AtLeast(1_000.0));
    figure("s20", "executions judged (I5)", sum.executions as f64, "", Bar::AtLeast(10_000.0));
    figure(
        "s20",
        "jobs looked for in all three tiers (I1)",
        sum.whereabouts as f64,
        "",
        Bar::AtLeast(1_000.0),
    );
    figure("s20", "seeds in which an invariant broke", 0.0, "", Bar::Exactly(0.0));
}

/// 25, joining: a node that joins in mid-run has its first job within 2 s, and gets its share (measured: its device time over 10 s
/// from its third second on, of its equals' mean). Applications need not allow stealing for it.
#[test]
fn s25_a_node_joins_in_mid_run() {
    let mut share = f64::INFINITY;
    let first_s = worst(|seed| {
        let mut world = farm(setup(seed, HALF_SPEED));
        world.run_for(seconds(5.0));
        let joined = world.now;
        world.fault(Fault::Join { speeds: vec![HALF_SPEED; 2] });
        world.run_for(seconds(13.0));
        let (from, to) = (joined.after(seconds(3.0)), world.now);
        let time = |count: &dyn Fn(&Run) -> bool| world.diary.busy(from, to, count).as_secs_f64();
        share = share.min(time(&|run| run.worker == 4) / (time(&|run| run.worker != 4) / 4.0));
        let first = world.diary.runs.iter().find(|run| run.worker == 4).map(|run| run.began);
        world.finish();
        assert!(all_delivered(&world) && each_ran_once(&world), "{}", world.describe());
        first.expect("it works").since(joined).as_secs_f64()
    });
    figure("s25", "the node's first job runs after", first_s, "s", Bar::AtMost(2.0));
    figure("s25", "its device time, of its equals'", share * 100.0, "%", Bar::AtLeast(95.0));
}

/// 25, draining: nothing is lost or executed again, and the process ends within the longest job that ran.
#[test]
fn s25_a_node_is_drained() {
    let mut again = 0;
    let exits_s = worst(|seed| {
        let mut world = farm(setup(seed, HALF_SPEED));
        world.run_for(seconds(5.0));
        let drained = world.now;
        world.fault(Fault::Drain { worker: 1 });
        world.run_until(drained.after(RECOVERY), |world| !world.workers[1].is_up());
        let exits_s = world.now.since(drained).as_secs_f64();
        world.finish();
        assert!(all_delivered(&world), "{}", world.describe());
        again += world.diary.executed_again();
        exits_s
    });
    figure("s25", "the drained process ends after", exits_s, "s", Bar::AtMost(LONGEST_S));
    count("s25", "executed again", again, Bar::Exactly(0.0));
}

/// 25, both, 20 times while work goes on: nothing is kept of those that went (I8: `finish` looks into every machine).
#[test]
fn s25_nodes_come_and_go_twenty_times() {
    let (mut again, mut nodes) = (0, BTreeSet::new());
    for seed in SEEDS {
        let mut world = farm(setup(seed, HALF_SPEED));
        world.run_for(seconds(3.0));
        for round in 0..20 {
            world.fault(Fault::Drain { worker: round });
            world.fault(Fault::Join { speeds: vec![HALF_SPEED; 2] });
            world.run_for(seconds(1.5));
        }
        world.run_until(Instant::ZERO.after(RECOVERY), |world: &World| {
            world.apps.iter().all(|app| app.is_done())
        });
        world.finish();
        assert!(all_delivered(&world), "{}", world.describe());
        again += world.diary.executed_again();
        let status = world.coordinator.status();
        assert!(status.nodes.iter().all(|node| node.state == NodeState::Alive), "{}", world.describe());
        nodes.insert(status.nodes.len());
        let up: Vec<&WorkerHost> = world.workers.iter().filter(|worker| worker.is_up()).collect();
        assert_eq!(up.len(), 4, "the others ended by themselves");
        up.into_iter().for_each(WorkerHost::assert_empty);
    }
    count(
        "s25",
        "20 nodes more and 20 less: nodes at the end",
        nodes.into_iter().max().unwrap_or(0),
        Bar::Exactly(4.0),
    );
    count("s25", "20 nodes more and 20 less: executed again", again, Bar::Exactly(0.0));
}
