//! The executor's interface, the same for real and simulated devices.
//!
//! It owns no device itself: it hands orders to [`crate::real`] or [`crate::sim`].

use std::{path::PathBuf, sync::Arc, time::Duration};

use bytes::Bytes;
use farm_core::{
    device::DeviceInfo,
    id::{ContentHash, JobAttempt},
    message::{JobFailure, LatencyClass},
    program::JobProgram,
};

use crate::{
    error::{Busy, OpenError},
    real::{self, RealDevice},
    sim::SimDevice,
    spec::DeviceSpec,
};

/// Whom an executor works for. A closure that takes events is one.
///
/// All calls come from the device's thread (a simulated device: [`Self::event`] also from inside [`Executor::submit`] and
/// [`Executor::abort`]).
pub trait Host: Send + Sync + 'static {
    /// Something happened. Must not block.
    fn event(&self, event: ExecutorEvent);

    /// A job is about to be prepared: its modules are compiled and its bytes uploaded. If the driver takes the process
    /// down now, this job or a running one is the cause.
    fn preparing(&self, _job: JobAttempt) {}

    /// It is prepared. One that cannot be ends as any other.
    fn prepared(&self, _job: JobAttempt) {}

    /// The bytes of a content that neither the order nor the device has. May block, for a bounded time.
    fn content(&self, _hash: &ContentHash) -> Option<Bytes> {
        None
    }
}

impl<F: Fn(ExecutorEvent) + Send + Sync + 'static> Host for F {
    fn event(&self, event: ExecutorEvent) {
        self(event);
    }
}

/// What becomes of a device whose work does not end when it should.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HungDevice {
    /// It is left behind, with its memory, and opened anew.
    Reopened,
    /// It is lost at once, and jobs that have not begun are not reported: whoever owns the process ends it, which frees
    /// what the driver holds, and tries them again in a new one.
    Lost,
}

/// Most devices of one node: what [`DeviceIndex`] and a status screen can hold.
pub(crate) const MAX_DEVICES: usize = 256;

/// One job for a device, with everything it needs.
#[derive(Clone, Debug)]
pub struct Order {
    /// Which attempt.
    pub job: JobAttempt,
    /// Whether it takes the device at the next launch boundary of a running job of a lower class.
    pub class: LatencyClass,
    /// What to do.
    pub program: Arc<JobProgram>,
    /// The bytes of every module and task allocation that the program names, in any order. A name that is missing
    /// here, that the device does not hold either and that [`Host::content`] cannot give, fails the job with
    /// [`JobFailure::ContentUnavailable`].
    pub contents: Vec<(ContentHash, Bytes)>,
    /// How long the job may run, from `Started`, interruptions not counted.
    pub limit: Duration,
}

/// Jobs held at once: one runs, one is staged, and a third place for the sake of one that interrupts. Whom it is for
/// is the scheduler's to say.
pub(crate) const DEPTH: usize = 3;

/// What an executor reports. Events of one job come in order: at most one `Started`, any number of `Yielded` and `Resumed`
/// by turns, then one `Finished`.
#[derive(Clone, Debug, PartialEq)]
pub enum ExecutorEvent {
    /// The job began to run; the device has room for a staged one.
    Started {
        /// Which.
        job: JobAttempt,
    },
    /// The running job made way for one of a higher class, at a launch boundary. Its state stays on the device.
    Yielded {
        /// Which.
        job: JobAttempt,
    },
    /// A job that had yielded goes on where it was.
    Resumed {
        /// Which.
        job: JobAttempt,
    },
    /// The job ended, in whatever way. Aborted ones end with [`JobFailure::Cancelled`].
    Finished {
        /// Which.
        job: JobAttempt,
        /// Measured device time in nanoseconds: timestamp queries where the device has them, else wall time of its
        /// submits. Also charged when the job failed.
        device_time_ns: u64,
        /// The result's sections in program order; they are slices of one allocation, one after the other.
        outcome: Result<Vec<Bytes>, JobFailure>,
    },
    /// The device is gone and could not be reopened. Jobs that were on it have been reported before.
    Lost {
        /// Why, for people.
        reason: String,
    },
}

