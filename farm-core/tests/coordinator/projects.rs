//! What projects may have: who is over a quota waits, and goes on when the project has less.

use std::collections::BTreeMap;

use farm_core::{
    coordinator::{Event, ProjectStatus, policy::Choice},
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
pub(crate) fn joins(farm: &mut Farm, link: u64, project: &str, weight: f64) -> AppId {
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

/// The review of 2026-11-29: nodes hear of many applications in one message, or their queue of messages overflows.
#[test]
fn a_node_hears_of_all_applications_at_once() {
    let mut farm = Farm::new("", &[1_000.0]);
    set(&mut farm, "films", Quota { weight: Some(1e9), ..Quota::default() });
    for app in 0..200 {
        joins(&mut farm, 1_000 + app, "films", 1.0);
    }
    let before = farm.announcements;
    set(&mut farm, "films", Quota { weight: Some(3.0), ..Quota::default() });
    joins(&mut farm, 2_000, "films", 1.0);
    assert_eq!(farm.announcements - before, 2, "one for the quota, one for the newcomer");
    farm.stop_taking(1);
    farm.node_joins(1, 1_000.0);
    assert_eq!((farm.announcements - before, farm.terms.len()), (3, 202), "and one for a hello");
}

/// The review of 2026-11-29: weights that are too large to be added made a status that no client reads.
#[test]
fn weights_come_to_a_finite_number() {
    let mut farm = Farm::new("", &[1_000.0]);
    for link in [50, 51] {
        joins(&mut farm, link, "films", f64::MAX);
    }
    let weight = |farm: &Farm| farm.machine.status().projects.pop().unwrap().weight;
    assert_eq!(weight(&farm), f64::MAX);
    set(&mut farm, "films", Quota { weight: Some(2.0), ..Quota::default() });
    assert!((weight(&farm) - 2.0).abs() < 1e-9, "{}", weight(&farm));
    assert!(farm.machine.status().apps.iter().all(|app| app.weight > 0.0 && app.weight.is_finite()));
}

/// A newcomer, 2026-11-29: the documented `project set films --weight 2` made a status that no client reads.
#[test]
fn a_project_without_applications_weighs_nothing() {
    let mut farm = Farm::new("", &[1_000.0]);
    set(&mut farm, "films", Quota { weight: Some(2.0), ..Quota::default() });
    let films = farm.machine.status().projects.pop().unwrap();
    assert_eq!((films.project.as_str(), films.weight.to_bits()), ("films", 0));
}

/// The review of 2026-11-29: right answers of a plug-in were asked for again without end.
#[test]
fn a_plug_in_may_stay_on_more_devices_than_the_project_may_have_now() {
    let mut farm = Farm::new("spread", &[1_000.0; 3]);
    farm.plan(&[10; 3], 1, &[]);
    let answer = |farm: &mut Farm, choices: Vec<Choice>| {
        let (question, ..) = farm.questions.pop().unwrap();
        farm.handle(Event::PolicyAnswered { question, answer: Ok(choices) })
    };
    answer(&mut farm, (0..3).map(|n| Choice { job: n, device: n }).collect());
    set(&mut farm, DEFAULT_PROJECT, Quota { devices: Some(2), ..Quota::default() });
    farm.plan(&[10], 1, &[]);
    assert_eq!(total(&answer(&mut farm, vec![Choice { job: 0, device: 0 }])), 1);
    assert!(farm.questions.is_empty());
}

/// The review of 2026-11-29: what a plug-in was asked about did not count, and each of several answers went through.
#[test]
fn a_plug_ins_answers_are_within_the_bytes_together() {
    let mut farm = Farm::new("spread", &[1_000.0]);
    set(&mut farm, DEFAULT_PROJECT, Quota { bytes: Some(100), ..Quota::default() });
    for tag in [1, 2] {
        farm.plan(&[10], 1, &[Content { hash: ContentHash([tag; 32]), size_bytes: 60 }]);
    }
    for (question, ..) in std::mem::take(&mut farm.questions) {
        let answer = Ok(vec![Choice { job: 0, device: 0 }]);
        farm.handle(Event::PolicyAnswered { question, answer });
    }
    assert_eq!((project(&farm).bytes, project(&farm).waiting_jobs), (60, 1));
}

/// The review of 2026-11-29: a node that is heard again helps those who wait for their project, too.
#[test]
fn who_waits_for_a_device_of_the_project_goes_on_when_its_node_is_back() {
    let mut farm = limited(&[1_000.0; 2], Quota { devices: Some(1), ..Quota::default() });
    let first = farm.plan(&[3_600_000], 1, &[]);
    let (&node, _) = first.iter().next().unwrap();
    farm.says_unanswered(node, true);
    assert_eq!(total(&farm.plan(&[10; 3], 1, &[])), 0);
    assert_eq!(total(&farm.says_unanswered(node, false)), 3);
}

/// The review of 2026-11-29.
#[test]
fn sizes_up_to_the_last_bit_are_added_and_taken_off_again() {
    let mut farm = Farm::new("", &[1_000.0]);
    let content = |tag, size_bytes| Content { hash: ContentHash([tag; 32]), size_bytes };
    let first = farm.plan(&[10], 1, &[content(1, u64::MAX)]);
    farm.plan(&[10], 1, &[content(2, 500)]);
    assert_eq!(project(&farm).bytes, u64::MAX);
    farm.ended(1, first[&1][0], 10);
    assert_eq!(project(&farm).bytes, 500);
}

/// The review of 2026-11-29: every end told the application anew that it waits.
#[test]
fn a_batch_that_goes_out_one_by_one_is_told_once() {
    let mut farm = limited(&[1_000.0], Quota { queued_jobs: Some(1), ..Quota::default() });
    let mut open = farm.plan(&[10; 50], 1, &[]);
    while let Some(job) = open.remove(&1).map(|jobs| jobs[0]) {
        open = farm.ended(1, job, 10);
    }
    assert_eq!(farm.open_jobs(), 0);
    assert!(farm.waits.len() <= 1, "{:?}", farm.waits);
}
