//! Most nodes vanish at once: the fault is rather on the coordinator's side, and nothing is planned anew for a while.

use std::time::Duration;

use crate::farm::Farm;

/// Five nodes with a job each; the connections of some are gone, and the time that they had to come back is over.
fn vanished(nodes: u64) -> Farm {
    let mut farm = Farm::new("", &[1_000.0; 5]);
    assert_eq!(farm.plan(&[10; 5], 1, &[]).len(), 5, "a job each");
    for node in 1..=nodes {
        farm.stop_taking(node);
    }
    farm
}

#[test]
fn a_few_lost_nodes_are_replaced_when_their_time_is_over() {
    let mut farm = vanished(2);
    let planned = farm.wait_for_plan();
    assert_eq!(farm.now.0 / 1_000_000, 2_000, "the time to reconnect");
    assert_eq!(planned.values().map(Vec::len).sum::<usize>(), 2, "both jobs");
}

#[test]
fn most_of_a_farm_is_waited_for_once_more() {
    let mut farm = vanished(4);
    let planned = farm.wait_for_plan();
    assert_eq!(farm.now.0 / 1_000_000, 12_000, "and as long again as a node may be silent");
    assert_eq!(planned.values().map(Vec::len).sum::<usize>(), 4, "then they are gone indeed");
}

#[test]
fn nodes_that_vanish_one_after_the_other_are_waited_for_together() {
    let mut farm = vanished(1);
    for node in 2..=4 {
        farm.now = farm.now.after(Duration::from_millis(300));
        farm.stop_taking(node);
    }
    let planned = farm.wait_for_plan();
    assert_eq!(farm.now.0 / 1_000_000, 12_000, "the first was due after 2 s, and nothing was planned then");
    assert_eq!(planned.values().map(Vec::len).sum::<usize>(), 4, "then they are gone indeed");
}

#[test]
fn a_second_time_they_are_waited_for_again() {
    let mut farm = vanished(4);
    farm.advance_to_ms(3_000);
    for node in 1..=4 {
        farm.node_joins(node, 1_000.0);
    }
    // They came back with nothing, and have nothing later either, so what they had is planned anew.
    farm.advance_to_ms(13_000);
    assert_eq!(farm.asked, [1, 2, 3, 4]);
    assert_eq!((1..=4).map(|node| farm.inventory(node, &[]).len()).sum::<usize>(), 4);
    farm.advance_to_ms(60_000);
    for node in 1..=4 {
        farm.stop_taking(node);
    }
    farm.wait_for_plan();
    assert_eq!(
        farm.now.0 / 1_000_000,
        72_000,
        "the time to reconnect, and as long again as a node may be silent"
    );
}

#[test]
fn nodes_that_come_back_meanwhile_keep_their_jobs() {
    let mut farm = vanished(4);
    farm.advance_to_ms(3_000);
    for node in 1..=3 {
        farm.node_joins(node, 1_000.0);
    }
    let planned = farm.wait_for_plan();
    assert_eq!(planned.values().map(Vec::len).sum::<usize>(), 1, "the job of the one that did not");
}
