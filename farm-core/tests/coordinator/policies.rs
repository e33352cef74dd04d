//! Which device a job goes to: rates per module, data that is there, and the policies an application may choose.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use farm_core::id::LinkId;
use farm_core::{
    coordinator::{Event, policy::Choice},
    id::{ContentHash, JobAttempt, JobIndex},
    message::NodeToCoordinator,
    program::Content,
};

use crate::farm::{Farm, count};

#[test]
fn devices_are_rated_for_each_module_by_itself() {
    let mut farm = Farm::new("", &[1_000.0, 1_000.0]);
    // Equal by score; the first is three times as fast for module 1, the second for module 2.
    for module in [1, 2] {
        for _ in 0..10 {
            let planned = farm.plan(&[10; 8], module, &[]);
            for (node, jobs) in planned {
                let fast = node == u64::from(module);
                farm.done(node, &jobs, |_| if fast { 5 } else { 15 });
            }
        }
    }
    for module in [1, 2] {
        let planned = farm.plan(&[10; 40], module, &[]);
        let fast = count(&planned, module.into());
        assert!((28..=32).contains(&fast), "three quarters of 40 belong to the faster one, not {fast}");
        planned.into_iter().for_each(|(node, jobs)| farm.done(node, &jobs, |_| 10));
    }
}

#[test]
fn a_node_that_has_the_data_is_preferred_until_its_queue_is_longer_than_the_transfer() {
    // 117 MB: a second on gigabit Ethernet.
    let scene = Content { hash: ContentHash([9; 32]), size_bytes: 117_000_000 };
    let mut farm = Farm::new("", &[1_000.0]);
    let planned = farm.plan(&[100], 1, &[scene]);
    farm.done(1, &planned[&1], |_| 100);
    farm.node_joins(2, 1_000.0);
    let planned = farm.plan(&[100; 8], 1, &[scene]);
    assert_eq!(
        (count(&planned, 1), count(&planned, 2)),
        (8, 0),
        "0.8 s of work are no reason to move 1 s of data"
    );
    planned.into_iter().for_each(|(node, jobs)| farm.done(node, &jobs, |_| 100));
    let planned = farm.plan(&[100; 30], 1, &[scene]);
    assert_eq!((count(&planned, 1), count(&planned, 2)), (20, 10), "3 s are: both end after 2 s");
    planned.into_iter().for_each(|(node, jobs)| farm.done(node, &jobs, |_| 100));
    let planned = farm.plan(&[100; 8], 1, &[scene]);
    assert_eq!((count(&planned, 1), count(&planned, 2)), (4, 4), "now both have it");
}

#[test]
fn history_knows_what_the_same_jobs_took_and_puts_the_longest_first() {
    let took_ms = |_, index: JobIndex| if index.0 == 5 { 400 } else { 10 + u64::from(index.0) };
    let second_frame = |policy| {
        let mut farm = Farm::new(policy, &[1_000.0, 1_000.0]);
        let planned = farm.plan(&[0; 12], 1, &[]);
        run(&mut farm, planned, took_ms);
        let planned = farm.plan(&[0; 12], 1, &[]);
        run(&mut farm, planned, took_ms)
    };
    let ran = second_frame("history");
    let (_, with_longest) = ran.values().find(|(_, jobs)| jobs.contains(&5)).unwrap();
    assert_eq!(with_longest[0], 5, "the longest is first in its queue");
    assert!(with_longest.len() <= 3, "and nearly alone: {ran:?}");
    let ran = second_frame("fcfs");
    assert!(
        ran.values().all(|(_, jobs)| (4..=8).contains(&jobs.len())),
        "without memory all look alike: {ran:?}"
    );
}

#[test]
fn an_unknown_policy_is_refused_by_name() {
    let farm = Farm::new("nonesuch", &[1.0]);
    let reason = farm.refused.unwrap();
    assert!(
        reason.contains("`nonesuch`") && reason.contains("fcfs, neighbours, history, spread"),
        "{reason}"
    );
}

