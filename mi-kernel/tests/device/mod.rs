//! Runs programs on this machine's first Vulkan device, as a worker would.

use std::{
    sync::{Arc, mpsc},
    time::Duration,
};

use bytes::Bytes;
use farm_core::{
    id::{AppId, Attempt, ContentHash, Epoch, JobAttempt, JobId, JobIndex, TaskId},
    program::{Content, JobProgram},
};
use gpu_exec::{DeviceSpec, Executor, ExecutorConfig, ExecutorEvent, Order, expand};
use mi_kernel::{
    Accumulators, PairSums, Reference, Seed,
    gpu::{AlignmentContents, MiJob, PackedAlignment, Pass, Shape, module_source},
};

/// No job of these tests takes a tenth of it.
const LIMIT: Duration = Duration::from_secs(300);

/// A device that runs one job at a time.
pub(crate) struct Device {
    executor: Executor,
    inbox: mpsc::Receiver<ExecutorEvent>,
}

/// Contents by their digest, as an order carries them.
type Contents = Vec<(ContentHash, Bytes)>;

fn register(contents: &mut Contents, bytes: &[u8]) -> Content {
    let hash = ContentHash(*blake3::hash(bytes).as_bytes());
    contents.push((hash, Bytes::copy_from_slice(bytes)));
    Content { hash, size_bytes: bytes.len() as u64 }
}

impl Device {
    /// The machine's first device; `submit_target` steers how sliced launches are cut.
    pub(crate) fn open(submit_target: Duration) -> Self {
        let (events, inbox) = mpsc::channel();
        let config = ExecutorConfig { submit_target, ..ExecutorConfig::default() };
        let specs = expand(&[DeviceSpec::All]).unwrap_or_else(|error| panic!("{error}"));
        let executor = Executor::start(&specs[0], config, move |event| drop(events.send(event)))
            .unwrap_or_else(|error| panic!("{error}"));
        Self { executor, inbox }
    }

    /// Observed scores.
    pub(crate) fn observed(&self, reference: &Reference<'_>, shape: &Shape) -> Vec<i32> {
        let job = MiJob { seed: Seed(0), pass: Pass::Observed };
        let sections = self.run(&job, reference, shape);
        job.scores(shape, &sections).expect("the sections are the job's").remove(0)
    }

    /// The sums of a pass over iterations.
    pub(crate) fn sums(&self, reference: &Reference<'_>, shape: &Shape, job: &MiJob) -> Accumulators {
        let mut sums = Accumulators::new(reference.alignment().l());
        sums.merge_parts(vec![self.part(reference, shape, job)]).expect("the job is of all pairs");
        sums
    }

    /// The sums of a pass over iterations for some of the pairs.
    pub(crate) fn part(&self, reference: &Reference<'_>, shape: &Shape, job: &MiJob) -> PairSums {
        let sections = self.run(job, reference, shape);
        job.sums(shape, reference.observed(), &sections).expect("the sections are the job's")
    }

    fn run(&self, job: &MiJob, reference: &Reference<'_>, shape: &Shape) -> Vec<Bytes> {
        let packed = PackedAlignment::new(reference, shape);
        let mut contents = Contents::new();
        let named = AlignmentContents {
            codes: register(&mut contents, &packed.codes),
            orders: packed.orders.iter().map(|order| register(&mut contents, order)).collect(),
            bounds: register(&mut contents, &packed.bounds),
            table: register(&mut contents, &packed.table),
            column_terms: register(&mut contents, &packed.column_terms),
            module: register(&mut contents, module_source(shape).as_bytes()),
        };
        let observed: Vec<Content> = shape
            .observed_bytes(reference.observed())
            .iter()
            .map(|bytes| register(&mut contents, bytes))
            .collect();
        let mut program = JobProgram::default();
        job.program(shape, &named, &observed, &mut program).expect("the job is sound");
        let job = JobAttempt {
            job: JobId { app: AppId(1), task: TaskId(0), index: JobIndex(0) },
            attempt: Attempt { epoch: Epoch(1), sequence: 1 },
        };
        let order = Order {
            job,
            class: farm_core::message::LatencyClass::Batch,
            program: Arc::new(program),
            contents,
            limit: LIMIT,
        };
        self.executor.submit(order).expect("the device is idle");
        loop {
            match self.inbox.recv_timeout(LIMIT).expect("the executor ends every job within its limit") {
                ExecutorEvent::Started { .. }
                | ExecutorEvent::Yielded { .. }
                | ExecutorEvent::Resumed { .. } => {}
                ExecutorEvent::Finished { outcome, .. } => return outcome.expect("the job is sound"),
                ExecutorEvent::Lost { reason } => panic!("device lost: {reason}"),
            }
        }
    }
}
