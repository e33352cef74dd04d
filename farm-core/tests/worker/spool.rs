//! Results that nobody takes: they cost their application its turn, and nobody else anything.

use farm_core::{
    id::{ContentHash, DeviceIndex, JobAttempt},
    message::LatencyClass,
    project::AppTerms,
    worker::Event,
};

use crate::node::Node;

/// Bytes of a result; the node's quota holds one, not two.
const RESULT_BYTES: u64 = 600;

/// Runs what the one device has until it gets nothing more; gives what ran, in order.
fn run_all(node: &mut Node, bytes: u64) -> Vec<JobAttempt> {
    let mut ran = Vec::new();
    loop {
        let orders = node.orders();
        if orders.is_empty() {
            return ran;
        }
        for (_, device, job) in orders {
            node.pass_ms(10);
            node.started(job, device);
            node.done_with(job, device, bytes);
            ran.push(job);
        }
    }
}

#[test]
fn an_application_that_takes_no_results_is_held_back_and_others_are_not() {
    let mut node = Node::new(1, true, 2);
    let deaf = node.jobs(1, 0, 20, LatencyClass::Batch);
    let ran = run_all(&mut node, RESULT_BYTES);
    assert_eq!(ran, deaf[..3], "two fill the quota, one was staged by then");
    let other = node.jobs(2, 0, 20, LatencyClass::Interactive);
    assert_eq!(run_all(&mut node, 0), other, "the device is the other's");
    other.into_iter().for_each(|job| node.acknowledge(job));

    node.acknowledge(deaf[0]);
    assert!(node.orders().is_empty(), "two are still there");
    node.acknowledge(deaf[1]);
    assert_eq!(run_all(&mut node, RESULT_BYTES), deaf[3..5], "room for one, and one was staged by then");
    let mut acknowledged = 2;
    let mut seen = 5;
    while acknowledged < seen {
        node.acknowledge(deaf[acknowledged]);
        acknowledged += 1;
        seen += run_all(&mut node, RESULT_BYTES).len();
    }
    assert_eq!((seen, node.machine.held_jobs()), (20, 0), "nothing is lost");
}

#[test]
fn while_the_spool_is_full_only_who_takes_results_gets_on() {
    let mut node = Node::new(1, true, 2);
    let slow = node.jobs(1, 0, 5, LatencyClass::Batch);
    let ran = run_all(&mut node, 10);
    assert_eq!(ran, slow, "50 B of 1,000");
    node.tell(Event::SpoolFull(true));
    let (slow, quick) = (node.jobs(1, 0, 5, LatencyClass::Batch), node.jobs(2, 0, 3, LatencyClass::Batch));
    assert_eq!(run_all(&mut node, 10), quick[..2], "one, and one was staged by then; none of the other's");
    quick[..2].iter().for_each(|job| node.acknowledge(*job));
    assert_eq!(run_all(&mut node, 10), quick[2..], "it took its results");
    assert!(node.orders().is_empty(), "the other still owes acknowledgements");
    node.tell(Event::SpoolFull(false));
    assert_eq!(run_all(&mut node, 10), slow, "there is room again");
}

#[test]
fn a_result_belongs_to_the_device_that_the_machine_waits_for() {
    let mut node = Node::new(2, true, 1);
    let [job] = node.jobs(1, 0, 1, LatencyClass::Batch)[..] else { panic!("one was asked for") };
    let [(_, device, _)] = node.orders()[..] else { panic!("it is staged at once") };
    node.started(job, device);
    let (here, other) = (DeviceIndex(device), DeviceIndex(1 - device));
    node.tell(Event::Executed {
        job,
        device: other,
        device_time_ns: 1,
        outcome: Ok((vec![4], ContentHash([9; 32]))),
    });
    assert_eq!(node.machine.executed_on(job), None, "another device's bytes are nobody's");
    node.done_with(job, device, 10);
    node.tell(Event::Executed {
        job,
        device: other,
        device_time_ns: 1,
        outcome: Ok((vec![4], ContentHash([9; 32]))),
    });
    assert_eq!(node.machine.executed_on(job), Some(here));
    node.acknowledge(job);
    assert_eq!(node.machine.executed_on(job), None, "it is over");
}

