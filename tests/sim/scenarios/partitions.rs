//! Partitions of two tiers each: scenarios 10, 11, 12 and 13.

use std::collections::BTreeSet;

use farm_core::{
    coordinator::NodeState,
    id::{JobAttempt, JobId},
    time::Instant,
};
use tests::sim::{
    faults::{Fault, keepalive},
    network::Proc,
    world::World,
};

use super::{
    farm::{
        HALF_SPEED, LEASE_S, after, app_id, farm, is_alive, node, part, reruns_of_delivered, seconds, setup,
        undelivered_on, worst,
    },
    figures::{Bar, count, figure},
};
use crate::all_delivered;

const HEARTBEAT_S: f64 = 1.0;

/// 10: a worker and the coordinator cannot reach each other for three leases. Each result exactly once; duplicates are at most
/// the jobs on that node; it rejoins with the process that it was.
#[test]
fn s10_a_worker_is_parted_from_the_coordinator_for_three_leases() {
    let (mut again, mut on_it, mut rejoined) = (0, 0, 0);
    let excess = worst(|seed| {
        let mut world = farm(setup(seed, HALF_SPEED));
        world.run_for(seconds(5.0));
        let undelivered = undelivered_on(&world, 1).len();
        part(&mut world, Proc::Worker(1), Proc::Coordinator, seconds(3.0 * LEASE_S));
        world.run_for(seconds(3.0 * LEASE_S - 1.0));
        assert!(node(&world, 1).is_none(), "it is given up meanwhile");
        world.run_for(seconds(2.0));
        rejoined += usize::from(is_alive(&world, 1));
        let back = world.now;
        world.finish();
        assert!(all_delivered(&world), "{}", world.describe());
        assert!(world.diary.runs.iter().any(|run| run.worker == 1 && run.began > back), "it works again");
        again += world.diary.executed_again();
        on_it += undelivered;
        world.diary.executed_again() as f64 - undelivered as f64
    });
    count("s10", "rejoined 1 s after the heal, without a restart, of 2", rejoined, Bar::Exactly(2.0));
    count("s10", &format!("executed again, of {on_it} jobs on the node"), again, Bar::AtMost(on_it as f64));
    figure("s10", "executed again beyond the jobs on the node, any seed", excess, "", Bar::AtMost(0.0));
}

/// What a one-way partition of worker 1 and the coordinator looks like from the coordinator.
struct OneWay {
    suspect_s: f64,
    healed_s: f64,
    registrations: usize,
    again: usize,
}

/// Lets one direction be cut; the keepalives give the connection up as real ones do.
fn one_way(seed: u64, (from, to): (Proc, Proc), cut_s: f64) -> OneWay {
    let mut world = farm(setup(seed, HALF_SPEED));
    world.run_for(seconds(5.0));
    let cut = world.now;
    world.fault(Fault::Partition { from, to, duration: seconds(cut_s) });
    let patience = keepalive(from, to);
    if seconds(cut_s) > patience {
        after(&mut world, patience, Fault::TimeOut { one: from, other: to });
    }
    world.run_until(cut.after(seconds(cut_s)), |world| !is_alive(world, 1));
    let suspect_s = world.now.since(cut).as_secs_f64();
    world.run_for(seconds(cut_s) - world.now.since(cut));
    let healed = world.now;
    world.run_until(healed.after(seconds(30.0)), |world| is_alive(world, 1));
    let healed_s = world.now.since(healed).as_secs_f64();
    world.finish();
    assert!(all_delivered(&world), "{}", world.describe());
    let registrations = world.diary.registrations.iter().filter(|(_, worker)| *worker == 1).count();
    OneWay { suspect_s, healed_s, registrations, again: world.diary.executed_again() }
}

/// 11: nothing gets through from a worker to the coordinator, or the other way, for 8 s (less than a lease) or 25 s: the node is
/// suspect within 3 heartbeats, registers at most twice, and is alive within 2 heartbeats after the repair. Of the other way the
/// coordinator has no sign of its own: the worker, whose heartbeats are not answered, says so with them.
#[test]
fn s11_a_one_way_partition_of_worker_and_coordinator() {
    let (worker, coordinator) = (Proc::Worker(1), Proc::Coordinator);
    for (way, direction, cut_s, suspect) in [
        ("worker unheard for 8 s", (worker, coordinator), 8.0, Bar::AtMost(3.0 * HEARTBEAT_S)),
        ("worker unheard for 25 s", (worker, coordinator), 25.0, Bar::AtMost(3.0 * HEARTBEAT_S)),
        ("coordinator unheard for 8 s", (coordinator, worker), 8.0, Bar::AtMost(3.0 * HEARTBEAT_S)),
        ("coordinator unheard for 25 s", (coordinator, worker), 25.0, Bar::AtMost(3.0 * HEARTBEAT_S)),
    ] {
        let (mut healed_s, mut registrations, mut again) = (0.0_f64, 0, 0);
        let suspect_s = worst(|seed| {
            let seen = one_way(seed, direction, cut_s);
            healed_s = healed_s.max(seen.healed_s);
            registrations = registrations.max(seen.registrations);
            again = again.max(seen.again);
            seen.suspect_s
        });
        figure("s11", &format!("{way}: suspect after"), suspect_s, "s", suspect);
        count("s11", &format!("{way}: registrations"), registrations, Bar::AtMost(2.0));
        figure(
            "s11",
            &format!("{way}: alive after the repair within"),
            healed_s,
            "s",
            Bar::AtMost(2.0 * HEARTBEAT_S),
        );
        println!("s11  {way}: {again} executions more, of 2,000");
    }
}

