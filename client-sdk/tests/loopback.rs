//! The SDK against an embedded farm of simulated devices: real coordinator, real workers, real gRPC and QUIC on loopback.
#![allow(clippy::unwrap_used, reason = "a step that fails fails its test")]

use std::{
    collections::BTreeSet,
    net::{Ipv4Addr, TcpListener},
    sync::{Arc, Mutex},
    time::Duration,
};

use client_sdk::{
    Content, CostNs, DispatchError, Farm, FarmError, FarmOptions, Job, JobFailure, JobProgram, JobResult,
    Journal, Requirements, RetrieveError, Task, TaskData, TaskError, TaskGraph, TaskProgress, WaitReason,
    Window,
};
use coordinator::{CoordinatorHandle, CoordinatorOptions};
use farm_core::coordinator::timeline::{Outcome, Segment, TimelineQuery};
use worker::{WorkerHandle, WorkerOptions};

/// A coordinator and its workers.
struct TestFarm {
    coordinator: CoordinatorHandle,
    workers: Vec<WorkerHandle>,
}

impl TestFarm {
    async fn start(workers: usize, devices: &[&str]) -> Self {
        let coordinator = coordinator::start(CoordinatorOptions::embedded()).await.unwrap();
        let mut farm = Self { coordinator, workers: Vec::new() };
        for _ in 0..workers {
            farm.add_worker(devices, |options| options).await;
        }
        farm
    }

    async fn add_worker(&mut self, devices: &[&str], change: impl FnOnce(WorkerOptions) -> WorkerOptions) {
        let specs = devices.iter().map(|device| device.parse().unwrap()).collect();
        let name = format!("worker-{}", self.workers.len());
        let options = WorkerOptions { name, ..WorkerOptions::embedded(self.address(), specs) };
        self.workers.push(worker::start(change(options)).await.unwrap());
    }

    /// One node of two simulated devices.
    async fn simulated() -> Self {
        Self::start(1, &["sim", "sim"]).await
    }

    fn address(&self) -> String {
        self.coordinator.grpc_addr().to_string()
    }

    fn options(&self) -> FarmOptions {
        FarmOptions::new(self.address(), "loopback test")
    }

    async fn connect(&self) -> Farm {
        Farm::connect(self.options()).await.unwrap()
    }

