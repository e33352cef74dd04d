//! A result counts from the life of the node that its attempt was planned on, and from nobody else.

use farm_core::{
    id::{Attempt, JobAttempt, NodeId, NodeSession},
    ledger::Event,
};

use crate::application::{Application, NODE, SESSION, attempt, result};

/// Neither delivered nor acknowledged: whoever hears that a result is acknowledged may report the job as delivered.
#[test]
fn s30_a_result_of_a_node_that_the_plan_does_not_name_is_refused() {
    let mut app = Application::new(false);
    for (node, session, sequence) in [(NodeId(2), SESSION, 10), (NODE, NodeSession(8), 11)] {
        // It is linked with: the other job moves there.
        let moved = Attempt { sequence, ..attempt(1).attempt };
        app.planned(node, session, vec![JobAttempt { attempt: moved, ..attempt(1) }]);
        app.handle(Event::FromNode { node, session, message: result(0) });
    }
    assert_eq!((app.delivered, app.dropped, &app.acknowledged[..]), (0, 2, &[][..]));
    app.result(0);
    assert_eq!((app.delivered, &app.acknowledged[..]), (1, &[attempt(0)][..]), "the planned one counts");
    app.handle(Event::FromNode { node: NodeId(2), session: SESSION, message: result(0) });
    assert_eq!(app.delivered, 1, "once");
}
