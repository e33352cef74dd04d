//! What projects may have: who is over a quota waits, and goes on when the project has less.

use std::collections::BTreeMap;

use farm_core::{
    coordinator::{Event, ProjectStatus},
    id::{AppId, ContentHash, JobAttempt, LinkId},
    message::{AppHello, AppToCoordinator, JobFailure, WaitReason},
    program::Content,
    project::{DEFAULT_PROJECT, Quota},
};

use crate::farm::{Farm, count, hello};

fn set(farm: &mut Farm, project: &str, quota: Quota) -> BTreeMap<u64, Vec<JobAttempt>> {
    farm.handle(Event::QuotaSet { project: project.to_owned(), quota })
}

/// A farm whose application is of the project `default`, which may have so much.
fn limited(scores: &[f64], quota: Quota) -> Farm {
    let mut farm = Farm::new("", scores);
    set(&mut farm, DEFAULT_PROJECT, quota);
    farm
}

fn project(farm: &Farm) -> ProjectStatus {
    let projects = farm.machine.status().projects;
    projects.into_iter().find(|project| project.project == DEFAULT_PROJECT).unwrap()
}

fn total(planned: &BTreeMap<u64, Vec<JobAttempt>>) -> usize {
    planned.values().map(Vec::len).sum()
}

/// A further application; gives its id.
fn joins(farm: &mut Farm, link: u64, project: &str, weight: f64) -> AppId {
    let link = LinkId(link);
    farm.handle(Event::AppIntroduced { link, project: project.to_owned() });
    farm.handle(Event::FromApp { link, message: AppToCoordinator::Hello(AppHello { weight, ..hello() }) });
    farm.machine.status().apps.last().unwrap().app
}

#[test]
fn jobs_over_the_quota_wait_and_each_end_lets_the_next_in() {
    let mut farm = limited(&[1_000.0, 1_000.0], Quota { queued_jobs: Some(4), ..Quota::default() });
    let mut open = farm.plan(&[10; 7], 1, &[]);
    let second = farm.plan(&[10; 3], 1, &[]);
    assert_eq!((total(&open), total(&second)), (4, 0));
    assert_eq!(farm.waits, [WaitReason::OverQuota], "the second batch has nothing: it is told why");
    assert_eq!((project(&farm).queued_jobs, project(&farm).waiting_jobs), (4, 6));
    let mut planned = 4;
    while let Some((&node, jobs)) = open.iter_mut().find(|(_, jobs)| !jobs.is_empty()) {
        let job = jobs.remove(0);
        farm.now = farm.now.after(std::time::Duration::from_millis(10));
        let more = farm.ended(node, job, 10);
        planned += total(&more);
        assert!(project(&farm).queued_jobs <= 4);
        more.into_iter().for_each(|(node, jobs)| open.entry(node).or_default().extend(jobs));
    }
    assert_eq!((planned, farm.open_jobs()), (10, 0), "nothing is lost");
}

#[test]
fn a_project_of_few_devices_stays_on_them_and_idle_nodes_steal_nothing() {
    let mut farm = limited(&[1_000.0; 4], Quota { devices: Some(2), ..Quota::default() });
    let planned = farm.plan(&[10; 40], 1, &[]);
    assert_eq!(planned.len(), 2, "two devices of four: {planned:?}");
    assert!(farm.terms.values().all(|terms| terms.stays), "and nodes do not spread them");
    for node in 1..=4 {
        farm.ended_nothing(node);
        farm.heartbeat(node, None);
    }
    assert_eq!((project(&farm).devices, farm.machine.status().stolen_jobs), (2, 0));
    let further = farm.plan(&[10; 4], 1, &[]);
    assert!(further.keys().all(|node| planned.contains_key(node)), "no third one: {further:?}");
    // One that has no job any more is free for another.
    let (&done, jobs) = planned.iter().next().unwrap();
    farm.done(done, jobs, |_| 10);
    let of_further = further.get(&done).cloned().unwrap_or_default();
    farm.done(done, &of_further, |_| 10);
    assert_eq!(project(&farm).devices, 1);
    farm.stop_taking(done);
    let elsewhere = farm.plan(&[10; 40], 1, &[]);
    assert!(elsewhere.keys().any(|node| !planned.contains_key(node)), "{elsewhere:?}");
    assert_eq!(project(&farm).devices, 2);
}

