//! Executors as processes of the real binary, on lavapipe or a GPU: they may die at any time, and cost no more than what was on
//! their device.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{
    collections::BTreeMap,
    fs,
    process::Command,
    sync::{Arc, Mutex},
    time::Duration,
};

use bytes::Bytes;
use client_sdk::{
    Content, DispatchError, Farm, FarmError, FarmOptions, Job, JobFailure, JobProgram, JobResult,
    RetrieveError, Task, TaskData, TaskError, TaskGraph, WaitReason,
};
use coordinator::{CoordinatorHandle, CoordinatorOptions};
use gpu_exec::DeviceSpec;
use worker::{Isolation, WorkerHandle, WorkerOptions};

/// Dependent multiplications in each of 64 invocations a workgroup. lavapipe ends loops after 65,535 rounds, whatever is asked.
const SPIN: &str = "
@group(0) @binding(0) var<storage, read> start: array<u32>;
@group(0) @binding(1) var<storage, read_write> out: array<u32>;
@group(0) @binding(2) var<storage, read> number_and_rounds: array<u32, 2>;
@compute @workgroup_size(64) fn spin(@builtin(global_invocation_id) id: vec3u) {
    var x = start[0] + number_and_rounds[0] + id.x + id.y * 64u;
    for (var i = 0u; i < number_and_rounds[1]; i++) { x = (x ^ (x >> 13u)) * 1664525u + i; }
    out[id.x + id.y * 64u] = x;
}";

/// Far more than a job takes.
const PATIENCE: Duration = Duration::from_secs(120);

/// The device under test; a GPU where the variable names one.
fn device() -> DeviceSpec {
    std::env::var("GLEANER_TEST_DEVICE").map_or(DeviceSpec::Cpu, |spec| spec.parse().unwrap())
}

/// A test looks for the executors of its own process: no two at a time.
static ONE_FARM: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());

/// A coordinator and one worker of one lavapipe device.
struct TestFarm {
    _only: tokio::sync::MutexGuard<'static, ()>,
    coordinator: CoordinatorHandle,
    worker: WorkerHandle,
}

impl TestFarm {
    async fn start(isolation: Isolation, job_limit: Duration) -> Self {
        let only = ONE_FARM.lock().await;
        let coordinator = coordinator::start(CoordinatorOptions::embedded()).await.unwrap();
        let address = coordinator.grpc_addr().to_string();
        let options =
            WorkerOptions { isolation, job_limit, ..WorkerOptions::embedded(address, vec![device()]) };
        Self { _only: only, coordinator, worker: worker::start(options).await.unwrap() }
    }

    /// With the executor in a process of the binary under test.
    async fn apart(job_limit: Duration) -> Self {
        Self::start(Isolation::Processes(env!("CARGO_BIN_EXE_farm-worker").into()), job_limit).await
    }

    async fn connect(&self) -> Farm {
        let address = self.coordinator.grpc_addr().to_string();
        Farm::connect(FarmOptions::new(address, "executor test")).await.unwrap()
    }

    async fn stop(self) {
        self.worker.drain().await;
        self.coordinator.shutdown().await;
        while !executors().is_empty() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }
}

/// Results by job number.
type Brought = Arc<Mutex<BTreeMap<u32, Bytes>>>;

/// Jobs of `groups` workgroups each, and so many rounds.
struct Spins {
    jobs: u32,
    groups: u32,
    rounds: u32,
    shared: Option<(Content, Content)>,
    brought: Brought,
}

impl Spins {
    fn new(jobs: u32, groups: u32, rounds: u32) -> Self {
        Self { jobs, groups, rounds, shared: None, brought: Brought::default() }
    }
}

impl Task for Spins {
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        // A content beyond the socket's buffer.
        let start = vec![7; 4 << 20];
        self.shared = Some((data.module(SPIN), data.allocation(start)));
        Ok(())
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        let job = |number| {
            let Self { groups, rounds, .. } = *self;
            let shared = self.shared.unwrap();
            Box::new(Spin { number, groups, rounds, shared, brought: Arc::clone(&self.brought) })
                as Box<dyn Job>
        };
        (0..self.jobs).map(job).collect()
    }
}

struct Spin {
    number: u32,
    groups: u32,
    rounds: u32,
    shared: (Content, Content),
    brought: Brought,
}

impl Spin {
    fn result_bytes(&self) -> u64 {
        u64::from(self.groups) * 256
    }
}

impl Job for Spin {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        let (module, start) = self.shared;
        let kernel = cmd.function(module, "spin");
        let out = cmd.malloc(self.result_bytes())?;
        let own = cmd.malloc(8)?;
        cmd.memcpy_htod_buffer(own, 0, &self.number.to_le_bytes())?;
        cmd.memcpy_htod_buffer(own, 4, &self.rounds.to_le_bytes())?;
        let start = cmd.task_allocation(start);
        cmd.param_in(kernel, 0, start)?;
        cmd.param_in_out(kernel, 1, out)?;
        cmd.param_in(kernel, 2, own)?;
        cmd.launch(kernel, [1, self.groups, 1])?;
        cmd.memcpy_dtoh(out, 0, self.result_bytes())
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        let bytes = result.section(0, usize::try_from(self.result_bytes()).unwrap())?;
        let before = self.brought.lock().unwrap().insert(self.number, bytes);
        assert!(before.is_none(), "job {} came twice", self.number);
        Ok(())
    }
}

