//! Simulated devices: the order of events, never their durations.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{
    sync::{Arc, mpsc},
    time::Duration,
};

use bytes::Bytes;
use farm_core::{
    device::DeviceKind,
    id::{AppId, Attempt, ContentHash, Epoch, JobAttempt, JobId, JobIndex, TaskId},
    message::{CostNs, JobFailure, LatencyClass},
    program::{Content, JobProgram},
};
use gpu_exec::{Busy, DeviceSpec, Executor, ExecutorConfig, ExecutorEvent, Order};

/// Far more than any test needs; it only turns a hang into a failure.
const PATIENCE: Duration = Duration::from_secs(60);
const LONG: CostNs = CostNs(3_600_000_000_000);

fn job(index: u32) -> JobAttempt {
    let job = JobId { app: AppId(1), task: TaskId(1), index: JobIndex(index) };
    JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence: u64::from(index) } }
}

fn costing(cost: CostNs) -> JobProgram {
    let mut program = JobProgram::default();
    let module = Content { hash: ContentHash([1; 32]), size_bytes: 1 };
    let kernel = program.function(module, "main");
    program.launch_with_cost(kernel, [1, 1, 1], cost).unwrap();
    program
}

fn order(index: u32, program: JobProgram) -> Order {
    Order {
        job: job(index),
        class: LatencyClass::Batch,
        program: Arc::new(program),
        contents: Vec::new(),
        limit: PATIENCE * 1_000,
    }
}

fn device(spec: &str) -> (Executor, mpsc::Receiver<ExecutorEvent>) {
    let (sender, events) = mpsc::channel();
    let spec: DeviceSpec = spec.parse().unwrap();
    let on_event = move |event| drop(sender.send(event));
    (Executor::start(&spec, ExecutorConfig::default(), on_event).unwrap(), events)
}

fn started(index: u32) -> ExecutorEvent {
    ExecutorEvent::Started { job: job(index) }
}

fn ended(index: u32, device_time_ns: u64, outcome: Result<Vec<Bytes>, JobFailure>) -> ExecutorEvent {
    ExecutorEvent::Finished { job: job(index), device_time_ns, outcome }
}

#[track_caller]
fn next(events: &mpsc::Receiver<ExecutorEvent>) -> ExecutorEvent {
    events.recv_timeout(PATIENCE).expect("an event")
}

#[test]
fn declares_its_score() {
    let (executor, _events) = device("sim:score=250,speed=2");
    assert_eq!(executor.info().kind, DeviceKind::Simulated);
    assert_eq!(executor.info().score.to_bits(), 250.0_f64.to_bits());
}

#[test]
fn a_job_of_no_cost_completes_inside_submit() {
    let (executor, events) = device("sim");
    for index in 0..1_000 {
        executor.submit(order(index, JobProgram::default())).unwrap();
        assert_eq!(events.try_recv(), Ok(started(index)));
        assert_eq!(events.try_recv(), Ok(ended(index, 0, Ok(Vec::new()))));
    }
}

#[test]
fn the_staged_job_starts_when_the_running_one_ends() {
    let (executor, events) = device("sim:speed=2");
    executor.submit(order(1, costing(CostNs(20_000_000)))).unwrap();
    executor.submit(order(2, costing(CostNs(10_000_000)))).unwrap();
    assert_eq!(next(&events), started(1));
    assert_eq!(next(&events), ended(1, 10_000_000, Ok(Vec::new())));
    assert_eq!(next(&events), started(2));
    assert_eq!(next(&events), ended(2, 5_000_000, Ok(Vec::new())));
}

#[test]
fn three_are_held_and_a_fourth_is_refused() {
    let (executor, events) = device("sim");
    executor.submit(order(1, costing(LONG))).unwrap();
    executor.submit(order(2, costing(CostNs(0)))).unwrap();
    executor.submit(order(3, costing(CostNs(0)))).unwrap();
    assert_eq!(executor.submit(order(6, costing(CostNs(0)))), Err(Busy::Full { job: job(6) }));
    executor.abort(job(9));
    executor.abort(job(1));
    assert_eq!(next(&events), started(1));
    let ExecutorEvent::Finished { job: ended_job, outcome, .. } = next(&events) else { panic!("no end") };
    assert_eq!((ended_job, outcome), (job(1), Err(JobFailure::Cancelled)));
    assert_eq!(next(&events), started(2));
    assert_eq!(next(&events), ended(2, 0, Ok(Vec::new())));
    assert_eq!(next(&events), started(3));
    assert_eq!(next(&events), ended(3, 0, Ok(Vec::new())));
    executor.submit(order(4, costing(LONG))).unwrap();
    executor.submit(order(5, costing(LONG))).unwrap();
    executor.abort(job(5));
    assert_eq!(next(&events), started(4));
    assert_eq!(next(&events), ended(5, 0, Err(JobFailure::Cancelled)));
}

