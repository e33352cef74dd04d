//! The coordinator that dies, or is cut off: scenarios 4, 5 and 14.

use farm_core::{id::TaskId, time::Instant};
use tests::sim::{
    faults::Fault,
    network::Proc,
    world::{Setup, World},
};

use super::{
    alarms::errors_logged_while,
    farm::{HALF_SPEED, SPEED, app_id, farm, part, seconds, setup, submit, used, worst},
    figures::{Bar, count, figure},
};
use crate::all_delivered;

/// 4: the coordinator is killed and comes back after 5 s: nothing is executed again, nothing lost; during the outage the devices
/// do at least 95 % of what they did before; the epoch is one larger, and no application's id is given to another.
#[test]
fn s04_the_coordinator_dies_and_comes_back_after_5_s() {
    let (mut again, mut least) = (0, f64::INFINITY);
    let mut epochs = Vec::new();
    for seed in super::farm::SEEDS {
        let mut world = farm(setup(seed, SPEED));
        world.run_for(seconds(8.0));
        let (died, epoch) = (world.now, world.coordinator.status().epoch.0);
        world.fault(Fault::KillCoordinator { restart: seconds(5.0) });
        world.run_for(seconds(5.0));
        let before = used(&world, Instant::ZERO.after(seconds(3.0)), died);
        least = least.min(used(&world, died, world.now) / before);
        world.run_for(seconds(1.0));
        epochs.push(world.coordinator.status().epoch.0 - epoch);
        let ids = [0, 1, 2].map(|app| app_id(&world, app));
        let late = world.add_app();
        world.submit(15_000, late, 0, 10);
        world.finish();
        assert!(all_delivered(&world), "{}", world.describe());
        assert!(!ids.contains(&app_id(&world, late)), "an id is given twice");
        again += world.diary.executed_again();
    }
    figure("s04", "device time during the outage, of that before", least * 100.0, "%", Bar::AtLeast(95.0));
    count("s04", "executed again", again, Bar::Exactly(0.0));
    let by_one = epochs.iter().filter(|step| **step == 1).count();
    count("s04", "epochs that grew by one, of 2", by_one, Bar::Exactly(2.0));
}

/// 5: the coordinator is down for 60 s while all queues drain: what applications submit meanwhile waits, and goes on within 2 s
/// after the restart (measured: until the first of it runs); nothing is lost or executed again.
#[test]
fn s05_the_coordinator_is_away_for_60_s_while_queues_drain() {
    let (mut again, mut waited) = (0, 0);
    let resumed_s = worst(|seed| {
        let mut world = World::new(setup(seed, SPEED));
        (0..3).for_each(|app| world.submit(100, app, 0, 100));
        (0..3).for_each(|app| world.submit(30_000, app, 1, 100));
        world.run_for(seconds(2.0));
        world.fault(Fault::KillCoordinator { restart: seconds(60.0) });
        world.run_for(seconds(59.9));
        let drained = world.apps.iter().all(|app| app.endings.len() == 100);
        assert!(drained, "queues drain without a coordinator: {}", world.describe());
        waited += world.apps.iter().map(|app| app.ledger.counts().waiting_jobs).sum::<u64>();
        let restart = world.now.after(seconds(0.1));
        world.finish();
        assert!(all_delivered(&world), "{}", world.describe());
        again += world.diary.executed_again();
        let second = world.diary.runs.iter().filter(|run| run.job.job.task == TaskId(1));
        second.map(|run| run.began).min().expect("they run").since(restart).as_secs_f64()
    });
    figure("s05", "jobs that their ledgers hold as waiting, of 600", waited as f64, "", Bar::Exactly(600.0));
    figure("s05", "the first of them runs after the restart within", resumed_s, "s", Bar::AtMost(2.0));
    count("s05", "executed again", again, Bar::Exactly(0.0));
}

/// 14: the coordinator is cut off from more than 55 % of its nodes for 15 s: no job is planned anew, there is an alarm, and when
/// it is over nothing is executed again. Nodes' heartbeats are not at the same instant: they joined one after the other.
#[test]
fn s14_the_coordinator_is_cut_off_from_most_nodes() {
    for (cut_off, nodes) in [(5, 8), (4, 4)] {
        let (mut replanned, mut again, mut alarms) = (0, 0, usize::MAX);
        for seed in super::farm::SEEDS {
            let mut world = World::new(Setup::designed(seed, vec![vec![HALF_SPEED; 8 / nodes]], 3));
            for node in 1..nodes {
                world.run_for(seconds(0.13));
                world.fault(Fault::Join { speeds: vec![HALF_SPEED; 8 / nodes] });
                assert_eq!(world.workers.len(), node + 1, "one more");
            }
            submit(&mut world, 0);
            world.run_for(seconds(4.0));
            for worker in nodes - cut_off..nodes {
                part(&mut world, Proc::Worker(worker), Proc::Coordinator, seconds(15.0));
            }
            let before = world.coordinator.status().replanned_jobs;
            alarms = alarms.min(errors_logged_while(|| world.run_for(seconds(14.9))));
            replanned += world.coordinator.status().replanned_jobs - before;
            world.finish();
            assert!(all_delivered(&world), "{}", world.describe());
            again += world.diary.executed_again();
        }
        let of = format!("{cut_off} of {nodes}");
        figure("s14", &format!("{of}: jobs planned anew meanwhile"), replanned as f64, "", Bar::Exactly(0.0));
        count("s14", &format!("{of}: alarms, the quietest seed"), alarms, Bar::AtLeast(1.0));
        count("s14", &format!("{of}: executed again"), again, Bar::Exactly(0.0));
    }
}
