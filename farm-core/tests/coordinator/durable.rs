//! What a coordinator knows still of what an earlier one learnt.

use std::time::Duration;

use farm_core::{coordinator::durable::Keep, id::JobAttempt, message::JobFailure, time::Instant};

use crate::farm::{Farm, count};

#[test]
fn a_stopped_application_stays_stopped_over_a_restart_until_its_time_is_over() {
    let mut farm = Farm::new("", &[]);
    farm.node_of_devices_joins(1, &[1_000.0; 8]);
    farm.node_of_devices_joins(2, &[1_000.0; 8]);
    let planned = farm.plan(&[10; 32], 1, &[]);
    let of = |node: u64| planned[&node].iter().take(4).map(move |&job| (node, job));
    for (node, job) in of(1).chain(of(2)) {
        farm.failed(node, job, JobFailure::Timeout);
    }
    assert_eq!(farm.stopped.len(), 1, "eight crashes stop it");
    let reason = farm.stopped[0].clone();

    farm.coordinator_restarts();
    farm.node_joins(3, 1_000.0);
    assert!(farm.plan(&[10], 1, &[]).is_empty(), "the successor gives it nothing");
    assert_eq!(farm.stopped, [reason], "and says why");
    farm.now = farm.now.after(Duration::from_secs(60));
    assert_eq!(farm.plan(&[10], 1, &[]).len(), 1, "it may try again");
}

/// Two nodes that announce the same, of which the first takes a quarter of the second's time.
fn unequal_farm() -> Farm {
    let mut farm = Farm::new("", &[1_000.0, 1_000.0]);
    for _ in 0..8 {
        let planned = farm.plan(&[10; 8], 1, &[]);
        for (&node, jobs) in &planned {
            farm.done(node, jobs, |_: JobAttempt| if node == 1 { 5 } else { 20 });
        }
    }
    farm
}

#[test]
fn the_first_plan_after_a_restart_goes_by_what_devices_were_worth() {
    let mut farm = unequal_farm();
    let learnt = farm.kept.iter().filter(|keep| matches!(keep, Keep::Speeds(_))).count();
    assert!((2..=16).contains(&learnt), "each node's at least once, not with every job: {learnt}");
    farm.now = Instant::ZERO;
    farm.coordinator_restarts();
    farm.node_joins(1, 1_000.0);
    farm.node_joins(2, 1_000.0);
    let planned = farm.plan(&[10; 100], 1, &[]);
    assert!((75..=85).contains(&count(&planned, 1)), "four fifths, not half: {}", count(&planned, 1));
}

#[test]
fn another_device_under_the_same_name_begins_anew() {
    let mut farm = unequal_farm();
    farm.now = Instant::ZERO;
    farm.coordinator_restarts();
    // Slots with other cards of the same maker's name: a tenth of the score.
    farm.node_joins(1, 100.0);
    farm.node_joins(2, 100.0);
    let planned = farm.plan(&[10; 100], 1, &[]);
    assert_eq!(count(&planned, 1), 50, "by their scores alone");
}

#[test]
fn a_node_that_starts_anew_is_worth_what_it_was() {
    let mut farm = unequal_farm();
    farm.leaves(1);
    farm.node_joins(1, 1_000.0);
    let planned = farm.plan(&[10; 100], 1, &[]);
    assert!((70..=85).contains(&count(&planned, 1)), "{}", count(&planned, 1));
}