    async fn stop(self) {
        for worker in self.workers {
            worker.drain().await;
        }
        self.coordinator.shutdown().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_large_content_leaves_the_application_once_for_many_nodes() {
    let farm = TestFarm::start(4, &["sim"]).await;
    let app = farm.connect().await;
    const SIZE: u32 = 12 << 20;
    let echoes = || Echoes {
        jobs: 40,
        cost: CostNs(20_000_000),
        module: Some((0..SIZE / 4).flat_map(u32::to_le_bytes).collect()),
        ..Echoes::default()
    };
    let summary = app.run(TaskGraph::new().task("echo", echoes())).await.unwrap();
    // Once, not four times; an overloaded machine may give a second node leave to ask here.
    assert!((SIZE..3 * SIZE).contains(&u32::try_from(summary.uploaded_bytes).unwrap()), "{summary:?}");
    let status = farm.coordinator.status().await.unwrap();
    assert!(
        status.nodes.iter().all(|node| node.devices[0].executed_jobs > 0),
        "every node had the content: {status:?}"
    );
    let again = app.run(TaskGraph::new().task("echo", echoes())).await.unwrap();
    assert_eq!(again.uploaded_bytes, 0, "the nodes have it");
    app.close().await;
    farm.stop().await;
}

/// Seen in `tests/spread.sh` before its bridge let packets through: planned, unreachable, planned again, without an end or a word.
#[tokio::test(flavor = "multi_thread")]
async fn a_run_that_reaches_no_node_ends_and_names_one() {
    let mut farm = TestFarm::start(0, &[]).await;
    let nobody = format!(
        "127.0.0.1:{}",
        std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
    );
    farm.add_worker(&["sim"], |options| WorkerOptions { advertise: vec![nobody.clone()], ..options }).await;
    let options = FarmOptions { patience: Duration::from_millis(500), ..farm.options() };
    let app = Farm::connect(options).await.unwrap();
    let error =
        app.run(TaskGraph::new().task("echo", Echoes { jobs: 3, ..Echoes::default() })).await.unwrap_err();
    let named = matches!(&error, FarmError::NoNodeReached { reason, .. } if reason.contains("node-"));
    assert!(named, "got {error}");
    assert!(error.can_be_retried(), "the network may come back");
    app.close().await;
    farm.stop().await;
}

/// What the jobs of a test brought back, in order of arrival.
type Brought = Arc<Mutex<Vec<u32>>>;

/// Uploads its number and takes it back; a simulated device keeps bytes and computes nothing.
struct Echo {
    number: u32,
    cost: CostNs,
    content: Option<Content>,
    brought: Brought,
    refuse: bool,
}

impl Job for Echo {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        let buffer = cmd.malloc(8)?;
        cmd.memcpy_htod_buffer(buffer, 4, &self.number.to_le_bytes())?;
        if let Some(module) = self.content {
            let kernel = cmd.function(module, "main");
            cmd.launch_with_cost(kernel, [1, 1, 1], self.cost)?;
        }
        cmd.memcpy_dtoh(buffer, 4, 4)?;
        cmd.memcpy_dtoh(buffer, 0, 8)
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        let number = result.section(0, 4)?;
        assert_eq!(&result.section(1, 8)?[4..], &number[..], "both copies are of one buffer");
        if self.refuse {
            return Err(RetrieveError::application("refused by the test"));
        }
        self.brought.lock().unwrap().push(u32::from_le_bytes([number[0], number[1], number[2], number[3]]));
        Ok(())
    }
}

/// Echo jobs, `chain` of which follow one after the other.
#[derive(Default)]
struct Echoes {
    jobs: u32,
    chain: u32,
    cost: CostNs,
    /// Bytes of a module that every job names.
    module: Option<Vec<u8>>,
    content: Option<Content>,
    brought: Brought,
    refuse: Option<u32>,
    real: bool,
}

impl Echoes {
    fn job(&self, number: u32) -> Box<dyn Job> {
        let brought = Arc::clone(&self.brought);
        let refuse = self.refuse == Some(number);
        Box::new(Echo { number, cost: self.cost, content: self.content, brought, refuse })
    }
}

impl Task for Echoes {
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        self.content = self.module.take().map(|bytes| data.module(bytes));
        Ok(())
    }

    fn requirements(&self) -> Requirements {
        if self.real { Requirements::ANY_REAL } else { Requirements::ANY }
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        (0..self.jobs).map(|number| self.job(number)).collect()
    }

    fn more_jobs(&mut self, progress: &TaskProgress) -> Vec<Box<dyn Job>> {
        if self.chain == 0 || !progress.is_idle() {
            return Vec::new();
        }
        self.chain -= 1;
        vec![self.job(u32::try_from(progress.jobs_known).unwrap())]
    }
}

/// Longer than any test.
const HOUR: CostNs = CostNs(3_600_000_000_000);

