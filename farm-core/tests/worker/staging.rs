//! Which job goes to which device, and which waits: stealing between siblings, priorities, latency classes.

use farm_core::{
    id::{JobAttempt, StealId},
    message::{CoordinatorToNode, LatencyClass, NodeToCoordinator, Priority},
    worker::Event,
};

use crate::node::Node;

use LatencyClass::{Batch, Interactive};

fn given(orders: &[(bool, u16, JobAttempt)]) -> Vec<(u16, JobAttempt)> {
    orders.iter().filter(|(given, ..)| *given).map(|&(_, device, job)| (device, job)).collect()
}

#[test]
fn an_idle_device_takes_queued_jobs_of_a_sibling_unless_stealing_is_off() {
    for stealing in [true, false] {
        let mut node = Node::new(2, stealing, 1);
        node.jobs(1, 0, 6, Batch);
        let to_sibling = given(&node.orders()).iter().filter(|(device, _)| *device == 1).count();
        assert_eq!(to_sibling > 0, stealing, "jobs on the sibling: {to_sibling}");
    }
}

#[test]
fn an_idle_device_takes_what_is_only_staged_on_a_sibling() {
    let mut node = Node::new(2, true, 1);
    node.jobs(1, 0, 3, Batch);
    let first = given(&node.orders());
    let staged =
        first.iter().find(|(device, job)| first.iter().any(|(on, other)| on == device && other < job));
    let &(owner, waiting) = staged.expect("three jobs on two devices: one is staged");
    for &(device, job) in first.iter().filter(|(_, job)| *job != waiting) {
        node.started(job, device);
    }
    node.pass_ms(5);
    let idle = 1 - owner;
    let (_, running) = *first.iter().find(|(device, _)| *device == idle).unwrap();
    node.done(running, idle);
    assert_eq!(
        node.orders(),
        [(false, owner, waiting), (true, idle, waiting)],
        "taken back there, given here"
    );
    node.cancelled(waiting, owner);
    node.started(waiting, idle);
    node.pass_ms(10);
    node.done(waiting, idle);
    node.pass_ms(10);
    node.machine.handle_timeout(node.now);
    node.tell(Event::AppLinkClosed { link: farm_core::id::LinkId(9) });
    let traces = node.said.iter().flat_map(|said| match said {
        NodeToCoordinator::Report { executed, .. } => executed.clone(),
        _ => Vec::new(),
    });
    let done: Vec<_> = traces.filter(|done| done.job == waiting).collect();
    assert_eq!(done.len(), 1, "once");
    let from = done[0].trace.stolen_from.map(|from| from.0);
    assert_eq!((done[0].device.0, from), (idle, Some(owner)), "the report says where it came from");
}

#[test]
fn what_a_sibling_ends_sooner_stays_there() {
    let mut node = Node::new(2, true, 1);
    node.jobs(1, 0, 3, Batch);
    let first = given(&node.orders());
    let &(owner, waiting) = first
        .iter()
        .find(|(device, job)| first.iter().any(|(on, other)| on == device && other < job))
        .unwrap();
    for &(device, job) in first.iter().filter(|(_, job)| *job != waiting) {
        node.started(job, device);
    }
    // The owner's job is all but done: the staged one starts there at once.
    node.pass_ms(10);
    let idle = 1 - owner;
    let (_, running) = *first.iter().find(|(device, _)| *device == idle).unwrap();
    node.done(running, idle);
    assert!(node.orders().is_empty(), "moving it would gain nothing");
}

#[test]
fn larger_priorities_go_first_and_equal_ones_in_order() {
    let mut node = Node::new(1, true, 1);
    let jobs = node.tickets(1, 0, 5, Batch, |nth| Priority(i32::from(nth == 3)));
    let mut order = Vec::new();
    loop {
        let handed = given(&node.orders());
        order.extend(handed.iter().map(|(_, job)| *job));
        let Some(&next) = order.get(order.len().saturating_sub(handed.len())) else { break };
        if handed.is_empty() {
            break;
        }
        node.started(next, 0);
        node.done(next, 0);
    }
    assert_eq!(order[0], jobs[3], "the one of priority 1 is first: all arrived together");
    assert!(order[1..].is_sorted(), "the others first come, first served: {order:?}");
}

#[test]
fn an_interactive_job_is_handed_over_beside_a_running_and_a_staged_one() {
    let mut node = Node::new(1, true, 2);
    let batch = node.jobs(1, 0, 4, Batch);
    node.started(batch[0], 0);
    assert_eq!(given(&node.orders()).len(), 2, "one runs, one is staged");
    let urgent = node.jobs(2, 0, 2, Interactive);
    assert_eq!(given(&node.orders()), [(0, urgent[0])], "one more place, for one of them");
    let device = farm_core::id::DeviceIndex(0);
    node.tell(Event::Yielded { job: batch[0], device });
    node.started(urgent[0], 0);
    node.pass_ms(1);
    node.done(urgent[0], 0);
    assert_eq!(given(&node.orders()), [(0, urgent[1])], "the next one before staged batch jobs");
}

#[test]
fn an_interrupted_job_has_begun_and_is_not_given_up() {
    let mut node = Node::new(1, true, 2);
    let batch = node.jobs(1, 0, 2, Batch);
    node.started(batch[0], 0);
    let urgent = node.jobs(2, 0, 1, Interactive);
    node.tell(Event::Yielded { job: batch[0], device: farm_core::id::DeviceIndex(0) });
    node.started(urgent[0], 0);
    let order = CoordinatorToNode::Retract { steal: StealId(1), jobs: batch.clone() };
    node.tell(Event::FromCoordinator(order));
    let answer = node.said.iter().rev().find_map(|said| match said {
        NodeToCoordinator::Retracted { retracted, running, .. } => Some((retracted.clone(), running.clone())),
        _ => None,
    });
    assert_eq!(
        answer,
        Some((vec![batch[1]], vec![batch[0]])),
        "the staged one goes, the interrupted one stays"
    );
}

#[test]
fn class_says_when_not_how_much() {
    // Two applications of equal weight, one of them interactive and never out of jobs.
    let mut node = Node::new(1, true, 2);
    node.jobs(1, 0, 300, Batch);
    node.jobs(2, 0, 300, Interactive);
    let mut received = [0_u32; 2];
    let mut on_device: Vec<JobAttempt> = given(&node.orders()).into_iter().map(|(_, job)| job).collect();
    for _ in 0..300 {
        // Whatever is interactive runs first, as the executor would have it.
        let next = on_device.iter().position(|job| job.job.app.0 == 2).unwrap_or(0);
        let job = on_device.remove(next);
        node.started(job, 0);
        node.pass_ms(10);
        node.done(job, 0);
        received[usize::try_from(job.job.app.0 - 1).unwrap()] += 1;
        on_device.extend(given(&node.orders()).into_iter().map(|(_, job)| job));
    }
    assert!(
        received[0].abs_diff(received[1]) <= 10,
        "both get half, within five largest jobs each: {received:?}"
    );
}
