//! A device's executor inside this process: for simulated devices, and for farms inside a test.

use std::{collections::HashSet, path::PathBuf, sync::Arc};

use farm_core::{
    device::DeviceInfo,
    id::{ContentHash, DeviceIndex, JobAttempt},
    message::JobFailure,
    program::{Command, JobProgram},
};
use gpu_exec::{Busy, DeviceSpec, ExecutorConfig, ExecutorEvent, OpenError};
use tokio::sync::mpsc;

use super::{Order, decode};
use crate::{
    contents::Shelf,
    device::{DeviceEvent, DeviceNews},
};

/// An executor with what it reads from and reports to.
#[derive(Debug)]
pub(crate) struct InProcess {
    executor: gpu_exec::Executor,
    index: DeviceIndex,
    contents: Shelf,
    events: mpsc::UnboundedSender<DeviceEvent>,
}

impl InProcess {
    /// Opens the device. Blocks while it is measured.
    pub(super) fn start(
        spec: DeviceSpec,
        index: DeviceIndex,
        compiled: Option<PathBuf>,
        contents: Shelf,
        events: mpsc::UnboundedSender<DeviceEvent>,
    ) -> Result<(Self, DeviceInfo), OpenError> {
        let told = events.clone();
        let host = move |event: ExecutorEvent| {
            // The driver is gone only when the worker ends: nobody is left to hear.
            let _ = told.send(DeviceEvent::of(index, event));
        };
        let config = ExecutorConfig { compiled, ..ExecutorConfig::default() };
        let executor = gpu_exec::Executor::start(&spec, config, host)?;
        let info = executor.info().clone();
        Ok((Self { executor, index, contents, events }, info))
    }

    pub(super) fn submit(&self, order: Order) -> Result<(), Busy> {
        let Order { job, class, program, limit } = order;
        match decode(&program.bytes, program.scope) {
            Ok(program) => {
                let contents = named_contents(&program)
                    .into_iter()
                    .filter_map(|hash| Some((hash, self.contents.get(&hash)?.into_bytes())))
                    .collect();
                let program = Arc::new(program);
                self.executor.submit(gpu_exec::Order { job, class, program, contents, limit })
            }
            Err(error) => {
                let outcome = Err(JobFailure::InvalidProgram(error.to_string()));
                let what = DeviceNews::Finished { job, device_time_ns: 0, outcome };
                let _ = self.events.send(DeviceEvent { device: self.index, what });
                Ok(())
            }
        }
    }

    pub(super) fn abort(&self, job: JobAttempt) {
        self.executor.abort(job);
    }
}

/// What a program names, each once.
fn named_contents(program: &JobProgram) -> HashSet<ContentHash> {
    program
        .commands()
        .iter()
        .filter_map(|command| match command {
            Command::TaskAllocation { content, .. } | Command::Function { module: content, .. } => {
                Some(content.hash)
            }
            Command::Malloc { .. }
            | Command::MemcpyHtoD { .. }
            | Command::GlobalHtoD { .. }
            | Command::Param { .. }
            | Command::Launch { .. }
            | Command::MemcpyDtoH { .. } => None,
        })
        .collect()
}