#[test]
fn a_plug_in_places_a_batch() {
    let mut farm = Farm::new("spread", &[1.0, 1_000.0]);
    assert!(farm.plan(&[10; 3], 1, &[]).is_empty(), "not before it answered");
    let (id, plugin, question) = farm.questions.pop().unwrap();
    assert_eq!((plugin.as_str(), question.jobs.len(), question.devices.len()), ("spread", 3, 2));
    let answer = Ok([2, 0, 1].map(|job| Choice { job, device: 0 }).to_vec());
    let planned = farm.handle(Event::PolicyAnswered { question: id, answer });
    let order: Vec<u32> = planned[&1].iter().map(|job| job.job.index.0).collect();
    assert_eq!(order, [2, 0, 1], "all on the slow one, in the order it said");
    assert_eq!(farm.machine.status().policy_fallbacks, 0);
}

#[test]
fn a_plug_in_that_fails_or_answers_nonsense_is_passed_over() {
    let choice = |job, device| Choice { job, device };
    let answers = [
        Err("crashed with signal 11".to_owned()),
        Ok(vec![]),
        Ok(vec![choice(0, 0), choice(0, 0)]),
        Ok(vec![choice(0, 0), choice(2, 0)]),
        Ok(vec![choice(0, 0), choice(1, 2)]),
    ];
    for answer in answers {
        let mut farm = Farm::new("spread", &[1.0, 1_000.0]);
        farm.plan(&[10; 2], 1, &[]);
        let (question, ..) = farm.questions.pop().unwrap();
        let planned = farm.handle(Event::PolicyAnswered { question, answer: answer.clone() });
        assert_eq!(count(&planned, 2), 2, "first come, first served to the faster one after {answer:?}");
        assert_eq!(farm.machine.status().policy_fallbacks, 1);
        let late =
            farm.handle(Event::PolicyAnswered { question, answer: Ok(vec![choice(0, 0), choice(1, 0)]) });
        assert!(late.is_empty(), "a second answer changes nothing");
    }
}

#[test]
fn a_slow_plug_in_is_not_waited_for_and_not_asked_again_after_three_times() {
    let mut farm = Farm::new("spread", &[1.0]);
    for round in 0..4 {
        let at_once = farm.plan(&[10; 2], 1, &[]);
        if round == 3 {
            assert_eq!(count(&at_once, 1), 2, "not asked any more");
            break;
        }
        assert!(at_once.is_empty(), "asked");
        farm.now = farm.machine.poll_timeout().unwrap();
        farm.machine.handle_timeout(farm.now);
        assert_eq!(count(&farm.settle(), 1), 2, "placed when its time was over");
    }
    assert_eq!(farm.questions.len(), 3);
    farm.now = farm.now.after(Duration::from_secs(61));
    assert!(farm.plan(&[10; 2], 1, &[]).is_empty(), "a minute later it gets another chance");
}

#[test]
fn a_device_that_went_while_a_plug_in_thought_takes_nothing() {
    let mut farm = Farm::new("spread", &[1.0, 1.0]);
    farm.plan(&[10; 2], 1, &[]);
    let (question, _, asked) = farm.questions.pop().unwrap();
    farm.handle(Event::FromNode { link: LinkId(1), message: NodeToCoordinator::Goodbye });
    let gone = asked.devices.iter().position(|device| device.node.0 == 1).unwrap();
    let device = u32::try_from(gone).unwrap();
    let answer = Ok([0, 1].map(|job| Choice { job, device }).to_vec());
    assert!(farm.handle(Event::PolicyAnswered { question, answer }).is_empty(), "asked again instead");
    let (question, _, asked) = farm.questions.pop().unwrap();
    assert_eq!(asked.devices.len(), 1, "of the farm as it is");
    let answer = Ok([0, 1].map(|job| Choice { job, device: 0 }).to_vec());
    assert_eq!(count(&farm.handle(Event::PolicyAnswered { question, answer }), 2), 2);
}

