//! Who is heard and does not hear: a partition in one direction.

use farm_core::coordinator::NodeState;

use crate::farm::Farm;

/// Lets time pass; node 1 says each second that it is not answered, and the others live.
fn unanswered_until(farm: &mut Farm, until_ms: u64) {
    while farm.now.0 < until_ms * crate::farm::MILLISECOND_NS {
        farm.now = farm.now.after(std::time::Duration::from_secs(1));
        farm.says_unanswered(0, false);
        farm.says_unanswered(1, true);
        farm.says_unanswered(2, false);
        farm.machine.handle_timeout(farm.now);
        farm.settle();
    }
}

#[test]
fn a_node_that_hears_nothing_is_suspect_at_once_and_given_up_like_a_silent_one() {
    let mut farm = Farm::new("", &[1_000.0, 1_000.0]);
    let state = |farm: &Farm| farm.machine.status().nodes.iter().map(|node| node.state).collect::<Vec<_>>();
    farm.says_unanswered(1, true);
    assert_eq!(state(&farm), [NodeState::Suspect, NodeState::Alive]);
    farm.ended_nothing(1);
    assert_eq!(state(&farm), [NodeState::Suspect, NodeState::Alive], "whatever else it says");
    farm.says_unanswered(1, false);
    assert_eq!(state(&farm), [NodeState::Alive, NodeState::Alive]);
    unanswered_until(&mut farm, 9_000);
    assert_eq!(state(&farm), [NodeState::Suspect, NodeState::Alive]);
    unanswered_until(&mut farm, 10_000);
    assert_eq!(state(&farm), [NodeState::Alive], "its lease is over");
}

#[test]
fn an_application_that_hears_nothing_gets_no_plans_until_it_does() {
    let mut farm = Farm::new("", &[1_000.0]);
    farm.says_unanswered(0, true);
    assert!(farm.plan(&[10; 4], 1, &[]).is_empty(), "it would not hear of them");
    assert_eq!(farm.says_unanswered(0, false)[&1].len(), 4);
}
