//! Results that nobody takes: they cost their application its turn, and nobody else anything.

use farm_core::{id::JobAttempt, message::LatencyClass};

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
