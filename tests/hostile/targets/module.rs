//! What a device is given: its name on a command line, and modules of strangers.

use std::{
    sync::{Arc, LazyLock, Mutex, PoisonError, mpsc},
    time::Duration,
};

use farm_core::{
    id::{AppId, Attempt, Epoch, JobAttempt, JobId, JobIndex, TaskId},
    message::{JobFailure, LatencyClass},
    program::{Content, JobProgram},
};
use gpu_exec::{DeviceSpec, Executor, ExecutorConfig, ExecutorEvent, Order};

use super::{Verdict, refused, text};

/// A job that has not come back by then hangs.
const PATIENCE: Duration = Duration::from_secs(60);

pub(super) fn device_spec(bytes: &[u8]) -> Verdict {
    let spec: DeviceSpec = text(bytes)?.parse().map_err(refused)?;
    assert!(spec.to_string().parse() == Ok(spec), "{spec} does not come back");
    Ok(())
}

/// A device, and what it says. It is one for all threads: opening one takes a second.
struct Device {
    executor: Executor,
    events: mpsc::Receiver<ExecutorEvent>,
}

/// A module as a worker takes it: by a job that names its entry point `main` and launches it never.
pub(super) fn wgsl(bytes: &[u8]) -> Verdict {
    static DEVICE: LazyLock<Mutex<Device>> = LazyLock::new(|| {
        let (events, inbox) = mpsc::channel();
        let events = Mutex::new(events);
        let tell = move |event| drop(events.lock().unwrap_or_else(PoisonError::into_inner).send(event));
        let executor =
            Executor::start(&DeviceSpec::Cpu, ExecutorConfig::default(), tell).expect("a software device");
        Mutex::new(Device { executor, events: inbox })
    });
    let device = DEVICE.lock().unwrap_or_else(PoisonError::into_inner);
    let module = Content { hash: proto::codec::content_hash(bytes), size_bytes: bytes.len() as u64 };
    let mut program = JobProgram::default();
    program.function(module, "main");
    let job = JobAttempt {
        job: JobId { app: AppId(1), task: TaskId(1), index: JobIndex(1) },
        attempt: Attempt { epoch: Epoch(1), sequence: 1 },
    };
    let order = Order {
        job,
        class: LatencyClass::Batch,
        program: Arc::new(program),
        contents: vec![(module.hash, bytes.to_vec().into())],
        limit: PATIENCE,
    };
    device.executor.submit(order).map_err(refused)?;
    loop {
        match device.events.recv_timeout(PATIENCE).expect("every job ends") {
            ExecutorEvent::Finished { outcome: Ok(_), .. } => return Ok(()),
            ExecutorEvent::Finished { outcome: Err(JobFailure::InvalidProgram(reason)), .. } => {
                assert!(!reason.contains("panic"), "{reason}");
                return Err(reason);
            }
            ExecutorEvent::Finished { outcome: Err(failure), .. } => {
                panic!("a module ends a job by {failure:?}")
            }
            ExecutorEvent::Lost { reason } => panic!("the device is lost: {reason}"),
            ExecutorEvent::Started { .. } | ExecutorEvent::Yielded { .. } | ExecutorEvent::Resumed { .. } => {
            }
        }
    }
}
