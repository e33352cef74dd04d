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
    message::{CostNs, JobFailure},
    program::{Content, JobProgram},
};
use gpu_exec::{Busy, DeviceSpec, Executor, ExecutorConfig, ExecutorEvent, Order, open};

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
    Order { job: job(index), program: Arc::new(program), contents: Vec::new(), limit: PATIENCE * 1_000 }
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
    let third = executor.submit(order(3, costing(CostNs(0))));
    // The first may have ended already on a machine that was busy for 10 ms; then there is room.
    if third.is_err() {
        assert_eq!(third, Err(Busy::Full { job: job(3) }));
    }
    assert_eq!(next(&events), started(1));
    assert_eq!(next(&events), ended(1, 10_000_000, Ok(Vec::new())));
    assert_eq!(next(&events), started(2));
    assert_eq!(next(&events), ended(2, 5_000_000, Ok(Vec::new())));
}

#[test]
fn one_runs_one_is_staged_and_a_third_is_refused() {
    let (executor, events) = device("sim");
    executor.submit(order(1, costing(LONG))).unwrap();
    executor.submit(order(2, costing(CostNs(0)))).unwrap();
    assert_eq!(executor.submit(order(3, costing(CostNs(0)))), Err(Busy::Full { job: job(3) }));
    executor.abort(job(9));
    executor.abort(job(1));
    assert_eq!(next(&events), started(1));
    let ExecutorEvent::Finished { job: ended_job, outcome, .. } = next(&events) else { panic!("no end") };
    assert_eq!((ended_job, outcome), (job(1), Err(JobFailure::Cancelled)));
    assert_eq!(next(&events), started(2));
    assert_eq!(next(&events), ended(2, 0, Ok(Vec::new())));
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
    let on_event = move |device, event| drop(sender.send((device, event)));
    let executors = open(&specs, ExecutorConfig::default(), on_event).unwrap();
    for (index, executor) in (0..).zip(&executors) {
        executor.submit(order(index, costing(CostNs(1_000_000)))).unwrap();
    }
    let mut ends = vec![0; 32];
    while ends.iter().sum::<u32>() < 32 {
        let (device, event) = events.recv_timeout(PATIENCE).expect("an event");
        if let ExecutorEvent::Finished { job: ended, .. } = event {
            assert_eq!(ended, job(u32::from(device.0)), "on its own device");
            ends[usize::from(device.0)] += 1;
        }
    }
    assert_eq!(ends, vec![1; 32]);
}