#[test]
fn a_result_that_the_driver_lost_is_made_again() {
    let mut node = Node::new(1, true, 2);
    let [first, second] = node.jobs(1, 0, 2, LatencyClass::Batch)[..] else { panic!("two were asked for") };
    run_all(&mut node, 10);
    node.tell(Event::ResultLost(first));
    node.tell(Event::ResultLost(first));
    assert_eq!(node.machine.held_jobs(), 1, "it is the coordinator's again");
    node.acknowledge(second);
    node.tell(Event::ResultLost(second));
    assert_eq!(node.machine.held_jobs(), 0, "what is over stays over");
}

#[test]
fn a_project_that_leaves_too_much_behind_is_held_back_as_a_whole() {
    let mut node = Node::new(1, true, 3);
    for app in [1, 2] {
        let terms =
            AppTerms { project: "films".to_owned(), result_bytes: Some(500), ..AppTerms::unlimited(1.0) };
        node.joined(app, terms);
    }
    let one = node.jobs(1, 0, 5, LatencyClass::Batch);
    let ran = run_all(&mut node, RESULT_BYTES);
    assert_eq!(ran, one[..2], "one is over the project's quota, one was staged by then");
    let sibling = node.jobs(2, 0, 3, LatencyClass::Batch);
    assert!(node.orders().is_empty(), "nor does the other one of the project get on");
    let stranger = node.jobs(3, 0, 3, LatencyClass::Batch);
    assert_eq!(run_all(&mut node, 0), stranger, "who is of another does");
    ran.into_iter().for_each(|job| node.acknowledge(job));
    let mut left: usize = one.len() - 2 + sibling.len();
    while left > 0 {
        let ran = run_all(&mut node, RESULT_BYTES);
        assert!(!ran.is_empty(), "{left} jobs are stuck");
        left -= ran.len();
        ran.into_iter().for_each(|job| node.acknowledge(job));
    }
}

#[test]
fn an_application_that_stays_is_not_spread_over_siblings() {
    let mut node = Node::new(2, true, 1);
    let terms = AppTerms { stays: true, ..AppTerms::unlimited(1.0) };
    node.joined(1, terms);
    node.jobs(1, 0, 6, LatencyClass::Batch);
    assert!(node.orders().iter().all(|(_, device, _)| *device == 0), "device 1 is idle, and stays so");
    let terms = AppTerms::unlimited(1.0);
    node.joined(1, terms);
    node.pass_ms(10);
    assert!(node.orders().iter().any(|(_, device, _)| *device == 1), "the quota was lifted");
}

/// The review of 2026-11-29: a quota that is lifted, or an application that moves on, lets those who stay get on.
#[test]
fn who_was_held_back_by_the_project_gets_on_when_the_quota_or_the_culprit_goes() {
    let of = |project: &str, result_bytes| AppTerms {
        project: project.to_owned(),
        result_bytes,
        ..AppTerms::unlimited(1.0)
    };
    let full = || {
        let mut node = Node::new(1, true, 2);
        node.joined(1, of("films", Some(500)));
        node.joined(2, of("films", Some(500)));
        node.jobs(1, 0, 2, LatencyClass::Batch);
        assert_eq!(run_all(&mut node, RESULT_BYTES).len(), 2);
        let waits = node.jobs(2, 0, 3, LatencyClass::Batch);
        assert!(node.orders().is_empty());
        (node, waits)
    };
    let (mut node, waits) = full();
    node.joined(1, of("films", None));
    assert_eq!(run_all(&mut node, 0), waits, "the quota is lifted for both");
    let (mut node, waits) = full();
    node.joined(1, of("ads", Some(5_000)));
    assert_eq!(run_all(&mut node, 0), waits, "what the first left behind is another project's");
}

#[test]
fn with_a_quota_of_nothing_one_result_waits_at_a_time() {
    let mut node = Node::new(1, true, 1);
    let terms = AppTerms { result_bytes: Some(0), ..AppTerms::unlimited(1.0) };
    node.joined(1, terms);
    let jobs = node.jobs(1, 0, 4, LatencyClass::Batch);
    assert_eq!(run_all(&mut node, 10), jobs[..2], "and one that was staged by then");
}

/// The review of 2026-11-29: a project may be called anything, and strangers are of none.
#[test]
fn applications_that_nobody_vouched_for_are_of_no_project() {
    let mut node = Node::new(1, true, 1);
    node.joined(1, AppTerms { project: String::new(), result_bytes: Some(1), ..AppTerms::unlimited(1.0) });
    node.hello(2);
    let jobs = node.jobs(2, 0, 3, LatencyClass::Batch);
    assert_eq!(run_all(&mut node, 10), jobs);
}
