//! Second attempts at the tail of a run: when they are made, and that one of the two always counts.

use std::{collections::BTreeMap, time::Duration};

use farm_core::{id::JobAttempt, message::JobFailure};

use crate::farm::{Farm, MILLISECOND_NS, count};

/// Two equal nodes that know the module; the first is at the last job, by all appearance ten times too long.
fn tail() -> (Farm, JobAttempt) {
    let mut farm = Farm::new("", &[1_000.0, 1_000.0]);
    for (node, jobs) in farm.plan(&[10; 8], 1, &[]) {
        farm.done(node, &jobs, |_| 10);
    }
    let planned = farm.plan(&[10], 1, &[]);
    let (&node, jobs) = planned.first_key_value().unwrap();
    assert_eq!((node, jobs.len()), (1, 1), "the one job is on the first node");
    (farm, jobs[0])
}

fn backup(farm: &mut Farm, first: JobAttempt) -> JobAttempt {
    farm.heartbeat(1, Some((first, 100 * MILLISECOND_NS)));
    let planned = farm.heartbeat(2, None);
    let [second] = planned[&2][..] else { panic!("no second attempt: {planned:?}") };
    assert!(farm.speculative, "said to be one");
    assert!(second.job == first.job && second.attempt > first.attempt, "{second} beside {first}");
    second
}

#[test]
fn a_straggler_runs_a_second_time_on_an_idle_device() {
    let (mut farm, first) = tail();
    backup(&mut farm, first);
    assert_eq!(farm.machine.status().speculations, 1);
    assert!(farm.heartbeat(2, None).is_empty(), "once");
}

#[test]
fn a_job_in_its_time_is_left_alone() {
    let (mut farm, first) = tail();
    farm.heartbeat(1, Some((first, 5 * MILLISECOND_NS)));
    assert!(farm.heartbeat(2, None).is_empty(), "it will end sooner than a second attempt");
}

#[test]
fn while_something_is_queued_nothing_runs_twice() {
    let (mut farm, first) = tail();
    farm.stop_taking(2);
    farm.plan(&[10; 3], 1, &[]);
    farm.heartbeat(1, Some((first, 100 * MILLISECOND_NS)));
    farm.node_joins(3, 1_000.0);
    assert!(!farm.speculative, "queued jobs move first");
    assert_eq!(farm.machine.status().speculations, 0);
}

#[test]
fn the_first_result_cancels_the_other_attempt() {
    for winner in [1, 2] {
        let (mut farm, first) = tail();
        let second = backup(&mut farm, first);
        let (won, lost) = if winner == 1 { (first, second) } else { (second, first) };
        farm.done(winner, &[won], |_| 10);
        assert_eq!(farm.cancelled, [(3 - winner, lost)], "the loser is told");
        let delivered = farm.machine.status().delivered_jobs;
        farm.done(3 - winner, &[lost], |_| 10);
        assert_eq!(farm.machine.status().delivered_jobs, delivered, "and counts for nothing");
        assert_eq!(farm.open_jobs(), 0);
    }
}

/// Seed 93593: the application had lost its link to the second node, and sought the job at the first one for ever.
#[test]
fn a_second_attempt_that_ends_first_is_told_to_be_the_one_that_counts() {
    let (mut farm, first) = tail();
    let second = backup(&mut farm, first);
    let told = farm.ended(2, second, 10);
    assert_eq!(told, BTreeMap::from([(2, vec![second])]));
    assert!(!farm.speculative, "it takes the first one's place");
}

#[test]
fn when_one_attempt_is_lost_the_other_goes_on() {
    // Its node leaves, or it fails with its device.
    for (lost, by_leaving) in [(1, true), (2, true), (1, false), (2, false)] {
        let (mut farm, first) = tail();
        let second = backup(&mut farm, first);
        let (gone, other) = if lost == 1 { (first, second) } else { (second, first) };
        let planned = if by_leaving {
            farm.leaves(lost)
        } else {
            farm.failed(lost, gone, JobFailure::DeviceLost("test".to_owned()))
        };
        assert_eq!(count(&planned, lost), 0, "no new attempt where it was lost");
        assert!(
            planned.values().flatten().all(|job| *job == other),
            "no third attempt while one runs: {planned:?}"
        );
        let node = 3 - lost;
        farm.done(node, &[other], |_| 10);
        assert_eq!(farm.open_jobs(), 0, "it is over with the one that was left");
    }
}

#[test]
fn when_both_attempts_are_lost_a_third_one_follows() {
    let (mut farm, first) = tail();
    backup(&mut farm, first);
    farm.node_joins(3, 1_000.0);
    farm.leaves(1);
    let planned = farm.leaves(2);
    assert_eq!(count(&planned, 3), 1, "on the node that is left");
    farm.now = farm.now.after(Duration::from_millis(1));
}

#[test]
fn an_application_that_comes_back_hears_of_second_attempts() {
    let (mut farm, first) = tail();
    let second = backup(&mut farm, first);
    let told = farm.app_comes_back();
    assert_eq!(
        (told.get(&1), told.get(&2)),
        (Some(&vec![first]), Some(&vec![second])),
        "or its result is lost"
    );
}
