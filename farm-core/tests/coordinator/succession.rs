//! An application that goes on for another one, whose process is dead.

use farm_core::{
    coordinator::Event,
    id::{AppId, LinkId},
    message::AppToCoordinator,
    project::DEFAULT_PROJECT,
};

use crate::{
    farm::{APP, Farm},
    projects::joins,
};

const SUCCESSOR: LinkId = LinkId(50);

/// Two nodes with jobs of an application, and another one of a project; gives their ids.
fn farm_of_two(project: &str) -> (Farm, [AppId; 2]) {
    let mut farm = Farm::new("", &[1_000.0, 1_000.0]);
    farm.plan(&[10; 8], 1, &[]);
    let predecessor = farm.machine.status().apps[0].app;
    let successor = joins(&mut farm, SUCCESSOR.0, project, 1.0);
    (farm, [predecessor, successor])
}

fn supersede(farm: &mut Farm, app: AppId) {
    farm.handle(Event::FromApp { link: SUCCESSOR, message: AppToCoordinator::Supersede(app) });
}

fn closes(farm: &mut Farm, link: LinkId) {
    farm.handle(Event::LinkClosed { link });
}

fn apps(farm: &Farm) -> Vec<AppId> {
    farm.machine.status().apps.iter().map(|app| app.app).collect()
}

#[test]
fn a_dead_predecessor_is_over_at_once() {
    let (mut farm, [predecessor, successor]) = farm_of_two(DEFAULT_PROJECT);
    closes(&mut farm, APP);
    supersede(&mut farm, predecessor);
    assert_eq!(farm.left, [(1, predecessor), (2, predecessor)], "the nodes drop its queue");
    assert_eq!((apps(&farm), farm.open_jobs()), (vec![successor], 0));
    for app in [predecessor, AppId(77), AppId(0), AppId(u64::MAX)] {
        supersede(&mut farm, app);
    }
    assert_eq!((farm.left.len(), apps(&farm)), (2, vec![successor]), "said again, or of nobody: nothing");
}

#[test]
fn a_predecessor_whose_connection_stands_keeps_all_until_it_ends() {
    let (mut farm, [predecessor, successor]) = farm_of_two(DEFAULT_PROJECT);
    supersede(&mut farm, predecessor);
    assert_eq!((farm.left.len(), farm.open_jobs()), (0, 8));
    closes(&mut farm, APP);
    assert_eq!((farm.left.len(), apps(&farm)), (2, vec![successor]), "it was dead indeed");
}

/// A host that was powered off: its connection stands, and nothing comes.
#[test]
fn the_silence_of_a_predecessor_is_its_end() {
    let (mut farm, [predecessor, _]) = farm_of_two(DEFAULT_PROJECT);
    // The words that were on their way when it died.
    supersede(&mut farm, predecessor);
    farm.says_unanswered(APP.0, false);
    while let Some(due) = farm.machine.poll_timeout().filter(|due| due.0 <= 11_000_000_000) {
        farm.now = due;
        (1..=2).for_each(|node| {
            farm.heartbeat(node, None);
        });
        farm.machine.handle_timeout(due);
        farm.settle();
    }
    assert_eq!(farm.left, [(1, predecessor), (2, predecessor)]);
}

#[test]
fn who_lives_on_or_comes_back_has_its_lease() {
    let (mut farm, [predecessor, _]) = farm_of_two(DEFAULT_PROJECT);
    supersede(&mut farm, predecessor);
    farm.advance_to_ms(21_000);
    closes(&mut farm, APP);
    assert_eq!((farm.left.len(), farm.open_jobs()), (0, 8), "it lived on: what was said of it is past");

    let (mut farm, [predecessor, _]) = farm_of_two(DEFAULT_PROJECT);
    supersede(&mut farm, predecessor);
    farm.app_comes_back();
    closes(&mut farm, LinkId(1_000));
    assert_eq!((farm.left.len(), farm.open_jobs()), (0, 8), "it came back on another connection");

    let (mut farm, [_, successor]) = farm_of_two(DEFAULT_PROJECT);
    supersede(&mut farm, successor);
    closes(&mut farm, SUCCESSOR);
    assert_eq!((farm.left.len(), apps(&farm).len()), (0, 2), "nobody goes on for itself");
}

#[test]
fn nobody_ends_an_application_of_another_project() {
    for closed_first in [true, false] {
        let (mut farm, [predecessor, successor]) = farm_of_two("films");
        if closed_first {
            closes(&mut farm, APP);
        }
        supersede(&mut farm, predecessor);
        closes(&mut farm, APP);
        assert_eq!((farm.left.len(), apps(&farm)), (0, vec![predecessor, successor]));
    }
}