/// Runs a task's jobs, each node's in order and what is planned meanwhile behind them; gives when each node ended, from its
/// beginning, and which jobs it ran.
fn run(
    farm: &mut Farm,
    planned: BTreeMap<u64, Vec<JobAttempt>>,
    took_ms: impl Fn(u64, JobIndex) -> u64,
) -> BTreeMap<u64, (u64, Vec<u32>)> {
    let began = farm.now;
    let mut queues: BTreeMap<u64, VecDeque<JobAttempt>> = BTreeMap::new();
    let mut running: BTreeSet<(u64, u64, JobAttempt)> = BTreeSet::new();
    let mut ran: BTreeMap<u64, (u64, Vec<u32>)> = BTreeMap::new();
    let mut fresh = planned;
    let mut at_ms = 0;
    loop {
        for (node, jobs) in fresh {
            queues.entry(node).or_default().extend(jobs);
        }
        for (&node, queue) in &mut queues {
            let busy = running.iter().any(|(_, other, _)| *other == node);
            if let Some(next) = (!busy).then(|| queue.pop_front()).flatten() {
                running.insert((at_ms + took_ms(node, next.job.index), node, next));
            }
        }
        let Some((end_ms, node, job)) = running.pop_first() else { return ran };
        at_ms = end_ms;
        farm.now = began.after(Duration::from_millis(at_ms));
        fresh = farm.ended(node, job, took_ms(node, job.job.index));
        let (ended_ms, jobs) = ran.entry(node).or_default();
        *ended_ms = at_ms;
        jobs.push(job.job.index.0);
    }
}

/// When the first and the last node ended; all jobs ran once.
fn ends(ran: &BTreeMap<u64, (u64, Vec<u32>)>, jobs: u32) -> (u64, u64) {
    let mut all: Vec<u32> = ran.values().flat_map(|(_, jobs)| jobs).copied().collect();
    all.sort_unstable();
    assert_eq!(all, (0..jobs).collect::<Vec<_>>(), "each job runs once");
    let ends = || ran.values().map(|(end_ms, _)| *end_ms);
    (ends().min().unwrap(), ends().max().unwrap())
}

/// Dear tiles lie together, as in an image.
fn dear_in_the_middle(_: u64, index: JobIndex) -> u64 {
    40 + 40 * u64::from((100..260).contains(&index.0))
}

#[test]
fn neighbours_tell_what_the_last_jobs_take_and_what_devices_are_worth() {
    // Each tile is like those beside it, and equal scores are wrong: the last device is 1.76 times as fast as the first.
    let cost_ms = |index: JobIndex| 360 + 10 * u64::from(40_u32.saturating_sub(index.0.abs_diff(170) / 4));
    let percent = |node: u64| 100 + 76 * (node - 1) / 31;
    let took_ms = |node, index| cost_ms(index) * 100 / percent(node);
    let all_ms: u64 = (0..540).map(|index| cost_ms(JobIndex(index))).sum();
    let bound_ms = all_ms as f64 * 100.0 / (1..=32).map(percent).sum::<u64>() as f64;
    let makespan = |policy| {
        let mut farm = Farm::new(policy, &[1_000.0; 32]);
        let planned = farm.plan(&[0; 540], 1, &[]);
        let (_, last_ms) = ends(&run(&mut farm, planned, took_ms), 540);
        last_ms as f64 / bound_ms
    };
    let (learnt, blind) = (makespan("neighbours"), makespan("fcfs"));
    assert!(learnt < 1.03 && blind > 1.2, "{learnt:.3} and {blind:.3} times the lower bound");
}

#[test]
fn the_second_frame_is_spread_by_what_the_first_one_took() {
    let mut farm = Farm::new("history", &[1_000.0; 32]);
    let planned = farm.plan(&[0; 540], 1, &[]);
    run(&mut farm, planned, dear_in_the_middle);
    let planned = farm.plan(&[0; 540], 1, &[]);
    let (least, most) = ends(&run(&mut farm, planned, dear_in_the_middle), 540);
    assert!(most - least <= 40, "devices end within a cheap tile of each other: {least} to {most} ms");
}