fn module() -> Option<Vec<u8>> {
    Some(b"@compute @workgroup_size(1) fn main() {}".to_vec())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_job_comes_back_once() {
    let farm = TestFarm::simulated().await;
    // A window far smaller than the jobs, so that it moves.
    let window = Window { jobs: 200, ..Window::default() };
    let app = Farm::connect(FarmOptions { window, ..farm.options() }).await.unwrap();
    let brought = Brought::default();
    let task = Echoes { jobs: 3_000, module: module(), brought: Arc::clone(&brought), ..Echoes::default() };
    let progress = app.progress();
    let summary = app.run(TaskGraph::new().task("echo", task)).await.unwrap();
    assert_eq!((summary.jobs, summary.tasks[0].jobs, summary.replanned), (3_000, 3_000, 0));
    let brought = brought.lock().unwrap().clone();
    assert_eq!(brought.len(), 3_000, "none twice");
    assert_eq!(brought.into_iter().collect::<BTreeSet<_>>(), (0..3_000).collect(), "none missing");
    let last = progress.borrow().clone();
    assert_eq!((last.jobs_done, last.jobs_known, last.nodes, last.waiting), (3_000, 3_000, 1, None));
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_small_window_and_little_room_for_results_lose_nothing() {
    let farm = TestFarm::simulated().await;
    let window = Window { jobs: 7, program_bytes: 1, result_bytes: 1 };
    let app = Farm::connect(FarmOptions { window, ..farm.options() }).await.unwrap();
    let brought = Brought::default();
    let task = Echoes { jobs: 50, brought: Arc::clone(&brought), ..Echoes::default() };
    assert_eq!(app.run(TaskGraph::new().task("echo", task)).await.unwrap().jobs, 50);
    assert_eq!(brought.lock().unwrap().len(), 50);
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn results_wait_on_disk_where_memory_has_no_room_for_them() {
    let folder = tempfile::tempdir().unwrap();
    let mut farm = TestFarm::start(0, &[]).await;
    let cache = Some(folder.path().to_owned());
    farm.add_worker(&["sim", "sim"], |options| WorkerOptions { spool_memory_bytes: 8, cache, ..options })
        .await;
    let window = Window { result_bytes: 1, ..Window::default() };
    let app = Farm::connect(FarmOptions { window, ..farm.options() }).await.unwrap();
    let brought = Brought::default();
    let task = Echoes { jobs: 200, brought: Arc::clone(&brought), ..Echoes::default() };
    assert_eq!(app.run(TaskGraph::new().task("echo", task)).await.unwrap().jobs, 200);
    let brought: BTreeSet<u32> = brought.lock().unwrap().iter().copied().collect();
    assert_eq!(brought, (0..200).collect());
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn jobs_follow_their_results_and_tasks_their_graph() {
    let farm = TestFarm::simulated().await;
    let app = farm.connect().await;
    let brought = Brought::default();
    let first =
        Echoes { jobs: 1, chain: 20, module: module(), brought: Arc::clone(&brought), ..Echoes::default() };
    let second = Echoes { jobs: 1, brought: Arc::clone(&brought), ..Echoes::default() };
    let graph = TaskGraph::new().task("second", second).task("first", first).after("second", "first");
    let summary = app.run(graph).await.unwrap();
    assert_eq!((summary.tasks[0].jobs, summary.tasks[1].jobs), (1, 21));
    let expected: Vec<u32> = (0..21).chain([0]).collect();
    assert_eq!(*brought.lock().unwrap(), expected, "the second task begins when the first is done");
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn runs_go_side_by_side_and_an_error_ends_only_its_own() {
    let farm = TestFarm::simulated().await;
    let app = farm.connect().await;
    let bad = Echoes { jobs: 100, refuse: Some(3), ..Echoes::default() };
    let good = Echoes { jobs: 500, ..Echoes::default() };
    let (bad, good) = tokio::join!(
        app.run(TaskGraph::new().task("bad", bad)),
        app.run(TaskGraph::new().task("good", good)),
    );
    assert_eq!(bad.unwrap_err().to_string(), "task `bad`, job-3, retrieve: refused by the test");
    assert_eq!(good.unwrap().jobs, 500);
    let after = Echoes { jobs: 5, ..Echoes::default() };
    assert_eq!(
        app.run(TaskGraph::new().task("after", after)).await.unwrap().jobs,
        5,
        "the farm is still of use"
    );
    app.close().await;
    farm.stop().await;
}

/// Hears of its failure, like every job that ends without a result.
struct Endless {
    module: Option<Content>,
    failures: Arc<Mutex<Vec<String>>>,
}

impl Job for Endless {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        let kernel = cmd.function(self.module.expect("prepare comes first"), "main");
        cmd.launch_with_cost(kernel, [1, 1, 1], HOUR)
    }

    fn retrieve(&mut self, _: JobResult) -> Result<(), RetrieveError> {
        Err(RetrieveError::application("there cannot be a result"))
    }

    fn failed(&mut self, failure: &JobFailure) {
        self.failures.lock().unwrap().push(format!("{failure:?}"));
    }
}

#[derive(Default)]
struct EndlessTask {
    module: Option<Content>,
    failures: Arc<Mutex<Vec<String>>>,
}

impl Task for EndlessTask {
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        self.module = module().map(|text| data.module(text));
        Ok(())
    }

    fn requirements(&self) -> Requirements {
        Requirements::ANY
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        vec![Box::new(Endless { module: self.module, failures: Arc::clone(&self.failures) })]
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_fails_everywhere_fails_the_run() {
    let mut farm = TestFarm::start(0, &[]).await;
    for _ in 0..2 {
        farm.add_worker(&["sim"], |options| WorkerOptions {
            job_limit: Duration::from_millis(20),
            ..options
        })
        .await;
    }
    let app = farm.connect().await;
    let task = EndlessTask::default();
    let failures = Arc::clone(&task.failures);
    let error = app.run(TaskGraph::new().task("endless", task)).await.unwrap_err();
    let FarmError::JobFailed { task, failure: JobFailure::Poison(last), .. } = &error else {
        panic!("{error}")
    };
    assert_eq!(task, "endless");
    assert!(last.contains("Timeout"), "the last attempt's end is named: {last}");
    assert_eq!(failures.lock().unwrap().len(), 1, "the job hears it once: {failures:?}");
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn jobs_of_a_node_that_vanishes_run_elsewhere() {
    let mut farm = TestFarm::start(1, &["sim:speed=0.001"]).await;
    let app = farm.connect().await;
    let brought = Brought::default();
    // 1 ms of work is 1 s on the slow node: it holds most jobs when it goes.
    let cost = CostNs(1_000_000);
    let task =
        Echoes { jobs: 200, cost, module: module(), brought: Arc::clone(&brought), ..Echoes::default() };
    let mut progress = app.progress();
    let change_nodes = async {
        progress.wait_for(|progress| progress.nodes == 1).await.unwrap();
        let slow = farm.workers.remove(0);
        farm.add_worker(&["sim"], |options| WorkerOptions { name: "late".to_owned(), ..options }).await;
        drop(slow);
    };
    let (outcome, ()) = tokio::join!(app.run(TaskGraph::new().task("echo", task)), change_nodes);
    let summary = outcome.unwrap();
    assert_eq!(summary.jobs, 200);
    assert!(summary.replanned > 0, "{summary:?}");
    assert_eq!(brought.lock().unwrap().iter().copied().collect::<BTreeSet<_>>(), (0..200).collect());
    assert_eq!(brought.lock().unwrap().len(), 200);
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn stopping_ends_a_run_in_order() {
    let farm = TestFarm::simulated().await;
    let app = farm.connect().await;
    let brought = Brought::default();
    // Four jobs of nothing, then jobs of an hour.
    let quick = Echoes { jobs: 4, brought: Arc::clone(&brought), ..Echoes::default() };
    let slow = Echoes { jobs: 10, cost: HOUR, module: module(), ..Echoes::default() };
    let graph = TaskGraph::new().task("quick", quick).task("slow", slow).after("slow", "quick");
    let (stop, mut progress) = (app.stop_handle(), app.progress());
    let stop_when_under_way = async {
        progress.wait_for(|progress| progress.jobs_done == 4 && progress.jobs_known == 14).await.unwrap();
        stop.stop();
    };
    let (outcome, ()) = tokio::join!(app.run(graph), stop_when_under_way);
    let error = outcome.unwrap_err();
    assert!(matches!(error, FarmError::Stopped { jobs_done: 4, jobs_known: 14 }), "{error}");
    assert_eq!(brought.lock().unwrap().len(), 4);
    app.close().await;
    // The devices are free again: a drained worker ends without waiting an hour.
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn waiting_for_a_device_is_said_and_bounded() {
    let farm = TestFarm::simulated().await;
    let app =
        Farm::connect(FarmOptions { patience: Duration::from_millis(300), ..farm.options() }).await.unwrap();
    let mut progress = app.progress();
    let said = async { progress.wait_for(|progress| progress.waiting.is_some()).await.unwrap().waiting };
    let real = Echoes { jobs: 3, real: true, ..Echoes::default() };
    let (outcome, said) = tokio::join!(app.run(TaskGraph::new().task("real", real)), said);
    assert_eq!(said, Some(WaitReason::NoFittingDevice));
    let error = outcome.unwrap_err();
    assert!(matches!(&error, FarmError::NoFittingDevice { task, .. } if task == "real"), "{error}");
    assert!(error.can_be_retried());
    app.close().await;
    farm.stop().await;

    let empty = TestFarm::start(0, &[]).await;
    let app =
        Farm::connect(FarmOptions { patience: Duration::from_millis(300), ..empty.options() }).await.unwrap();
    let task = Echoes { jobs: 1, ..Echoes::default() };
    let error = app.run(TaskGraph::new().task("any", task)).await.unwrap_err();
    assert!(matches!(error, FarmError::NoFittingDevice { reason: WaitReason::NoNode, .. }), "{error}");
    app.close().await;
    empty.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_absent_coordinator_is_named() {
    // A port that was free a moment ago: nobody listens there.
    let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap().local_addr().unwrap().to_string();
    let error = Farm::connect(FarmOptions::new(&free, "test")).await.unwrap_err();
    assert!(matches!(&error, FarmError::Unreachable { address, .. } if *address == free), "{error}");

    // One that takes connections and says nothing.
    let mute = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = mute.local_addr().unwrap().to_string();
    let options =
        FarmOptions { connect_timeout: Duration::from_millis(300), ..FarmOptions::new(&address, "test") };
    let error = Farm::connect(options).await.unwrap_err();
    assert!(matches!(&error, FarmError::Unreachable { address: named, .. } if *named == address), "{error}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lost_coordinator_ends_the_run_after_a_while() {
    let farm = TestFarm::simulated().await;
    let reconnect_timeout = Duration::from_millis(500);
    let app = Farm::connect(FarmOptions { reconnect_timeout, ..farm.options() }).await.unwrap();
    let slow = Echoes { jobs: 2, cost: HOUR, module: module(), ..Echoes::default() };
    let mut progress = app.progress();
    let TestFarm { coordinator, workers } = farm;
    let lose_it = async {
        progress.wait_for(|progress| progress.nodes == 1).await.unwrap();
        coordinator.shutdown().await;
    };
    let (outcome, ()) = tokio::join!(app.run(TaskGraph::new().task("slow", slow)), lose_it);
    let error = outcome.unwrap_err();
    assert!(matches!(error, FarmError::CoordinatorLost { .. }), "{error}");
    let again =
        app.run(TaskGraph::new().task("again", Echoes { jobs: 1, ..Echoes::default() })).await.unwrap_err();
    assert!(matches!(again, FarmError::CoordinatorLost { .. }), "a lost farm stays lost: {again}");
    app.close().await;
    drop(workers);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_coordinator_that_comes_back_is_found_again() {
    let state = tempfile::tempdir().unwrap();
    let options =
        CoordinatorOptions { state: Some(state.path().to_owned()), ..CoordinatorOptions::embedded() };
    let coordinator = coordinator::start(options.clone()).await.unwrap();
    let address = coordinator.grpc_addr();
    let mut farm = TestFarm { coordinator, workers: Vec::new() };
    farm.add_worker(&["sim"], |options| options).await;
    let app = farm.connect().await;
    let brought = Brought::default();
    // 20 ms each; the second task needs a plan of the coordinator that came back.
    let cost = CostNs(20_000_000);
    let first =
        Echoes { jobs: 30, cost, module: module(), brought: Arc::clone(&brought), ..Echoes::default() };
    let second = Echoes { jobs: 5, brought: Arc::clone(&brought), ..Echoes::default() };
    let graph = TaskGraph::new().task("first", first).task("second", second).after("second", "first");
    let mut progress = app.progress();
    let TestFarm { coordinator, workers } = farm;
    let restart = async {
        progress.wait_for(|progress| progress.jobs_done >= 3).await.unwrap();
        coordinator.shutdown().await;
        coordinator::start(CoordinatorOptions { listen: address, ..options }).await.unwrap()
    };
    let (outcome, coordinator) = tokio::join!(app.run(graph), restart);
    assert_eq!(outcome.unwrap().jobs, 35);
    let brought = brought.lock().unwrap().clone();
    let expected: Vec<u32> = (0..30).chain(0..5).collect();
    assert_eq!(brought, expected, "one device runs them in order, and none again");
    app.close().await;
    TestFarm { coordinator, workers }.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dropped_run_and_a_closed_farm_leave_nothing_behind() {
    let farm = TestFarm::simulated().await;
    let app = farm.connect().await;
    let slow = Echoes { jobs: 2, cost: HOUR, module: module(), ..Echoes::default() };
    let mut progress = app.progress();
    tokio::select! {
        outcome = app.run(TaskGraph::new().task("slow", slow)) => panic!("an hour's job is done: {outcome:?}"),
        _ = progress.wait_for(|progress| progress.nodes == 1) => {}
    }
    progress.wait_for(|progress| progress.active_tasks.is_empty()).await.unwrap();
    let quick = Echoes { jobs: 10, ..Echoes::default() };
    assert_eq!(
        app.run(TaskGraph::new().task("quick", quick)).await.unwrap().jobs,
        10,
        "the devices are free again"
    );
    app.close().await;
    let status = farm.coordinator.status().await.expect("the coordinator runs");
    assert!(status.apps.is_empty(), "goodbye was said: {:?}", status.apps);
    farm.stop().await;
}

/// Jobs executed by each node, in order of registration.
async fn executed(farm: &TestFarm) -> Vec<u64> {
    let status = farm.coordinator.status().await.unwrap();
    status.nodes.iter().map(|node| node.devices.iter().map(|device| device.executed_jobs).sum()).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn stealing_between_nodes_mends_a_wrong_score() {
    let mut farm = TestFarm::start(1, &["sim:score=9000"]).await;
    farm.add_worker(&["sim:score=1000"], |options| options).await;
    let app = Farm::connect(FarmOptions { global_stealing: true, ..farm.options() }).await.unwrap();
    let brought = Brought::default();
    let cost = CostNs(10_000_000);
    let task =
        Echoes { jobs: 200, cost, module: module(), brought: Arc::clone(&brought), ..Echoes::default() };
    assert_eq!(app.run(TaskGraph::new().task("echo", task)).await.unwrap().jobs, 200);
    let brought = brought.lock().unwrap().clone();
    assert_eq!(brought.len(), 200, "none twice");
    assert_eq!(brought.into_iter().collect::<BTreeSet<_>>(), (0..200).collect(), "none missing");
    // By the scores the second one gets 20 jobs; it is as fast as the first.
    let executed = executed(&farm).await;
    assert!(executed[1] > 30, "executed: {executed:?}");
    app.close().await;
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_node_that_joins_takes_over_queued_jobs() {
    let mut farm = TestFarm::start(1, &["sim"]).await;
    let app = farm.connect().await;
    let mut progress = app.progress();
    let task = Echoes { jobs: 300, cost: CostNs(10_000_000), module: module(), ..Echoes::default() };
    let join = async {
        progress.wait_for(|progress| progress.jobs_done >= 5).await.unwrap();
        farm.add_worker(&["sim"], |options| options).await;
    };
    let (outcome, ()) = tokio::join!(app.run(TaskGraph::new().task("echo", task)), join);
    assert_eq!(outcome.unwrap().jobs, 300);
    let executed = executed(&farm).await;
    assert!(executed[1] > 0, "executed: {executed:?}");
    app.close().await;
    farm.stop().await;
}

/// The refusal and the end of the session often come in one piece; the reason must win every time.
#[tokio::test]
async fn an_application_that_is_refused_hears_why() {
    let farm = TestFarm::start(0, &[]).await;
    for _ in 0..50 {
        let options = FarmOptions { policy: "nonesuch".to_owned(), ..farm.options() };
        let refused = Farm::connect(options).await.expect_err("there is no such policy");
        assert!(
            matches!(&refused, FarmError::Refused { reason, .. } if reason.contains("nonesuch")),
            "{refused}"
        );
    }
    farm.stop().await;
}

/// Scenario 9: what was retrieved before the end is not computed again, and is retrieved again in the new process.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_application_that_ends_in_mid_run_goes_on_from_its_journal() {
    const JOBS: u32 = 400;
    let folder = tempfile::tempdir().unwrap();
    let open = || Journal::open(folder.path().join("journal"), "echoes").unwrap();
    let mut farm = TestFarm::start(2, &["sim", "sim"]).await;
    let graph = |brought: &Brought| {
        let brought = Arc::clone(brought);
        let cost = CostNs(1_000_000);
        TaskGraph::new()
            .task("echo", Echoes { jobs: JOBS, cost, module: module(), brought, ..Echoes::default() })
    };
    // What is on its way at the end is computed again: this many at most, 2 %.
    let window = Window { jobs: 8, ..Window::default() };

    let first = Brought::default();
    let app = Farm::connect(FarmOptions { window, ..farm.options() }).await.unwrap();
    let mut progress = app.progress();
    tokio::select! {
        outcome = app.run_journalled(graph(&first), open()) => panic!("it was to end before: {outcome:?}"),
        _ = progress.wait_for(|progress| progress.jobs_done >= u64::from(JOBS) / 2) => {}
    }
    progress.wait_for(|progress| progress.active_tasks.is_empty()).await.unwrap();
    drop(app);
    let first = u64::try_from(first.lock().unwrap().len()).unwrap();
    let journal = open();
    assert_eq!(journal.results(), first, "all that was retrieved is kept");

    let second = Brought::default();
    let app = farm.connect().await;
    let summary = app.run_journalled(graph(&second), journal).await.unwrap();
    assert_eq!((summary.jobs, summary.journalled), (u64::from(JOBS), first));
    assert_eq!(app.progress().borrow().jobs_journalled, first);
    let brought = second.lock().unwrap().clone();
    assert_eq!(brought.len(), JOBS as usize, "none twice");
    assert_eq!(brought.into_iter().collect::<BTreeSet<_>>(), (0..JOBS).collect(), "none missing");
    // What was on its way when its application left is not counted by the coordinator; the window bounds it.
    let executed = executed(&farm).await.iter().sum::<u64>() + u64::try_from(window.jobs).unwrap();
    println!("s09: {first} of {JOBS} retrieved before the end, at most {executed} executed in all");
    assert!(executed <= u64::from(JOBS) * 21 / 20, "executed {executed}");
    app.close().await;

    // Nothing is left to do: no device is needed.
    for worker in farm.workers.drain(..) {
        worker.drain().await;
    }
    let third = Brought::default();
    let app = farm.connect().await;
    assert_eq!(app.run_journalled(graph(&third), open()).await.unwrap().journalled, u64::from(JOBS));
    assert_eq!(third.lock().unwrap().len(), JOBS as usize);
    app.close().await;
    farm.stop().await;
}

/// Scenario 9, the process killed: its queue at the nodes would be computed beside the run that goes on, for a lease of 30 s.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_that_goes_on_ends_its_predecessor_at_once() {
    const JOBS: u32 = 400;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("journal");
    let farm = TestFarm::start(2, &["sim", "sim"]).await;
    let graph = || {
        let cost = CostNs(20_000_000);
        TaskGraph::new().task("echo", Echoes { jobs: JOBS, cost, module: module(), ..Echoes::default() })
    };
    let (options, first_graph) = (farm.options(), graph());
    let journal = Journal::open(&path, "echoes").unwrap();
    let killed = std::thread::spawn(move || {
        // As a process that is killed: from one moment on none of its tasks says another word.
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let app = runtime.block_on(Farm::connect(options)).unwrap();
        let mut progress = app.progress();
        runtime.block_on(async {
            tokio::select! {
                outcome = app.run_journalled(first_graph, journal) => panic!("it was to be killed: {outcome:?}"),
                _ = progress.wait_for(|progress| progress.jobs_done >= u64::from(JOBS) / 2) => {}
            }
        });
        drop(runtime);
        progress
    });
    let mut progress = tokio::task::spawn_blocking(|| killed.join().unwrap()).await.unwrap();
    // With the last one who could tell of progress the journal is free.
    while progress.changed().await.is_ok() {}

    let journal = Journal::open(&path, "echoes").unwrap();
    let kept = journal.results();
    let app = farm.connect().await;
    let summary = app.run_journalled(graph(), journal).await.unwrap();
    assert_eq!((summary.jobs, summary.journalled), (u64::from(JOBS), kept));
    app.close().await;

    let everything = TimelineQuery { app: None, task: None, max_segments: 10_000 };
    let timeline = proto::control::timeline(&farm.address(), None, everything).await.unwrap();
    let completed = timeline.segments.iter().filter(|segment| segment.outcome == Outcome::Completed);
    let predecessor = timeline.segments.iter().map(|segment| segment.job.job.app).min();
    let (before, since): (Vec<&Segment>, Vec<&Segment>) =
        completed.partition(|segment| Some(segment.job.job.app) == predecessor);
    let first_end = since.iter().map(|segment| segment.ended_at).min().unwrap();
    let late = before.iter().filter(|segment| segment.started_at > first_end).count();
    assert_eq!(late, 0, "of the predecessor nothing begins any more");
    // What each of the four devices ran when its application left is not told, and was for nothing too.
    let again = before.len() + since.len() + 4 - JOBS as usize;
    println!(
        "s09: killed with {kept} of {JOBS} in the journal, at most {again} computed again, bar 20 (5 %)"
    );
    assert!(again <= JOBS as usize / 20, "{again}: {} before, {} since", before.len(), since.len());
    farm.stop().await;
}

/// The last results are acknowledged too: no node keeps what is in the journal.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_in_the_journal_is_acknowledged() {
    let folder = tempfile::tempdir().unwrap();
    let mut farm = TestFarm::start(0, &[]).await;
    // Room for the results of two jobs: without acknowledgements the third would wait for ever.
    farm.add_worker(&["sim"], |options| WorkerOptions { spool_quota_bytes: 24, ..options }).await;
    let app = farm.connect().await;
    let brought = Brought::default();
    let task = Echoes { jobs: 200, brought: Arc::clone(&brought), ..Echoes::default() };
    let journal = Journal::open(folder.path().join("journal"), "echoes").unwrap();
    assert_eq!(app.run_journalled(TaskGraph::new().task("echo", task), journal).await.unwrap().jobs, 200);
    assert_eq!(brought.lock().unwrap().len(), 200);
    app.close().await;
    farm.stop().await;
}
