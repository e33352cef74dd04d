//! A device under test, driven synchronously.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc,
    },
    time::Duration,
};

use bytes::Bytes;
use farm_core::{
    id::{AppId, Attempt, ContentHash, Epoch, JobAttempt, JobId, JobIndex, TaskId},
    message::{JobFailure, LatencyClass},
    program::{Content, JobProgram},
};
use gpu_exec::{DeviceSpec, Executor, ExecutorConfig, ExecutorEvent, Host, Order, expand};

/// Far more than any test needs; it only turns a hang into a failure.
const PATIENCE: Duration = Duration::from_secs(120);

pub(crate) struct TestDevice {
    pub(crate) executor: Executor,
    pub(crate) events: mpsc::Receiver<ExecutorEvent>,
    next_job: AtomicU64,
}

pub(crate) fn content(bytes: &[u8]) -> (Content, (ContentHash, Bytes)) {
    let hash = ContentHash(*blake3::hash(bytes).as_bytes());
    let content = Content { hash, size_bytes: bytes.len() as u64 };
    (content, (hash, Bytes::copy_from_slice(bytes)))
}

impl TestDevice {
    pub(crate) fn open() -> Self {
        Self::with(ExecutorConfig::default())
    }

    pub(crate) fn with(config: ExecutorConfig) -> Self {
        Self::hosted(config, |events| move |event| drop(events.send(event)))
    }

    /// With a host of the test's own, which passes the events on.
    pub(crate) fn hosted<H: Host>(
        config: ExecutorConfig,
        host: impl FnOnce(mpsc::Sender<ExecutorEvent>) -> H,
    ) -> Self {
        let specs = expand(&[DeviceSpec::All]).unwrap_or_else(|error| panic!("{error}"));
        let (sender, events) = mpsc::channel();
        let executor =
            Executor::start(&specs[0], config, host(sender)).unwrap_or_else(|error| panic!("{error}"));
        Self { executor, events, next_job: AtomicU64::new(1) }
    }

    /// An order of the next attempt.
    pub(crate) fn order(&self, program: JobProgram, contents: &[(ContentHash, Bytes)]) -> Order {
        let sequence = self.next_job.fetch_add(1, Ordering::Relaxed);
        let job = JobId { app: AppId(1), task: TaskId(1), index: JobIndex(1) };
        Order {
            job: JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence } },
            class: LatencyClass::Batch,
            program: Arc::new(program),
            contents: contents.to_vec(),
            limit: PATIENCE,
        }
    }

    /// Runs one job to its end.
    pub(crate) fn run(&self, order: Order) -> Result<Vec<Bytes>, JobFailure> {
        let job = order.job;
        self.executor.submit(order).unwrap();
        self.finished(job).1
    }

    pub(crate) fn run_program(
        &self,
        program: JobProgram,
        contents: &[(ContentHash, Bytes)],
    ) -> Result<Vec<Bytes>, JobFailure> {
        self.run(self.order(program, contents))
    }

    pub(crate) fn next_event(&self) -> ExecutorEvent {
        self.events.recv_timeout(PATIENCE).expect("an event within the test's patience")
    }

    /// Device time and outcome of `job`, which ends next.
    pub(crate) fn finished(&self, wanted: JobAttempt) -> (u64, Result<Vec<Bytes>, JobFailure>) {
        loop {
            match self.next_event() {
                ExecutorEvent::Started { job } => assert_eq!(job, wanted, "another job started"),
                ExecutorEvent::Finished { job, device_time_ns, outcome } => {
                    assert_eq!(job, wanted, "another job finished");
                    return (device_time_ns, outcome);
                }
                ExecutorEvent::Yielded { job } | ExecutorEvent::Resumed { job } => {
                    panic!("{job} was interrupted")
                }
                ExecutorEvent::Lost { reason } => panic!("device lost: {reason}"),
            }
        }
    }

    /// The text of the `InvalidProgram` that a job has to end with.
    pub(crate) fn invalid(&self, program: JobProgram, contents: &[(ContentHash, Bytes)]) -> String {
        match self.run_program(program, contents) {
            Err(JobFailure::InvalidProgram(text)) => text,
            other => panic!("expected InvalidProgram, got {other:?}"),
        }
    }
}

pub(crate) fn as_u32(section: &Bytes) -> Vec<u32> {
    bytemuck::pod_collect_to_vec(section)
}

pub(crate) fn as_f32(section: &Bytes) -> Vec<f32> {
    bytemuck::pod_collect_to_vec(section)
}