#[test]
fn the_devices_that_a_project_gets_are_the_fast_ones() {
    let mut farm = limited(&[10.0, 1_000.0, 20.0, 800.0], Quota { devices: Some(2), ..Quota::default() });
    let planned = farm.plan(&[10; 40], 1, &[]);
    assert_eq!(planned.keys().copied().collect::<Vec<_>>(), [2, 4]);
}

#[test]
fn task_data_waits_for_room_and_what_can_never_fit_fails() {
    let mut farm = limited(&[1_000.0], Quota { bytes: Some(100), ..Quota::default() });
    let content = |tag, size_bytes| Content { hash: ContentHash([tag; 32]), size_bytes };
    let first = farm.plan(&[10; 2], 1, &[content(1, 60)]);
    assert_eq!(total(&first), 2);
    let same = farm.plan(&[10], 1, &[content(1, 60), content(2, 40)]);
    assert_eq!((total(&same), project(&farm).bytes), (1, 100), "what is there counts once");
    assert_eq!(total(&farm.plan(&[10], 1, &[content(3, 50)])), 0);
    assert_eq!(farm.waits, [WaitReason::OverQuota]);

    assert_eq!(total(&farm.plan(&[10; 3], 1, &[content(4, 60), content(5, 41)])), 0);
    assert_eq!(farm.given_up.len(), 3);
    let says = |failure: &JobFailure| matches!(failure, JobFailure::OverQuota(why) if why.contains("101 B") && why.contains("100 B"));
    assert!(farm.given_up.iter().all(says), "{:?}", farm.given_up);

    let of_first = first[&1].clone();
    farm.done(1, &of_first, |_| 10);
    assert_eq!(project(&farm).bytes, 100, "the second batch needs it still");
    let third = farm.ended(1, same[&1][0], 10);
    assert_eq!((total(&third), project(&farm).bytes), (1, 50));
}

#[test]
fn a_large_batch_in_line_is_not_passed_by_small_ones() {
    let mut farm = limited(&[1_000.0], Quota { bytes: Some(100), ..Quota::default() });
    let content = |tag, size_bytes| Content { hash: ContentHash([tag; 32]), size_bytes };
    let first = farm.plan(&[10], 1, &[content(1, 60)]);
    let mut later: Vec<usize> = Vec::new();
    for size_bytes in [90, 10, 10] {
        let tag = u8::try_from(10 + later.len()).unwrap();
        later.push(total(&farm.plan(&[10; 2], 1, &[content(tag, size_bytes)])));
    }
    assert_eq!(later, [0, 0, 0], "the small ones would fit, and wait their turn");
    let next = farm.ended(1, first[&1][0], 10);
    assert_eq!(
        (total(&next), project(&farm).bytes),
        (4, 100),
        "the large one and the first of the small ones"
    );
    let of_large = next[&1].clone();
    assert_eq!(total(&farm.ended(1, of_large[0], 10)), 0);
    assert_eq!(total(&farm.ended(1, of_large[1], 10)), 2, "all are through");
}

