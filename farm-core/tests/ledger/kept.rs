//! Results of a journalled run are acknowledged when they are on the application's disk, and no sooner.

use farm_core::{
    id::{AppId, TaskId},
    ledger::Event,
};

use crate::application::{Application, attempt};

#[test]
fn a_journalled_result_is_acknowledged_once_it_is_kept() {
    let mut app = Application::new(true);
    app.result(0);
    assert_eq!((app.delivered, &app.acknowledged[..]), (1, &[][..]));
    app.kept(0);
    assert_eq!(app.acknowledged, [attempt(0)]);
    app.kept(0);
    assert_eq!(app.acknowledged.len(), 1, "once");
}

#[test]
fn without_a_journal_it_is_acknowledged_at_once() {
    let mut app = Application::new(false);
    app.result(0);
    assert_eq!((app.delivered, &app.acknowledged[..]), (1, &[attempt(0)][..]));
}

/// The node repeats what it has no acknowledgement for; an answer then would lose what is not on disk yet.
#[test]
fn a_repeated_result_waits_like_the_first() {
    let mut app = Application::new(true);
    app.result(0);
    app.loses_link();
    app.connect_again();
    app.result(0);
    assert_eq!((app.delivered, app.dropped, &app.acknowledged[..]), (1, 1, &[][..]));
    app.kept(0);
    assert_eq!(app.acknowledged, [attempt(0)]);
    app.result(0);
    assert_eq!(app.acknowledged, [attempt(0); 2], "now the node hears it again");
}

/// Nothing is outstanding any more, and the node keeps both results until somebody says that it need not.
#[test]
fn a_link_that_is_lost_before_the_last_acknowledgement_is_made_again() {
    for journalled in [true, false] {
        let mut app = Application::new(journalled);
        (0..2).for_each(|index| app.result(index));
        app.loses_link();
        (0..2).for_each(|index| app.kept(index));
        app.connect_again();
        app.acknowledged.clear();
        (0..2).for_each(|index| app.result(index));
        assert_eq!(app.acknowledged, [attempt(0), attempt(1)], "journalled: {journalled}");
        assert_eq!(app.delivered, 2, "once each");
    }
}

#[test]
fn the_end_of_a_task_frees_what_waits() {
    let mut app = Application::new(true);
    app.result(0);
    app.handle(Event::Cancelled(TaskId(0)));
    assert_eq!(app.acknowledged, [attempt(0)]);
    app.result(1);
    assert_eq!((app.delivered, app.dropped), (1, 1), "nobody wants it");
    assert_eq!(app.acknowledged, [attempt(0), attempt(1)]);
}

#[test]
fn the_coordinator_hears_once_whom_the_application_goes_on_for() {
    let mut app = Application::new(true);
    app.handle(Event::Supersedes(AppId(7)));
    assert_eq!(app.superseded, [AppId(7)]);
    app.handle(Event::CoordinatorLost);
    for predecessor in [8, 8] {
        app.handle(Event::Supersedes(AppId(predecessor)));
    }
    assert_eq!(app.superseded, [AppId(7)], "nobody would hear it");
    app.registers();
    assert_eq!(app.superseded, [AppId(7), AppId(8)]);
}