async fn spin(app: &Farm, jobs: u32, groups: u32) -> Result<BTreeMap<u32, Bytes>, FarmError> {
    run(app, Spins::new(jobs, groups, 60_000)).await
}

async fn run(app: &Farm, task: Spins) -> Result<BTreeMap<u32, Bytes>, FarmError> {
    let brought = Arc::clone(&task.brought);
    app.run(TaskGraph::new().task("spin", task)).await?;
    Ok(std::mem::take(&mut *brought.lock().unwrap()))
}

/// The executor processes of this test process.
fn executors() -> Vec<u32> {
    let parent = format!("PPid:\t{}", std::process::id());
    let processes = fs::read_dir("/proc").unwrap().filter_map(|entry| {
        let entry = entry.unwrap();
        let pid = entry.file_name().to_str()?.parse().ok()?;
        let status = fs::read_to_string(entry.path().join("status")).ok()?;
        let command = fs::read_to_string(entry.path().join("cmdline")).ok()?;
        (status.contains(&parent) && command.contains("\0executor\0")).then_some(pid)
    });
    processes.collect()
}

fn kill(pid: u32, signal: &str) {
    // One that has ended meanwhile is as good.
    let _ = Command::new("kill").arg(signal).arg(pid.to_string()).status().unwrap();
}

/// The executor that came in the place of `before`.
async fn successor(before: u32) -> u32 {
    loop {
        if let Some(next) = executors().into_iter().find(|pid| *pid != before) {
            return next;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn results_are_those_of_an_executor_in_the_same_process() {
    let farm = TestFarm::start(Isolation::None, PATIENCE).await;
    let app = farm.connect().await;
    let expected = spin(&app, 12, 2).await.unwrap();
    app.close().await;
    farm.stop().await;

    let farm = TestFarm::apart(PATIENCE).await;
    let app = farm.connect().await;
    assert_eq!(executors().len(), 1, "one process a device");
    assert!(spin(&app, 12, 2).await.unwrap() == expected, "the bytes differ");
    assert!(spin(&app, 12, 3).await.unwrap() != expected, "the comparison sees a difference");
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn executors_that_crash_cost_attempts_and_nothing_else() {
    let farm = TestFarm::apart(PATIENCE).await;
    let app = farm.connect().await;
    let expected = spin(&app, 40, 8).await.unwrap();
    let mut progress = app.progress();
    let killer = async {
        let mut victim = executors()[0];
        for (done, signal) in [(3, "-KILL"), (10, "-ABRT"), (20, "-ILL")] {
            progress.wait_for(|progress| progress.jobs_done >= 40 + done).await.unwrap();
            kill(victim, signal);
            victim = successor(victim).await;
        }
    };
    let (disturbed, ()) = tokio::join!(spin(&app, 40, 8), killer);
    assert!(disturbed.unwrap() == expected, "the bytes differ");
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_kernel_that_does_not_end_fails_its_job_and_the_device_comes_back() {
    let farm = TestFarm::apart(Duration::from_secs(1)).await;
    let app = farm.connect().await;
    let before = executors()[0];
    // Minutes on any device, in one launch that cannot be cut.
    let error = run(&app, Spins::new(1, 60_000, u32::MAX)).await.unwrap_err();
    let FarmError::JobFailed { failure: JobFailure::Poison(last), .. } = &error else { panic!("{error}") };
    assert!(last.contains("Timeout"), "{last}");
    assert_eq!(spin(&app, 3, 1).await.unwrap().len(), 3, "the device serves the next ones");
    assert_ne!(executors(), [before], "in another process");
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_executor_that_stops_answering_is_ended() {
    let farm = TestFarm::apart(Duration::from_secs(2)).await;
    let app = farm.connect().await;
    let stopped = executors()[0];
    let mut progress = app.progress();
    let stopper = async {
        progress.wait_for(|progress| progress.jobs_done >= 3).await.unwrap();
        kill(stopped, "-STOP");
    };
    let (done, ()) = tokio::join!(spin(&app, 20, 8), stopper);
    assert_eq!(done.unwrap().len(), 20);
    assert!(!executors().contains(&stopped), "it is gone");
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_device_whose_executor_keeps_ending_for_no_reason_is_lost() {
    let farm = TestFarm::apart(PATIENCE).await;
    let mut victim = executors()[0];
    for _ in 0..3 {
        kill(victim, "-KILL");
        victim = successor(victim).await;
        // It is the device's supervisor that has to see each of them open.
        tokio::time::sleep(Duration::from_secs(2)).await;
    }
    kill(victim, "-KILL");
    let app = farm.connect().await;
    let mut progress = app.progress();
    tokio::select! {
        done = spin(&app, 1, 1) => panic!("it ran: {done:?}"),
        waits = progress.wait_for(|progress| progress.waiting == Some(WaitReason::NoFittingDevice)) => {
            waits.unwrap();
        }
    }
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "prints a figure for people: what a process of its own costs a small job"]
async fn measure_small_jobs_in_the_same_process_and_apart() {
    let apart = Isolation::Processes(env!("CARGO_BIN_EXE_farm-worker").into());
    for round in 0..3 {
        for isolation in [Isolation::None, apart.clone()] {
            let farm = TestFarm::start(isolation.clone(), PATIENCE).await;
            let app = farm.connect().await;
            spin(&app, 20, 1).await.unwrap();
            let begin = std::time::Instant::now();
            spin(&app, 1_000, 1).await.unwrap();
            println!("round {round}, {isolation:?}: {:?} a job", begin.elapsed() / 1_000);
            app.close().await;
            farm.stop().await;
        }
    }
}
