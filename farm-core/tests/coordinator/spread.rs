//! How a large content gets to many nodes: once from the application, then from node to node.

use farm_core::{
    coordinator::Event,
    id::{ContentHash, LinkId},
    message::NodeToCoordinator,
    program::Content,
};

use crate::farm::Farm;

const LARGE: Content = Content { hash: ContentHash([2; 32]), size_bytes: 64 << 20 };

impl Farm {
    fn asks(&mut self, node: u64) -> Vec<(u64, Option<String>)> {
        self.node_says(node, NodeToCoordinator::Locate(LARGE))
    }

    fn has(&mut self, node: u64) -> Vec<(u64, Option<String>)> {
        self.node_says(node, NodeToCoordinator::CacheChanged { held: vec![LARGE], gone: Vec::new() })
    }

    fn lost_it(&mut self, node: u64) -> Vec<(u64, Option<String>)> {
        self.node_says(node, NodeToCoordinator::CacheChanged { held: Vec::new(), gone: vec![LARGE.hash] })
    }

    /// Gives who is sent where in answer.
    fn node_says(&mut self, node: u64, message: NodeToCoordinator) -> Vec<(u64, Option<String>)> {
        self.handle(Event::FromNode { link: LinkId(node), message });
        std::mem::take(&mut self.located)
    }
}

fn from(node: u64, peer: u64) -> (u64, Option<String>) {
    (node, Some(format!("node {peer}")))
}

#[test]
fn one_node_fetches_from_the_application_and_the_others_from_nodes() {
    let mut farm = Farm::new("", &[1_000.0; 8]);
    assert_eq!(farm.asks(1), [(1, None)]);
    for node in 2..=8 {
        assert_eq!(farm.asks(node), [], "node {node} waits");
    }
    assert_eq!(farm.has(1), [from(2, 1), from(3, 1), from(4, 1), from(5, 1)], "four at a time");
    assert_eq!(farm.has(2), [from(6, 2), from(7, 2), from(8, 2)], "the idlest source");
    assert_eq!(farm.asks(9), [], "a stranger is not answered");
}

#[test]
fn the_next_one_goes_to_the_application_when_the_first_does_not_get_on() {
    let mut farm = Farm::new("", &[1_000.0; 3]);
    farm.asks(1);
    farm.asks(2);
    farm.asks(3);
    farm.leaves(1);
    assert_eq!(std::mem::take(&mut farm.located), [(2, None)], "the first is gone");
    assert_eq!(farm.lost_it(2), [(3, None)], "the second needs it no more");
    let mut farm = Farm::new("", &[1_000.0; 3]);
    farm.asks(1);
    farm.asks(2);
    farm.asks(3);
    let mut sent = Vec::new();
    for second in 1..=11 {
        farm.advance_to_ms(second * 1_000);
        sent.extend(std::mem::take(&mut farm.located).into_iter().map(|(node, peer)| (second, node, peer)));
    }
    assert_eq!(sent, [(5, 2, None), (10, 3, None)], "each has waited long enough");
}

#[test]
fn two_peers_in_vain_and_it_is_the_application() {
    let mut farm = Farm::new("", &[1_000.0; 4]);
    for node in 1..=3 {
        farm.has(node);
    }
    assert_eq!(farm.asks(4), [from(4, 1)]);
    assert_eq!(farm.asks(4), [from(4, 2)], "the first did not have it");
    assert_eq!(farm.asks(4), [(4, None)]);
}

#[test]
fn a_node_whose_connection_is_gone_is_no_source() {
    let mut farm = Farm::new("", &[1_000.0; 2]);
    farm.has(1);
    farm.stop_taking(1);
    assert_eq!(farm.asks(2), [(2, None)]);
}
