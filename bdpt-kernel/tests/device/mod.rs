//! Runs programs on this machine's first Vulkan device, as a worker would.
#![allow(dead_code, reason = "each test file uses a part")]

use std::{
    sync::{Arc, Mutex, mpsc},
    time::Duration,
};

use bdpt_kernel::gpu::{LightJob, PackedScene, SceneContents, SplatLayer, TileJob, TileLayer, module_source};
use bytes::Bytes;
use farm_core::{
    id::{AppId, Attempt, ContentHash, Epoch, JobAttempt, JobId, JobIndex, TaskId},
    program::{Content, JobProgram},
};
use gpu_exec::{DeviceSpec, Executor, ExecutorConfig, ExecutorEvent, Order, expand};

use crate::boxes::Prepared;

/// No job of these tests takes a tenth of it.
const LIMIT: Duration = Duration::from_secs(300);

/// A device that runs one job at a time.
pub(crate) struct Device {
    executor: Executor,
    inbox: Mutex<mpsc::Receiver<ExecutorEvent>>,
}

pub(crate) type Contents = Vec<(ContentHash, Bytes)>;

impl Device {
    /// The machine's first device; `submit_target` steers how sliced launches are cut.
    pub(crate) fn open(submit_target: Duration) -> Self {
        let (events, inbox) = mpsc::channel();
        let config = ExecutorConfig { submit_target, ..ExecutorConfig::default() };
        let specs = expand(&[DeviceSpec::All]).unwrap_or_else(|error| panic!("{error}"));
        let executor = Executor::start(&specs[0], config, move |event| drop(events.send(event)))
            .unwrap_or_else(|error| panic!("{error}"));
        Self { executor, inbox: Mutex::new(inbox) }
    }

    /// Runs a program and returns its sections.
    pub(crate) fn run(&self, program: JobProgram, contents: &Contents) -> Vec<Bytes> {
        let inbox = self.inbox.lock().expect("one job at a time");
        let job = JobAttempt {
            job: JobId { app: AppId(1), task: TaskId(0), index: JobIndex(0) },
            attempt: Attempt { epoch: Epoch(1), sequence: 1 },
        };
        let order = Order {
            job,
            class: farm_core::message::LatencyClass::Batch,
            program: Arc::new(program),
            contents: contents.clone(),
            limit: LIMIT,
        };
        self.executor.submit(order).expect("the device is idle");
        loop {
            match inbox.recv_timeout(LIMIT).expect("the executor ends every job within its limit") {
                ExecutorEvent::Started { .. }
                | ExecutorEvent::Yielded { .. }
                | ExecutorEvent::Resumed { .. } => {}
                ExecutorEvent::Finished { outcome, .. } => return outcome.expect("the job is sound"),
                ExecutorEvent::Lost { reason } => panic!("device lost: {reason}"),
            }
        }
    }

    pub(crate) fn tile(&self, prepared: &Prepared, job: TileJob) -> TileLayer {
        let (scene, contents) = register(&prepared.packed, module_source());
        let mut program = JobProgram::default();
        job.program(&scene, &prepared.params, &mut program).expect("the tile is sound");
        job.decode(&self.run(program, &contents)).expect("the sections are the job's")
    }

    pub(crate) fn light(&self, prepared: &Prepared, job: LightJob) -> SplatLayer {
        let (scene, contents) = register(&prepared.packed, module_source());
        let mut program = JobProgram::default();
        job.program(&scene, &prepared.params, &mut program).expect("the range is sound");
        job.decode(&prepared.params, &self.run(program, &contents)).expect("the sections are the job's")
    }
}

/// Names a scene's arrays and a module by their digests, as the SDK does.
pub(crate) fn register(packed: &PackedScene, module: &str) -> (SceneContents, Contents) {
    let mut contents = Contents::new();
    let mut name = |bytes: &[u8]| {
        let hash = ContentHash(*blake3::hash(bytes).as_bytes());
        contents.push((hash, Bytes::copy_from_slice(bytes)));
        Content { hash, size_bytes: bytes.len() as u64 }
    };
    let scene = SceneContents {
        nodes: name(&packed.nodes),
        triangles: name(&packed.triangles),
        shading: name(&packed.shading),
        materials: name(&packed.materials),
        lights: name(&packed.lights),
        module: name(module.as_bytes()),
    };
    (scene, contents)
}