#[test]
fn weights_of_a_project_come_to_no_more_than_its_quota() {
    let mut farm = Farm::new("", &[1_000.0]);
    set(&mut farm, "films", Quota { weight: Some(3.0), ..Quota::default() });
    let alone = joins(&mut farm, 50, "films", 2.0);
    assert_eq!(farm.terms[&alone].weight, 2.0, "it is below");
    let other = joins(&mut farm, 51, "films", 4.0);
    assert_eq!(
        (farm.terms[&alone].weight, farm.terms[&other].weight),
        (1.0, 2.0),
        "each half of what it asked"
    );
    let first = farm.machine.status().apps[0].app;
    assert_eq!(farm.terms[&first].weight, 1.0, "another project's is as it was");
    farm.handle(Event::FromApp { link: LinkId(51), message: AppToCoordinator::Goodbye });
    assert_eq!(farm.terms[&alone].weight, 2.0);
    set(&mut farm, "films", Quota { weight: Some(0.5), ..Quota::default() });
    assert_eq!(farm.terms[&alone].weight, 0.5);
    set(&mut farm, "films", Quota::default());
    assert_eq!(farm.terms[&alone].weight, 2.0);
}

#[test]
fn a_suspended_project_gets_nothing_until_its_quota_is_lifted_and_others_go_on() {
    let mut farm = limited(&[1_000.0], Quota { queued_jobs: Some(0), ..Quota::default() });
    assert_eq!(total(&farm.plan(&[10; 5], 1, &[])), 0);
    assert_eq!(farm.waits, [WaitReason::OverQuota]);
    set(&mut farm, "films", Quota::default());
    assert_eq!(project(&farm).waiting_jobs, 5, "another project's quota lets nobody in here");
    assert_eq!(total(&set(&mut farm, DEFAULT_PROJECT, Quota::default())), 5);
    set(&mut farm, DEFAULT_PROJECT, Quota { devices: Some(0), ..Quota::default() });
    assert_eq!(total(&farm.plan(&[10; 2], 1, &[])), 0, "what it has goes on, and nothing follows");
}

#[test]
fn a_plug_in_decides_within_the_quota() {
    let mut farm = Farm::new("spread", &[1_000.0; 4]);
    let quota = Quota { devices: Some(2), queued_jobs: Some(3), ..Quota::default() };
    set(&mut farm, DEFAULT_PROJECT, quota);
    assert_eq!(total(&farm.plan(&[10; 5], 1, &[])), 0, "it is asked first");
    let (id, _, question) = farm.questions.pop().unwrap();
    assert_eq!((question.jobs.len(), question.devices.len()), (3, 2));
    let planned = farm.handle(Event::PolicyAnswered { question: id, answer: Err("no".to_owned()) });
    assert_eq!(total(&planned), 3, "and the fallback keeps to it, too");
}

#[test]
fn an_application_comes_back_to_its_own_project_alone() {
    let mut farm = Farm::new("", &[1_000.0]);
    set(&mut farm, "films", Quota::default());
    let app = joins(&mut farm, 50, "films", 1.0);
    let incarnation = farm_core::id::AppIncarnation(1);
    let resume = AppToCoordinator::Hello(AppHello { resume: Some((app, incarnation)), ..hello() });
    farm.handle(Event::FromApp { link: LinkId(60), message: resume });
    let reason = farm.refused.take().unwrap();
    assert!(reason.contains("films") && reason.contains("default"), "{reason}");
    assert_eq!(count(&farm.plan(&[10], 1, &[]), 1), 1);
}

#[test]
fn a_removed_project_is_forgotten_with_its_last_application() {
    let mut farm = Farm::new("", &[1_000.0]);
    set(&mut farm, "films", Quota { weight: Some(0.5), ..Quota::default() });
    let app = joins(&mut farm, 50, "films", 2.0);
    assert_eq!(farm.terms[&app].weight, 0.5);
    farm.handle(Event::ProjectRemoved { project: "films".to_owned() });
    assert_eq!(farm.terms[&app].weight, 2.0);
    assert!(farm.machine.status().projects.iter().all(|project| project.project == DEFAULT_PROJECT));
    farm.handle(Event::FromApp { link: LinkId(50), message: AppToCoordinator::Goodbye });
}
