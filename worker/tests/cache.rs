//! Contents in the caches of nodes: kept on disk over restarts, offered to other nodes from there, dropped on demand.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{fs, path::Path, time::Duration};

use client_sdk::{
    Content, CostNs, DispatchError, Farm, FarmOptions, Job, JobProgram, JobResult, Requirements,
    RetrieveError, RunSummary, Task, TaskData, TaskError, TaskGraph,
};
use coordinator::{CoordinatorHandle, CoordinatorOptions};
use farm_core::{coordinator::ContentsStatus, id::ContentHash, message::CacheFigures};
use proto::control;
use tempfile::TempDir;
use worker::{StartError, WorkerHandle, WorkerOptions};

/// Large enough for the coordinator to be told of.
const LARGE_BYTES: usize = 4 << 20;

/// Some jobs of 10 ms that name one large content.
struct Needs {
    first: u8,
    content: Option<Content>,
}

impl Task for Needs {
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        self.content = Some(data.module(vec![self.first; LARGE_BYTES]));
        Ok(())
    }

    fn requirements(&self) -> Requirements {
        Requirements::ANY
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        let content = self.content.unwrap();
        (0..20).map(|_| Box::new(NeedsIt(content)) as Box<dyn Job>).collect()
    }
}

struct NeedsIt(Content);

impl Job for NeedsIt {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        let kernel = cmd.function(self.0, "main");
        cmd.launch_with_cost(kernel, [1, 1, 1], CostNs(10_000_000))
    }

    fn retrieve(&mut self, _: JobResult) -> Result<(), RetrieveError> {
        Ok(())
    }
}

struct TestFarm {
    coordinator: CoordinatorHandle,
}

impl TestFarm {
    async fn start() -> Self {
        Self { coordinator: coordinator::start(CoordinatorOptions::embedded()).await.unwrap() }
    }

    fn address(&self) -> String {
        self.coordinator.grpc_addr().to_string()
    }

    fn options(&self, name: &str, cache: Option<&Path>) -> WorkerOptions {
        WorkerOptions {
            name: name.to_owned(),
            cache: cache.map(Into::into),
            ..WorkerOptions::embedded(self.address(), vec!["sim".parse().unwrap()])
        }
    }

    async fn worker(&self, name: &str, cache: Option<&Path>) -> WorkerHandle {
        worker::start(self.options(name, cache)).await.unwrap()
    }

    /// Runs the jobs as a new application: what it sends, it sends anew.
    async fn run(&self, first: u8) -> RunSummary {
        let app = Farm::connect(FarmOptions::new(self.address(), "cache test")).await.unwrap();
        let summary = app.run(TaskGraph::new().task("needs", Needs { first, content: None })).await.unwrap();
        app.close().await;
        summary
    }

    async fn contents(&self) -> ContentsStatus {
        control::contents(&self.address(), None).await.unwrap()
    }

    /// The figures of a node's next heartbeat that pass.
    async fn figures(&self, name: &str, wanted: impl Fn(&CacheFigures) -> bool) -> CacheFigures {
        loop {
            let status = self.coordinator.status().await.unwrap();
            let found = status.nodes.iter().find(|node| node.name == name).map(|node| node.cache);
            match found {
                Some(figures) if wanted(&figures) => return figures,
                _ => tokio::time::sleep(Duration::from_millis(20)).await,
            }
        }
    }
}

