//! Which device a job goes to: rates per module, data that is there, and the policies an application may choose.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{collections::BTreeMap, time::Duration};

use farm_core::{
    coordinator::{
        CoordinatorConfig, CoordinatorMachine, Effect, Event,
        policy::{Choice, Question, QuestionId},
    },
    device::{DeviceInfo, DeviceKind, Features, Limits, Requirements},
    id::{BatchId, ContentHash, DeviceIndex, Epoch, JobAttempt, JobIndex, LinkId, NodeSession, TaskId},
    message::{
        AppHello, AppToCoordinator, Contact, CoordinatorToApp, CostNs, Executed, JobTrace, NodeHello,
        NodeToCoordinator, PROTOCOL_VERSION, Plan, PlanJob, PlanRequest,
    },
    program::Content,
    time::Instant,
};

const APP: LinkId = LinkId(0);
const MILLISECOND_NS: u64 = 1_000_000;

/// A coordinator with one application and nodes of one device each, driven by hand.
struct Farm {
    machine: CoordinatorMachine,
    now: Instant,
    batches: u64,
    questions: Vec<(QuestionId, String, Question)>,
    refused: Option<String>,
}

impl Farm {
    fn new(policy: &str, scores: &[f64]) -> Self {
        let config = CoordinatorConfig {
            plugins: ["spread".to_owned()].into(),
            ..CoordinatorConfig::new(Epoch(1), 1)
        };
        let machine = CoordinatorMachine::new(config);
        let mut farm = Self { machine, now: Instant::ZERO, batches: 0, questions: Vec::new(), refused: None };
        for (node, &score) in (1..).zip(scores) {
            farm.node_joins(node, score);
        }
        let hello = AppHello {
            protocol: PROTOCOL_VERSION,
            name: "app".to_owned(),
            weight: 1.0,
            global_stealing: false,
            policy: policy.to_owned(),
            resume: None,
        };
        farm.say(AppToCoordinator::Hello(hello));
        farm
    }

    fn node_joins(&mut self, node: u64, score: f64) {
        let info = DeviceInfo {
            name: "sim".to_owned(),
            kind: DeviceKind::Simulated,
            score,
            features: Features::default(),
            limits: Limits::UNBOUNDED,
        };
        let message = NodeToCoordinator::Hello(NodeHello {
            protocol: PROTOCOL_VERSION,
            name: format!("node {node}"),
            session: NodeSession(node),
            devices: vec![info],
            contact: Contact { addresses: Vec::new(), certificate_der: Vec::new() },
            inventory: Vec::new(),
        });
        self.handle(Event::FromNode { link: LinkId(node), message });
    }

    fn say(&mut self, message: AppToCoordinator) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.handle(Event::FromApp { link: APP, message })
    }

    /// Takes an event in; gives the jobs planned in answer, by node.
    fn handle(&mut self, event: Event) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.machine.handle(self.now, event);
        self.settle()
    }

    fn settle(&mut self) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.machine.check_invariants();
        let mut planned: BTreeMap<u64, Vec<JobAttempt>> = BTreeMap::new();
        while let Some(effect) = self.machine.poll_effect() {
            match effect {
                Effect::ToApp { message: CoordinatorToApp::Plan(Plan { nodes, .. }), .. } => {
                    for node in nodes {
                        let jobs = node.devices.into_iter().flat_map(|device| device.jobs);
                        planned.entry(node.session.0).or_default().extend(jobs);
                    }
                }
                Effect::ToApp { message: CoordinatorToApp::Refused { reason }, .. } => {
                    self.refused = Some(reason);
                }
                Effect::AskPolicy { id, plugin, question } => self.questions.push((id, plugin, question)),
                Effect::ToApp { .. } | Effect::ToNode { .. } | Effect::Close { .. } => {}
            }
        }
        planned
    }

    fn plan(&mut self, costs_ms: &[u64], module: u8, contents: &[Content]) -> BTreeMap<u64, Vec<JobAttempt>> {
        self.batches += 1;
        let jobs = (0..).zip(costs_ms).map(|(index, cost_ms)| PlanJob {
            index: JobIndex(index),
            cost: CostNs(cost_ms * MILLISECOND_NS),
        });
        let request = PlanRequest {
            batch: BatchId(self.batches),
            task: TaskId(u32::try_from(self.batches).unwrap()),
            jobs: jobs.collect(),
            needs: Requirements::ANY,
            module: Some(ContentHash([module; 32])),
            contents: contents.to_vec(),
        };
        self.say(AppToCoordinator::Plan(request))
    }

    /// A node has executed and delivered jobs, each in the time that `took_ms` says.
    fn done(&mut self, node: u64, jobs: &[JobAttempt], took_ms: impl Fn(JobAttempt) -> u64) {
        for &job in jobs {
            let device_time_ns = took_ms(job) * MILLISECOND_NS;
            self.now = self.now.after(Duration::from_nanos(device_time_ns));
            let (device, trace, failure) = (DeviceIndex(0), JobTrace::default(), None);
            let executed = vec![Executed { job, device, device_time_ns, trace, failure }];
            let message = NodeToCoordinator::Report { sent_at: self.now, executed, delivered: vec![job] };
            self.handle(Event::FromNode { link: LinkId(node), message });
        }
    }
}

fn count(planned: &BTreeMap<u64, Vec<JobAttempt>>, node: u64) -> usize {
    planned.get(&node).map_or(0, Vec::len)
}

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
    let took = |job: JobAttempt| if job.job.index.0 == 5 { 400 } else { 10 + u64::from(job.job.index.0) };
    let second_frame = |policy| {
        let mut farm = Farm::new(policy, &[1_000.0, 1_000.0]);
        for (node, jobs) in farm.plan(&[0; 12], 1, &[]) {
            farm.done(node, &jobs, took);
        }
        farm.plan(&[0; 12], 1, &[])
    };
    let planned = second_frame("history");
    let longest = planned.iter().find(|(_, jobs)| jobs.iter().any(|job| job.job.index.0 == 5)).unwrap();
    assert_eq!(longest.1[0].job.index.0, 5, "the longest is first in its queue");
    assert!(longest.1.len() <= 3, "and nearly alone: {longest:?}");
    let planned = second_frame("fcfs");
    assert!(
        planned.values().all(|jobs| (4..=8).contains(&jobs.len())),
        "without memory all look alike: {planned:?}"
    );
}

#[test]
fn an_unknown_policy_is_refused_by_name() {
    let farm = Farm::new("nonesuch", &[1.0]);
    let reason = farm.refused.unwrap();
    assert!(reason.contains("`nonesuch`") && reason.contains("fcfs, history, spread"), "{reason}");
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
    assert_eq!(farm.machine.policy_fallbacks(), 0);
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
        assert_eq!(farm.machine.policy_fallbacks(), 1);
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
