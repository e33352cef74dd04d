//! A device's executor, inside this process or in one of its own, behind the same calls.

mod apart;
mod book;
mod here;
mod mouth;
mod process;
mod restarts;
mod serve;
mod wire;

use std::{
    ffi::OsString,
    path::{Path, PathBuf},
    process::ExitCode,
    time::Duration,
};

use farm_core::{
    device::DeviceInfo,
    id::{DeviceIndex, JobAttempt},
    message::LatencyClass,
    program::JobProgram,
};
use gpu_exec::{Busy, DeviceSpec, OpenError};
use proto::{
    codec::{self, CodecError},
    trust::Scope,
};
use tokio::sync::mpsc;

use self::{
    apart::{ExecutorProcess, Launch},
    here::InProcess,
};
use crate::{StartError, contents::Shelf, device::DeviceEvent, programs::Program};

/// First argument of a binary that is to be an executor process; the second is its device, the third, if there is one, the folder
/// for what drivers compile.
const ROLE: &str = "executor";

/// Where executors run. Simulated devices run in this process always: no driver of theirs can crash it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Isolation {
    /// In this process: a driver that aborts ends the worker.
    None,
    /// In a process each, of this binary, whose `main` begins with [`serve_if_executor`].
    Processes(PathBuf),
}

impl Isolation {
    /// Processes of the binary that runs now, even if its file has been replaced since.
    #[must_use]
    pub fn own_binary() -> Self {
        Self::Processes(PathBuf::from("/proc/self/exe"))
    }
}

/// Serves as an executor until its worker is gone, if that is what this process was started for; `arguments` are those of
/// the process. What a binary does first that runs workers with [`Isolation::Processes`].
pub fn serve_if_executor(mut arguments: impl Iterator<Item = OsString>) -> Option<ExitCode> {
    if arguments.nth(1)? != *ROLE {
        return None;
    }
    let spec = arguments.next().unwrap_or_default();
    Some(serve::serve(&spec.to_string_lossy(), arguments.next().map(PathBuf::from)))
}

/// One job for an executor.
#[derive(Clone, Debug)]
pub(crate) struct Order {
    pub(crate) job: JobAttempt,
    pub(crate) class: LatencyClass,
    pub(crate) program: Program,
    /// How long it may run, interruptions not counted.
    pub(crate) limit: Duration,
}

/// A program as the device gets it: with its contents by the names that the node's cache has for them.
///
/// # Errors
/// The bytes are no program.
fn decode(program: &[u8], scope: Scope) -> Result<JobProgram, CodecError> {
    Ok(codec::decode_program(program)?.with_contents_named(|digest| scope.name(digest)))
}

/// What carries a device's orders out. Dropping it ends what it holds.
#[derive(Debug)]
pub(crate) enum Executor {
    Here(InProcess),
    Apart(ExecutorProcess),
}

impl Executor {
    /// Takes an order; what becomes of it comes as an event.
    ///
    /// # Errors
    /// The device holds as many as it may, or is lost. The order is dropped.
    pub(crate) fn submit(&self, order: Order) -> Result<(), Busy> {
        match self {
            Self::Here(executor) => executor.submit(order),
            Self::Apart(process) => {
                process.submit(order);
                Ok(())
            }
        }
    }

    /// Takes a job back. Unknown ones have ended.
    pub(crate) fn abort(&self, job: JobAttempt) {
        match self {
            Self::Here(executor) => executor.abort(job),
            Self::Apart(process) => process.abort(job),
        }
    }
}

/// Opens the devices of `specs`, `all` expanded, one after the other: each is measured on its own.
///
/// # Errors
/// The first one that does not open, or there is none.
pub(crate) async fn open(
    specs: Vec<DeviceSpec>,
    isolation: &Isolation,
    compiled: Option<&Path>,
    contents: &Shelf,
    events: &mpsc::UnboundedSender<DeviceEvent>,
) -> Result<Vec<(Executor, DeviceInfo)>, StartError> {
    let specs = blocking(move || gpu_exec::expand(&specs)).await?;
    let mut devices = Vec::with_capacity(specs.len());
    for (index, spec) in (0..).map(DeviceIndex).zip(specs) {
        let (contents, events) = (contents.clone(), events.clone());
        let compiled = compiled.map(Path::to_owned);
        devices.push(match (isolation, spec) {
            (Isolation::Processes(program), DeviceSpec::Gpu(_) | DeviceSpec::Cpu | DeviceSpec::All) => {
                let launch = Launch { program: program.clone(), spec, compiled };
                let started = ExecutorProcess::start(launch, index, contents, events).await;
                let (process, info) = started.map_err(|reason| StartError::Executor { reason })?;
                (Executor::Apart(process), info)
            }
            (Isolation::None, _) | (Isolation::Processes(_), DeviceSpec::Sim(_)) => {
                let open = move || InProcess::start(spec, index, compiled, contents, events);
                let (executor, info) = blocking(open).await?;
                (Executor::Here(executor), info)
            }
        });
    }
    if devices.is_empty() { Err(StartError::NoDevice) } else { Ok(devices) }
}

/// Runs what loads drivers, or measures a device for up to a second, on a thread that may block.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, OpenError> + Send + 'static,
) -> Result<T, StartError> {
    Ok(tokio::task::spawn_blocking(work).await.map_err(std::io::Error::other)??)
}