#[test]
fn a_job_past_its_limit_ends_with_timeout() {
    let (executor, events) = device("sim");
    let limit = Duration::from_millis(5);
    executor.submit(Order { limit, ..order(1, costing(LONG)) }).unwrap();
    assert_eq!(next(&events), started(1));
    assert_eq!(next(&events), ended(1, 5_000_000, Err(JobFailure::Timeout)));
}

#[test]
fn host_bytes_come_back_over_zeros() {
    let (executor, events) = device("sim");
    let mut program = JobProgram::default();
    let (a, b) = (program.malloc(16).unwrap(), program.malloc(8).unwrap());
    program.memcpy_htod_buffer(a, 4, &[1, 2, 3, 4, 5, 6, 7, 8]).unwrap();
    program.memcpy_dtoh(a, 8, 8).unwrap();
    program.memcpy_htod_buffer(a, 8, &[9; 4]).unwrap();
    program.memcpy_htod_buffer(b, 0, &[255; 8]).unwrap();
    program.memcpy_dtoh(a, 0, 16).unwrap();
    program.memcpy_dtoh(b, 4, 4).unwrap();
    executor.submit(order(1, program)).unwrap();
    assert_eq!(next(&events), started(1));
    let ExecutorEvent::Finished { outcome, .. } = next(&events) else { panic!("no end") };
    let sections: Vec<_> = outcome.unwrap().iter().map(|section| section.to_vec()).collect();
    assert_eq!(
        sections,
        [vec![5, 6, 7, 8, 0, 0, 0, 0], vec![0, 0, 0, 0, 1, 2, 3, 4, 9, 9, 9, 9, 0, 0, 0, 0], vec![255; 4],]
    );
}

#[test]
fn an_invalid_program_ends_its_job_and_frees_the_device() {
    let (executor, events) = device("sim");
    let mut program = JobProgram::default();
    let kernel = program.function(Content { hash: ContentHash([1; 32]), size_bytes: 1 }, "main");
    program.launch(kernel, [70_000, 1, 1]).unwrap();
    executor.submit(order(1, program)).unwrap();
    assert_eq!(next(&events), started(1));
    let ExecutorEvent::Finished { outcome, .. } = next(&events) else { panic!("no end") };
    assert!(matches!(outcome, Err(JobFailure::InvalidProgram(_))), "{outcome:?}");
    executor.submit(order(2, JobProgram::default())).unwrap();
    assert_eq!(next(&events), started(2));
}

#[test]
fn the_next_job_may_be_submitted_from_inside_the_callback() {
    const JOBS: u32 = 10_000;
    let (done, finished) = mpsc::channel();
    let slot = Arc::new(std::sync::OnceLock::<Executor>::new());
    let executor = Arc::clone(&slot);
    let spec: DeviceSpec = "sim".parse().unwrap();
    let on_event = move |event| {
        let ExecutorEvent::Finished { job: ended, .. } = event else { return };
        if ended.job.index.0 < JOBS {
            let next = order(ended.job.index.0 + 1, JobProgram::default());
            executor.get().unwrap().submit(next).unwrap();
        } else {
            done.send(()).unwrap();
        }
    };
    let device = Executor::start(&spec, ExecutorConfig::default(), on_event).unwrap();
    slot.set(device).unwrap();
    slot.get().unwrap().submit(order(1, JobProgram::default())).unwrap();
    finished.recv_timeout(PATIENCE).expect("all jobs done, without recursion");
}

#[test]
fn many_devices_share_one_timer() {
    let (sender, events) = mpsc::channel();
    let specs = vec!["sim:speed=1".parse().unwrap(); 32];
    let executors: Vec<Executor> = (0..)
        .zip(&specs)
        .map(|(index, spec): (u32, _)| {
            let sender = sender.clone();
            let on_event = move |event: ExecutorEvent| drop(sender.send((index, event)));
            Executor::start(spec, ExecutorConfig::default(), on_event).unwrap()
        })
        .collect();
    for (index, executor) in (0..).zip(&executors) {
        executor.submit(order(index, costing(CostNs(1_000_000)))).unwrap();
    }
    let mut ends = vec![0; 32];
    while ends.iter().sum::<u32>() < 32 {
        let (device, event) = events.recv_timeout(PATIENCE).expect("an event");
        if let ExecutorEvent::Finished { job: ended, .. } = event {
            assert_eq!(ended, job(device), "on its own device");
            ends[usize::try_from(device).unwrap()] += 1;
        }
    }
    assert_eq!(ends, vec![1; 32]);
}

fn interactive(index: u32, cost: CostNs) -> Order {
    Order { class: LatencyClass::Interactive, ..order(index, costing(cost)) }
}

