//! Farms in the simulator, each made to show one thing; many seeds of trouble; and the seeds that once found something.

mod regressions;
mod scenarios;
mod seeds;
mod steals;

use std::time::Duration;

use farm_core::{
    id::TaskId,
    id::{JobId, JobIndex},
    message::JobFailure,
    time::Instant,
};
use tests::sim::{
    faults::Fault,
    hosts::{Ending, WorkerHost},
    work::cost_ns,
    world::{Happening, MILLISECOND, RECOVERY, Setup, World},
};

fn all_delivered(world: &World) -> bool {
    world.apps.iter().all(|app| app.endings.values().all(|ending| matches!(ending, Ending::Delivered(_))))
}

fn each_ran_once(world: &World) -> bool {
    world.audit.executions().all(|(_, executions)| executions == 1)
}

fn calm(seed: u64) -> World {
    World::new(Setup::calm(seed, vec![vec![1.0, 2.0], vec![4.0], vec![0.5]], 2))
}

#[test]
fn a_calm_farm_delivers_every_job_once() {
    let mut world = calm(1);
    world.submit(0, 0, 0, 300);
    world.submit(5, 1, 1, 200);
    world.submit(50, 1, 2, 1);
    world.finish();
    assert!(all_delivered(&world), "{}", world.describe());
    assert!(each_ran_once(&world), "I5: nothing is executed twice without a fault");
    assert_eq!(world.apps.iter().map(|app| app.endings.len()).sum::<usize>(), 501, "all of them");
}

#[test]
fn unequal_devices_get_shares_by_their_speed() {
    let mut world = calm(2);
    world.submit(0, 0, 0, 1_500);
    let begin = world.now;
    let deadline = begin.after(RECOVERY);
    world.run_until(deadline, |world| world.apps[0].is_done());
    let work_ns: u64 = (0..1_500).map(|index| cost_ns(JobIndex(index))).sum();
    let speed = 1.0 + 2.0 + 4.0 + 0.5;
    let ratio = world.now.since(begin).as_secs_f64() * speed / (work_ns as f64 / 1e9);
    // Estimates are exact here, so the makespan is the lower bound plus one job and some latency on the slowest device.
    assert!(ratio < 1.05, "makespan is {ratio} of the bound");
}

#[test]
fn jobs_wait_for_the_first_node_and_say_so() {
    let mut world = World::new(Setup::calm(3, vec![], 1));
    world.submit(0, 0, 0, 10);
    world.run_for(Duration::from_millis(500));
    assert_eq!(world.apps[0].waits, 1, "told once");
    world.at(world.now, Happening::Fault(Fault::Join { speeds: vec![1.0] }));
    world.finish();
    assert!(all_delivered(&world), "{}", world.describe());
}

#[test]
fn a_killed_workers_jobs_run_elsewhere() {
    let mut world = calm(4);
    world.submit(0, 0, 0, 400);
    world.at(Instant(100 * MILLISECOND), Happening::Fault(Fault::Kill { worker: 1, restart: None }));
    world.finish();
    assert!(all_delivered(&world), "{}", world.describe());
    let replanned = world.apps[0].ledger.counts().replanned_jobs;
    assert!(replanned > 0, "the dead worker had jobs");
}

#[test]
fn a_drained_worker_leaves_without_a_second_execution() {
    for (seed, fault) in [(5, Fault::Drain { worker: 1 }), (6, Fault::Terminate { worker: 1 })] {
        let mut world = calm(seed);
        world.submit(0, 0, 0, 400);
        world.at(Instant(100 * MILLISECOND), Happening::Fault(fault));
        world.run_for(Duration::from_secs(1));
        assert!(!world.workers[1].is_up(), "the drained process ends by itself");
        world.finish();
        assert!(all_delivered(&world), "{}", world.describe());
        assert!(each_ran_once(&world), "0 re-executions");
    }
}

#[test]
fn poison_fails_alone_and_invalid_programs_fail_at_once() {
    let mut world = calm(7);
    world.work.poison.insert(TaskId(1));
    world.work.invalid.insert(TaskId(2));
    world.submit(0, 0, 0, 100);
    world.submit(0, 0, 1, 3);
    world.submit(0, 0, 2, 3);
    world.finish();
    for ((task, index), ending) in &world.apps[0].endings {
        let of_job = |job: &JobId| (job.task, job.index) == (*task, *index);
        let runs: u32 = world.audit.executions().filter(|(job, _)| of_job(job)).map(|(_, runs)| runs).sum();
        match (task.0, ending) {
            (0, Ending::Delivered(_)) => assert_eq!(runs, 1, "a healthy job"),
            (1, Ending::Failed(JobFailure::Poison(_))) => assert_eq!(runs, 3, "I10: poison runs three times"),
            (2, Ending::Failed(JobFailure::InvalidProgram(_))) => assert_eq!(runs, 1, "a wrong job"),
            (task, ending) => panic!("task {task} ended with {ending:?}"),
        }
    }
}

#[test]
fn a_new_coordinator_takes_the_farm_over() {
    let mut world = calm(8);
    world.submit(0, 0, 0, 400);
    world.submit(0, 1, 1, 100);
    world.run_for(Duration::from_millis(100));
    world.restart_coordinator();
    world.finish();
    assert!(all_delivered(&world), "{}", world.describe());
}

#[test]
fn an_application_that_vanishes_is_freed() {
    let mut world = calm(9);
    world.submit(0, 0, 0, 300);
    world.submit(0, 1, 1, 300);
    world.run_for(Duration::from_millis(100));
    world.vanish_app(1, None);
    world.run_for(Duration::from_secs(20));
    assert!(world.apps[0].is_done(), "the other one goes on");
    let apps = world.coordinator.status().apps;
    assert!(apps.len() == 1 && apps[0].name == "app-0", "{apps:?}");
    world.workers.iter().for_each(WorkerHost::assert_empty);
}
