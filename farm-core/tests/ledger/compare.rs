//! What an application has at a node is compared with what the node holds, every 30 s.

use std::time::Duration;

use farm_core::{holding::Holding, message::NodeToApp};

use crate::application::{Application, attempt};

const A_COMPARISON: Duration = Duration::from_secs(30);

fn holding(indices: &[u32]) -> Holding {
    indices.iter().map(|&index| attempt(index)).collect()
}

#[test]
fn what_has_no_result_or_no_acknowledgement_should_be_there() {
    let mut app = Application::new(true);
    app.pass(A_COMPARISON);
    assert_eq!(app.compared, [holding(&[0, 1])]);
    app.result(0);
    app.pass(A_COMPARISON);
    assert_eq!(app.compared[1], holding(&[0, 1]), "delivered, and not on disk yet");
    app.kept(0);
    app.pass(A_COMPARISON);
    assert_eq!(app.compared[2], holding(&[1]));
}

#[test]
fn a_lost_ticket_is_sent_again_and_what_nobody_waits_for_goes() {
    let mut app = Application::new(false);
    app.result(0);
    app.sent.clear();
    app.hears(NodeToApp::Inventory(vec![attempt(0), attempt(7)]));
    assert_eq!(app.sent, [attempt(1)]);
    assert_eq!(app.cancelled, [attempt(0), attempt(7)], "its acknowledgement was lost; it was never ours");
}

#[test]
fn a_result_that_is_not_on_disk_stays_at_its_node() {
    let mut app = Application::new(true);
    app.result(0);
    app.hears(NodeToApp::Inventory(vec![attempt(0)]));
    assert_eq!(app.cancelled, []);
}

#[test]
fn a_link_that_drops_again_and_again_is_given_up() {
    let mut app = Application::new(false);
    for _ in 0..5 {
        app.loses_link();
        app.pass(Duration::from_secs(3));
        app.connect();
    }
    let dialled = app.dialled;
    app.loses_link();
    app.pass(Duration::from_secs(60));
    assert_eq!(app.dialled, dialled, "six in a row, none of which stood for a while");
}