fn yielded(index: u32) -> ExecutorEvent {
    ExecutorEvent::Yielded { job: job(index) }
}

fn resumed(index: u32) -> ExecutorEvent {
    ExecutorEvent::Resumed { job: job(index) }
}

/// A job of many launches of a millisecond, whose result holds what it was given.
fn many_launches(launches: u32) -> JobProgram {
    let mut program = JobProgram::default();
    let kernel = program.function(Content { hash: ContentHash([1; 32]), size_bytes: 1 }, "main");
    let buffer = program.malloc(4).unwrap();
    program.memcpy_htod_buffer(buffer, 0, &[1, 2, 3, 4]).unwrap();
    for _ in 0..launches {
        program.launch_with_cost(kernel, [1, 1, 1], CostNs(1_000_000)).unwrap();
    }
    program.memcpy_dtoh(buffer, 0, 4).unwrap();
    program
}

#[test]
fn an_interactive_job_interrupts_a_batch_job_which_then_goes_on() {
    let (executor, events) = device("sim");
    executor.submit(order(1, many_launches(300))).unwrap();
    executor.submit(order(2, costing(CostNs(0)))).unwrap();
    assert_eq!(next(&events), started(1));
    executor.submit(interactive(3, CostNs(1_000_000))).unwrap();
    assert_eq!(next(&events), yielded(1));
    assert_eq!(next(&events), started(3));
    assert_eq!(next(&events), ended(3, 1_000_000, Ok(Vec::new())));
    assert_eq!(next(&events), resumed(1), "before the job that is staged");
    let whole = ended(1, 300_000_000, Ok(vec![Bytes::from_static(&[1, 2, 3, 4])]));
    assert_eq!(next(&events), whole, "its own time, without the interruption's");
    assert_eq!(next(&events), started(2));
    assert_eq!(next(&events), ended(2, 0, Ok(Vec::new())));
    assert!(events.try_recv().is_err(), "each ended once");
}

#[test]
fn a_job_without_launch_boundary_runs_to_its_end() {
    let (executor, events) = device("sim");
    executor.submit(order(1, many_launches(1))).unwrap();
    executor.submit(interactive(2, CostNs(0))).unwrap();
    assert_eq!(next(&events), started(1));
    assert!(matches!(next(&events), ExecutorEvent::Finished { .. }), "its only launch cannot be interrupted");
    assert_eq!(next(&events), started(2));
}

#[test]
fn one_job_is_interrupted_at_a_time_and_never_by_its_own_class() {
    let (executor, events) = device("sim");
    executor.submit(order(1, many_launches(300))).unwrap();
    executor.submit(interactive(2, LONG)).unwrap();
    assert_eq!([next(&events), next(&events), next(&events)], [started(1), yielded(1), started(2)]);
    executor.submit(interactive(3, CostNs(0))).unwrap();
    executor.abort(job(2));
    let ExecutorEvent::Finished { job: ended_job, .. } = next(&events) else { panic!("no end") };
    assert_eq!(ended_job, job(2), "and no interruption before it");
    assert_eq!([next(&events), next(&events)], [started(3), ended(3, 0, Ok(Vec::new()))]);
    assert_eq!(next(&events), resumed(1));
}

#[test]
fn an_interrupted_job_can_be_taken_back() {
    let (executor, events) = device("sim");
    executor.submit(order(1, many_launches(300))).unwrap();
    executor.submit(interactive(2, LONG)).unwrap();
    assert_eq!([next(&events), next(&events), next(&events)], [started(1), yielded(1), started(2)]);
    executor.abort(job(1));
    let ExecutorEvent::Finished { job: ended_job, device_time_ns, outcome } = next(&events) else {
        panic!("no end")
    };
    assert_eq!((ended_job, outcome), (job(1), Err(JobFailure::Cancelled)));
    assert!(device_time_ns > 0 && device_time_ns % 1_000_000 == 0, "whole launches: {device_time_ns}");
    executor.abort(job(2));
    assert!(matches!(next(&events), ExecutorEvent::Finished { .. }), "the device is free then");
}

#[test]
fn the_limit_of_an_interrupted_job_does_not_run_on() {
    let (executor, events) = device("sim");
    let limit = Duration::from_millis(40);
    executor.submit(Order { limit, ..order(1, many_launches(300)) }).unwrap();
    executor.submit(interactive(2, CostNs(60_000_000))).unwrap();
    assert_eq!([next(&events), next(&events), next(&events)], [started(1), yielded(1), started(2)]);
    assert_eq!([next(&events), next(&events)], [ended(2, 60_000_000, Ok(Vec::new())), resumed(1)]);
    assert_eq!(next(&events), ended(1, 40_000_000, Err(JobFailure::Timeout)), "forty of its own");
}