/// Settings of an executor. Fractions are of the device's estimated memory.
#[derive(Clone, Debug, PartialEq)]
pub struct ExecutorConfig {
    /// Compile modules without runtime checks (bounds, loop counters, division by zero). Only with the operator's
    /// permission: a wrong kernel may then crash the driver or read other jobs' memory.
    pub unchecked: bool,
    /// Most memory of cached task allocations that no job uses.
    pub allocation_cache_fraction: f64,
    /// Most memory of idle pooled buffers.
    pub pool_fraction: f64,
    /// Most parsed modules kept.
    pub max_modules: usize,
    /// Most compiled pipelines kept.
    pub max_pipelines: usize,
    /// What a submit of work should take at most; sliced launches are cut to it.
    pub submit_target: Duration,
    /// What becomes of a hung device.
    pub hung_device: HungDevice,
    /// A folder where what drivers compile is kept for later processes.
    pub compiled: Option<PathBuf>,
}

impl Default for ExecutorConfig {
    fn default() -> Self {
        Self {
            unchecked: false,
            allocation_cache_fraction: 0.5,
            pool_fraction: 0.25,
            max_modules: 64,
            max_pipelines: 256,
            // 30-programs-and-data.md section 4: a submit stays below 50 ms; half of it leaves room for variance.
            submit_target: Duration::from_millis(25),
            hung_device: HungDevice::Reopened,
            compiled: None,
        }
    }
}

/// A device and what drives it. Dropping it aborts what it holds.
#[derive(Debug)]
pub struct Executor {
    info: DeviceInfo,
    device: Device,
}

#[derive(Debug)]
enum Device {
    Real(RealDevice),
    Sim(SimDevice),
}

impl Executor {
    /// Opens a device, measures its score and starts its executor.
    ///
    /// # Errors
    /// There is no such device, it cannot be opened, or `spec` is [`DeviceSpec::All`].
    pub fn start(spec: &DeviceSpec, config: ExecutorConfig, host: impl Host) -> Result<Self, OpenError> {
        match spec {
            DeviceSpec::All => Err(OpenError::NotSingle { spec: *spec }),
            DeviceSpec::Gpu(_) | DeviceSpec::Cpu => {
                let (device, info) = RealDevice::start(*spec, config, Box::new(host))?;
                Ok(Self { info, device: Device::Real(device) })
            }
            DeviceSpec::Sim(sim) => {
                let (device, info) = SimDevice::start(*sim, Box::new(host))?;
                Ok(Self { info, device: Device::Sim(device) })
            }
        }
    }

    /// The device as its node announces it.
    #[must_use]
    pub const fn info(&self) -> &DeviceInfo {
        &self.info
    }

    /// Takes an order: it runs at once, or is staged (prepared while the running one runs). One of a higher class than the
    /// running job takes the device at its next launch boundary; the interrupted job goes on before staged ones of its
    /// class. At most one is interrupted at a time.
    ///
    /// # Errors
    /// Three are held already, or the device is lost. The order is dropped.
    pub fn submit(&self, order: Order) -> Result<(), Busy> {
        match &self.device {
            Device::Real(device) => device.submit(order),
            Device::Sim(device) => device.submit(order),
        }
    }

    /// Takes a job back: a staged or interrupted one ends at once, a running one at its next run boundary, both with
    /// [`JobFailure::Cancelled`]. Unknown jobs are ignored: they have ended already.
    pub fn abort(&self, job: JobAttempt) {
        match &self.device {
            Device::Real(device) => device.abort(job),
            Device::Sim(device) => device.abort(job),
        }
    }
}

/// Replaces [`DeviceSpec::All`] by the devices it stands for on this machine.
///
/// # Errors
/// `all` was asked for and there is no Vulkan adapter, or there are more devices than a node may have.
pub fn expand(specs: &[DeviceSpec]) -> Result<Vec<DeviceSpec>, OpenError> {
    let mut devices = Vec::with_capacity(specs.len());
    for spec in specs {
        match spec {
            DeviceSpec::All => devices.extend(real::all()?),
            DeviceSpec::Gpu(_) | DeviceSpec::Cpu | DeviceSpec::Sim(_) => devices.push(*spec),
        }
    }
    if devices.len() > MAX_DEVICES {
        return Err(OpenError::TooMany { count: devices.len(), most: MAX_DEVICES });
    }
    Ok(devices)
}