/// Waits until the folder holds so many contents.
async fn on_disk(folder: &TempDir, count: usize) {
    loop {
        let files = fs::read_dir(folder.path().join("contents")).unwrap();
        if files.filter(|file| file.as_ref().unwrap().file_name().len() == 64).count() == count {
            return;
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_node_that_comes_back_has_what_it_had_and_others_take_it_from_there() {
    let farm = TestFarm::start().await;
    let folder = TempDir::new().unwrap();
    let first = farm.worker("a", Some(folder.path())).await;
    assert_eq!(farm.run(1).await.uploaded_bytes, LARGE_BYTES as u64);
    on_disk(&folder, 1).await;
    let figures = farm.figures("a", |figures| figures.disk_contents == 1).await;
    assert_eq!((figures.fetches, figures.fetched_bytes, figures.disk_hits), (1, LARGE_BYTES as u64, 0));
    first.drain().await;

    let again = farm.worker("a", Some(folder.path())).await;
    let other = farm.worker("b", None).await;
    assert_eq!(farm.run(1).await.uploaded_bytes, 0, "one has it on disk, the other takes it from there");
    farm.figures("b", |figures| figures.fetches == 1).await;
    assert_eq!(farm.contents().await.contents[0].nodes.len(), 2, "the coordinator knows of both");
    again.drain().await;
    other.drain().await;
    farm.coordinator.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_spoilt_file_is_fetched_again() {
    let farm = TestFarm::start().await;
    let folder = TempDir::new().unwrap();
    let worker = farm.worker("a", Some(folder.path())).await;
    farm.run(1).await;
    on_disk(&folder, 1).await;
    worker.drain().await;
    let file = fs::read_dir(folder.path().join("contents")).unwrap().next().unwrap().unwrap().path();
    fs::write(&file, vec![2; LARGE_BYTES]).unwrap();

    let worker = farm.worker("a", Some(folder.path())).await;
    assert_eq!(farm.run(1).await.uploaded_bytes, LARGE_BYTES as u64, "the file was of no use");
    on_disk(&folder, 1).await;
    assert!(fs::read(&file).unwrap() == vec![1; LARGE_BYTES], "it was written anew");
    worker.drain().await;
    farm.coordinator.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn caches_stay_below_their_caps() {
    let farm = TestFarm::start().await;
    let folder = TempDir::new().unwrap();
    let options = WorkerOptions {
        content_cache_bytes: LARGE_BYTES as u64,
        disk_cache_bytes: 2 * LARGE_BYTES as u64,
        ..farm.options("a", Some(folder.path()))
    };
    let worker = worker::start(options).await.unwrap();
    for first in 0..4 {
        farm.run(first).await;
    }
    let figures = farm.figures("a", |figures| figures.disk_evictions == 2).await;
    assert_eq!((figures.memory_contents, figures.memory_evictions), (1, 3));
    assert_eq!((figures.disk_contents, figures.disk_bytes), (2, 2 * LARGE_BYTES as u64));
    on_disk(&folder, 2).await;
    let held: Vec<ContentHash> =
        farm.contents().await.contents.iter().map(|held| held.content.hash).collect();
    assert_eq!(held.len(), 2, "what went from memory is on disk still, what went from there is gone");
    assert_eq!(farm.run(2).await.uploaded_bytes, 0, "from disk");
    assert_eq!(farm.run(0).await.uploaded_bytes, LARGE_BYTES as u64, "it is gone");
    worker.drain().await;
    farm.coordinator.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_operator_has_contents_dropped() {
    let farm = TestFarm::start().await;
    let folder = TempDir::new().unwrap();
    let worker = farm.worker("a", Some(folder.path())).await;
    farm.run(1).await;
    farm.run(2).await;
    on_disk(&folder, 2).await;
    // Its first heartbeat says that it knows of evictions.
    farm.figures("a", |figures| figures.disk_contents == 2).await;
    let held = farm.contents().await.contents;
    let (dropped, kept) = (held[0].content.hash, held[1].content.hash);
    control::evict(&farm.address(), None, Some(worker.info().node), &[dropped]).await.unwrap();
    on_disk(&folder, 1).await;
    farm.figures("a", |figures| (figures.memory_contents, figures.disk_contents) == (1, 1)).await;
    assert_eq!(farm.contents().await.contents[0].content.hash, kept);
    control::evict(&farm.address(), None, None, &[]).await.unwrap();
    on_disk(&folder, 0).await;
    farm.figures("a", |figures| (figures.memory_contents, figures.disk_contents) == (0, 0)).await;
    assert_eq!(farm.contents().await, ContentsStatus::default());
    let unknown = control::evict(&farm.address(), None, Some(farm_core::id::NodeId(99)), &[]).await;
    assert!(unknown.unwrap_err().to_string().contains("node-99"), "the node is named");
    worker.drain().await;
    farm.coordinator.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_folder_that_cannot_be_used_is_named() {
    let farm = TestFarm::start().await;
    let folder = TempDir::new().unwrap();
    let file = folder.path().join("file");
    fs::write(&file, b"").unwrap();
    let error = worker::start(farm.options("a", Some(&file))).await.unwrap_err();
    assert!(matches!(&error, StartError::Cache { path, .. } if *path == file), "{error}");
    farm.coordinator.shutdown().await;
}
