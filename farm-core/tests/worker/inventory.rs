//! What a node tells of what it holds.

use farm_core::{
    holding::Holding,
    id::{JobAttempt, LinkId},
    message::{AppToNode, CoordinatorToNode, LatencyClass, NodeToCoordinator},
    worker::Event,
};

use crate::node::Node;

fn app_says(node: &mut Node, message: AppToNode) {
    node.tell(Event::FromApp { link: LinkId(1), message });
}

fn holding(jobs: &[JobAttempt]) -> Holding {
    jobs.iter().copied().collect()
}

#[test]
fn the_coordinator_is_told_in_short_every_30_s_and_all_of_it_when_it_asks() {
    let mut node = Node::new(1, true, 2);
    let mut held = node.jobs(1, 0, 3, LatencyClass::Batch);
    held.extend(node.jobs(2, 0, 2, LatencyClass::Batch));
    node.said.clear();
    for _ in 0..61 {
        node.pass_ms(1_000);
        node.timers();
    }
    let told = node.said.iter().filter(|said| matches!(said, NodeToCoordinator::Holding(_)));
    assert_eq!(told.collect::<Vec<_>>(), [&NodeToCoordinator::Holding(holding(&held)); 2]);
    node.said.clear();
    node.tell(Event::FromCoordinator(CoordinatorToNode::SayInventory));
    assert_eq!(node.said, [NodeToCoordinator::Inventory(held)]);
}

#[test]
fn an_application_hears_of_its_own_where_it_thinks_otherwise() {
    let mut node = Node::new(1, true, 2);
    let held = node.jobs(1, 0, 3, LatencyClass::Batch);
    node.jobs(2, 0, 2, LatencyClass::Batch);
    app_says(&mut node, AppToNode::Holding(holding(&held)));
    assert_eq!(node.inventories, []);
    app_says(&mut node, AppToNode::Holding(holding(&held[1..])));
    assert_eq!(node.inventories, [(1, held)]);
}

#[test]
fn a_result_that_its_application_has_already_is_delivered() {
    let mut node = Node::new(1, true, 1);
    let held = node.jobs(1, 0, 2, LatencyClass::Batch);
    node.started(held[0], 0);
    node.done_with(held[0], 0, 8);
    node.said.clear();
    app_says(&mut node, AppToNode::Cancel(held.clone()));
    let delivered = node.said.iter().filter_map(|said| match said {
        NodeToCoordinator::Report { delivered, .. } => Some(delivered.clone()),
        _ => None,
    });
    assert_eq!(delivered.collect::<Vec<_>>().concat(), held[..1], "the other one was only cancelled");
    assert_eq!(node.machine.held_jobs(), 0);
}
