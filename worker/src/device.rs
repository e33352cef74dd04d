//! The node's devices as the owner task sees them; and what executors say, with each result's digest computed where the
//! result was made, not on the owner task.

use std::collections::VecDeque;

use bytes::Bytes;
use farm_core::{
    id::{ContentHash, DeviceIndex, JobAttempt},
    message::JobFailure,
};
use gpu_exec::ExecutorEvent;

use crate::executor::{Executor, Order};

/// An executor's jobs: one running, one staged, one that interrupts or is interrupted.
const EXECUTOR_DEPTH: usize = 3;

/// What an executor says.
#[derive(Debug)]
pub(crate) struct DeviceEvent {
    pub(crate) device: DeviceIndex,
    pub(crate) what: DeviceNews,
}

#[derive(Debug)]
pub(crate) enum DeviceNews {
    Started(JobAttempt),
    Yielded(JobAttempt),
    Resumed(JobAttempt),
    Finished { job: JobAttempt, device_time_ns: u64, outcome: Result<Payload, JobFailure> },
    Lost(String),
}

/// A result's bytes with what its header says of them.
#[derive(Clone, Debug)]
pub(crate) struct Payload {
    pub(crate) sections: Vec<Bytes>,
    pub(crate) digest: ContentHash,
}

impl DeviceEvent {
    /// Takes an executor's event over; hashes a result.
    pub(crate) fn of(device: DeviceIndex, event: ExecutorEvent) -> Self {
        let what = match event {
            ExecutorEvent::Started { job } => DeviceNews::Started(job),
            ExecutorEvent::Yielded { job } => DeviceNews::Yielded(job),
            ExecutorEvent::Resumed { job } => DeviceNews::Resumed(job),
            ExecutorEvent::Finished { job, device_time_ns, outcome } => {
                DeviceNews::Finished { job, device_time_ns, outcome: outcome.map(Payload::of) }
            }
            ExecutorEvent::Lost { reason } => DeviceNews::Lost(reason),
        };
        Self { device, what }
    }
}

impl Payload {
    /// Hashes a result.
    pub(crate) fn of(sections: Vec<Bytes>) -> Self {
        let mut hasher = blake3::Hasher::new();
        for section in &sections {
            hasher.update(section);
        }
        Self { digest: ContentHash(*hasher.finalize().as_bytes()), sections }
    }
}

/// Bytes of a result.
pub(crate) fn size_of(sections: &[Bytes]) -> u64 {
    sections.iter().map(|section| section.len() as u64).sum()
}

/// A device's executor, and orders that wait while it winds an aborted job up.
#[derive(Debug)]
pub(crate) struct Device {
    executor: Executor,
    /// Orders submitted and not finished.
    held: usize,
    /// At most [`EXECUTOR_DEPTH`]: the machine counts an aborted job's place as free at once.
    waiting: VecDeque<Order>,
}

impl Device {
    pub(crate) const fn new(executor: Executor) -> Self {
        Self { executor, held: 0, waiting: VecDeque::new() }
    }

    /// Hands an order over, or keeps it until there is room.
    pub(crate) fn execute(&mut self, order: Order) {
        self.waiting.push_back(order);
        self.submit_waiting();
    }

    /// A job ended: there is room for a waiting one.
    pub(crate) fn finished(&mut self) {
        self.held = self.held.saturating_sub(1);
        self.submit_waiting();
    }

    /// Takes a job back. One that had not reached the executor is not heard of again.
    pub(crate) fn abort(&mut self, job: JobAttempt) {
        let before = self.waiting.len();
        self.waiting.retain(|order| order.job != job);
        if self.waiting.len() == before {
            self.executor.abort(job);
        }
    }

    fn submit_waiting(&mut self) {
        while self.held < EXECUTOR_DEPTH {
            let Some(order) = self.waiting.pop_front() else { return };
            let job = order.job;
            match self.executor.submit(order) {
                Ok(()) => self.held += 1,
                // Only a lost device is busy below its depth; it says so itself, and the machine moves its jobs.
                Err(busy) => {
                    tracing::warn!(%job, %busy, "an executor took no order");
                    return;
                }
            }
        }
    }
}