/// The jobs of an application that are on worker 1.
fn of_app_on_1(world: &World, app: usize) -> BTreeSet<JobId> {
    let app = app_id(world, app);
    undelivered_on(world, 1).into_iter().filter(|job| job.app == app).collect()
}

/// 12: a worker and one application cannot reach each other for 40 s; both know at once, or the cut is silent. The node stays
/// alive and works for the others; that application's jobs move off it within a lease; nothing that was delivered runs again.
#[test]
fn s12_a_worker_is_parted_from_one_application() {
    for how in ["refused", "silent"] {
        let (mut alive, mut for_others) = (0, usize::MAX);
        let (mut reruns, mut kept) = (0, 0);
        let moved_s = worst(|seed| {
            let mut world = farm(setup(seed, HALF_SPEED));
            world.run_for(seconds(5.0));
            let cut = world.now;
            assert!(!of_app_on_1(&world, 1).is_empty(), "it has jobs there");
            if how == "silent" {
                part(&mut world, Proc::Worker(1), Proc::App(1), seconds(40.0));
            } else {
                world.fault(Fault::Cut { app: 1, worker: 1 });
                after(&mut world, seconds(40.0), Fault::Mend { app: 1, worker: 1 });
            }
            world.run_until(cut.after(seconds(40.0)), |world| of_app_on_1(world, 1).is_empty());
            let moved_s = world.now.since(cut).as_secs_f64();
            world.run_for(seconds(39.0) - world.now.since(cut));
            alive += usize::from(node(&world, 1).is_some_and(|node| node.state == NodeState::Alive));
            let app = app_id(&world, 1);
            let others =
                |run: &&tests::sim::diary::Run| run.worker == 1 && run.began > cut && run.job.job.app != app;
            for_others = for_others.min(world.diary.runs.iter().filter(others).count());
            world.finish();
            assert!(all_delivered(&world), "{}", world.describe());
            reruns += reruns_of_delivered(&world);
            kept += world.workers[1].spooled_bytes(app);
            moved_s
        });
        figure("s12", &format!("{how}: the last job has moved after"), moved_s, "s", Bar::AtMost(LEASE_S));
        count("s12", &format!("{how}: node alive throughout, of 2"), alive, Bar::Exactly(2.0));
        count("s12", &format!("{how}: runs for the others there, fewest"), for_others, Bar::AtLeast(50.0));
        count("s12", &format!("{how}: reruns of what was delivered"), reruns, Bar::Exactly(0.0));
        figure(
            "s12",
            &format!("{how}: bytes of its results kept at the end"),
            kept as f64,
            "B",
            Bar::Exactly(0.0),
        );
    }
}

/// 12, shorter: a silent cut of 5 s. What the worker kept for the application meanwhile arrives after it, and nothing runs again.
#[test]
fn s12_results_outlast_a_short_cut() {
    let (mut again, mut fewest) = (0, usize::MAX);
    for seed in super::farm::SEEDS {
        let mut world = farm(setup(seed, HALF_SPEED));
        world.run_for(seconds(5.0));
        let (cut, app) = (world.now, app_id(&world, 1));
        part(&mut world, Proc::Worker(1), Proc::App(1), seconds(5.0));
        world.run_for(seconds(5.1));
        let healed = cut.after(seconds(5.0));
        world.finish();
        assert!(all_delivered(&world), "{}", world.describe());
        again += world.diary.executed_again();
        let ended_meanwhile = |run: &tests::sim::diary::Run| {
            let ended = run.ended.is_some_and(|ended| ended > cut && ended < healed);
            run.worker == 1 && run.job.job.app == app && ended
        };
        let kept: BTreeSet<JobAttempt> =
            world.diary.runs.iter().filter(|run| ended_meanwhile(run)).map(|run| run.job).collect();
        let late =
            world.diary.results.iter().filter(|result| result.at >= healed && kept.contains(&result.job));
        assert_eq!(late.count(), kept.len(), "each result that was kept arrives once");
        fewest = fewest.min(kept.len());
    }
    count(
        "s12",
        "silent, 5 s: results kept meanwhile that arrive after it, fewest",
        fewest,
        Bar::AtLeast(1.0),
    );
    count("s12", "silent, 5 s: executed again", again, Bar::Exactly(0.0));
}

/// 13: an application and the coordinator cannot reach each other for 20 s, less than the application's lease: what is planned
/// goes on (measured: device time of its jobs, of that without the cut), and nothing is cancelled or planned anew.
#[test]
fn s13_an_application_is_parted_from_the_coordinator_within_its_lease() {
    let (mut least, mut again, mut replanned) = (f64::INFINITY, 0, 0);
    for seed in super::farm::SEEDS {
        let mut world = farm(setup(seed, HALF_SPEED));
        world.run_for(seconds(5.0));
        let (cut, app) = (world.now, app_id(&world, 1));
        part(&mut world, Proc::App(1), Proc::Coordinator, seconds(20.0));
        world.run_for(seconds(19.9));
        let mut calm = farm(setup(seed, HALF_SPEED));
        calm.run_for(world.now.since(Instant::ZERO));
        let time = |world: &World| world.diary.busy_for(app, cut, world.now).as_secs_f64();
        least = least.min(time(&world) / time(&calm));
        world.finish();
        assert!(all_delivered(&world), "{}", world.describe());
        again += world.diary.executed_again();
        replanned += world.coordinator.status().replanned_jobs;
    }
    figure(
        "s13",
        "its device time during the cut, of that without it",
        least * 100.0,
        "%",
        Bar::AtLeast(95.0),
    );
    count("s13", "executed again", again, Bar::Exactly(0.0));
    figure("s13", "jobs planned anew", replanned as f64, "", Bar::Exactly(0.0));
}
