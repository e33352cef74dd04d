//! A farm of real processes, an application that is linked with it, and how much both get done.

use std::{
    path::Path,
    sync::{Arc, Mutex},
    time::Instant,
};

use client_sdk::{
    Content, CostNs, DispatchError, FarmError, FarmOptions, Job, JobProgram, JobResult, Requirements,
    RetrieveError, Task, TaskData, TaskError, TaskGraph,
};
use proto::trust::Identity;
use tempfile::TempDir;
use tests::{Process, farmctl};

use crate::attack::Target;

/// Simulated devices of the worker.
const DEVICES: usize = 4;
/// Device time of a job: nobody computes.
const JOB: CostNs = CostNs(10_000_000);

/// A coordinator and a worker.
pub(crate) struct Besieged {
    pub(crate) coordinator: Process,
    pub(crate) worker: Process,
    pub(crate) target: Target,
    /// Of the operator, in a secured farm.
    operator: Option<Identity>,
    folder: TempDir,
}

impl Besieged {
    /// Everyone who reaches its ports may come in.
    pub(crate) fn open() -> Self {
        Self::start(tempfile::tempdir().unwrap(), &[], |_| Vec::new(), None)
    }

    /// For members.
    pub(crate) fn secured() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).display().to_string();
        let (state, operator, node) = (path("state"), path("operator.pem"), path("node.pem"));
        done(&["init", &state, "--farm", "studio", "--identity", &operator]);
        let identity = Identity::read(Path::new(&operator)).unwrap();
        let join = move |grpc: &str| {
            let token = done(&["--coordinator", grpc, "--identity", &operator, "token", "create", "node"]);
            done(&["--coordinator", grpc, "--identity", &node, "join", token.trim(), "--name", "n"]);
            vec!["--identity".to_owned(), node.clone()]
        };
        Self::start(folder, &["--state", &state], join, Some(identity))
    }

    fn start(
        folder: TempDir,
        flags: &[&str],
        join: impl FnOnce(&str) -> Vec<String>,
        operator: Option<Identity>,
    ) -> Self {
        let address = ["--listen", "127.0.0.1:0"];
        let mut coordinator =
            Process::start("farm-coordinator", [&address[..], &["--http", "127.0.0.1:0"], flags].concat());
        let ready = coordinator.next_json();
        let [grpc, http] = ["grpc", "http"].map(|key| ready[key].as_str().unwrap().to_owned());
        let membership = join(&grpc);
        let mut flags = address.to_vec();
        flags.extend(["--coordinator", &grpc]);
        flags.extend(membership.iter().map(String::as_str));
        flags.extend(["--device", "sim:score=1000,speed=1.0"].repeat(DEVICES));
        let mut worker = Process::start("farm-worker", flags);
        let ready = worker.next_json();
        let data = ready["data"].as_str().unwrap().parse().unwrap();
        let target = Target { grpc: grpc.parse().unwrap(), http: http.parse().unwrap(), data };
        Self { coordinator, worker, target, operator, folder }
    }

    /// Links a new application with it.
    pub(crate) async fn application(&self) -> client_sdk::Farm {
        let options = FarmOptions::new(self.target.grpc.to_string(), "besieged");
        client_sdk::Farm::connect(FarmOptions { identity: self.operator.clone(), ..options }).await.unwrap()
    }

    /// Most memory that the coordinator and the worker have had so far, in bytes.
    pub(crate) fn peaks(&self) -> [u64; 2] {
        [&self.coordinator, &self.worker].map(Process::peak_resident_bytes)
    }

    /// What `farmctl status` says.
    pub(crate) fn status(&self) -> serde_json::Value {
        let grpc = self.target.grpc.to_string();
        let operator = self.folder.path().join("operator.pem").display().to_string();
        let mut arguments = vec!["--coordinator", &grpc, "-o", "json"];
        if self.operator.is_some() {
            arguments.extend(["--identity", &operator]);
        }
        arguments.push("status");
        serde_json::from_str(&done(&arguments)).unwrap()
    }
}

/// What `farmctl` writes.
fn done(arguments: &[&str]) -> String {
    let output = farmctl(arguments);
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Has jobs done, each of which comes back once and with its own bytes; gives jobs per second.
pub(crate) async fn work(app: &client_sdk::Farm, jobs: u32) -> f64 {
    let begun = Instant::now();
    let mut brought = run(app, jobs, "@compute @workgroup_size(1) fn main() {}").await.unwrap();
    let rate = f64::from(jobs) / begun.elapsed().as_secs_f64();
    brought.sort_unstable();
    assert!(brought.iter().copied().eq(0..jobs), "each job once, with its own bytes: {} came", brought.len());
    rate
}

/// Has jobs done that launch this module; gives what came.
pub(crate) async fn run(app: &client_sdk::Farm, jobs: u32, text: &str) -> Result<Vec<u32>, FarmError> {
    let brought = Arc::default();
    let task = Numbers { jobs, text: text.to_owned(), module: None, brought: Arc::clone(&brought) };
    app.run(TaskGraph::new().task("numbers", task)).await?;
    Ok(std::mem::take(&mut *brought.lock().unwrap()))
}

struct Numbers {
    jobs: u32,
    text: String,
    module: Option<Content>,
    brought: Arc<Mutex<Vec<u32>>>,
}

impl Task for Numbers {
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        self.module = Some(data.module(self.text.clone().into_bytes()));
        Ok(())
    }

    fn requirements(&self) -> Requirements {
        Requirements::ANY
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        let module = self.module.expect("prepare comes first");
        let number =
            |number| Box::new(Number { number, module, brought: Arc::clone(&self.brought) }) as Box<dyn Job>;
        (0..self.jobs).map(number).collect()
    }
}

/// Takes a number there and back.
struct Number {
    number: u32,
    module: Content,
    brought: Arc<Mutex<Vec<u32>>>,
}

impl Job for Number {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        let buffer = cmd.malloc(4)?;
        cmd.memcpy_htod_buffer(buffer, 0, &self.number.to_le_bytes())?;
        let kernel = cmd.function(self.module, "main");
        cmd.launch_with_cost(kernel, [1, 1, 1], JOB)?;
        cmd.memcpy_dtoh(buffer, 0, 4)
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        let number = result.section(0, 4)?;
        let number = number.first_chunk().copied().map(u32::from_le_bytes);
        self.brought.lock().unwrap().extend(number);
        Ok(())
    }
}
