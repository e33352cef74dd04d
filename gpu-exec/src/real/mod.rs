//! Devices that compute: a thread and a wgpu device each.
//!
//! [`RealDevice`] is the handle; [`thread`] runs the orders: [`prepare`] turns one into what can be submitted, [`run`]
//! submits it in bounded pieces.

mod adapter;
mod clock;
mod compiled;
mod memory;
mod module;
mod pace;
mod pipeline;
mod prepare;
mod run;
mod scope;
mod score;
mod thread;
mod trusted;

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
        mpsc,
    },
    thread as std_thread,
    time::Duration,
};

use farm_core::{device::DeviceInfo, id::JobAttempt};

pub(crate) use self::adapter::all;
pub use self::adapter::{Adapter, enumerate};
use self::{
    adapter::Gpu,
    thread::{DeviceThread, Message},
};
use crate::{
    error::{Busy, OpenError},
    executor::{DEPTH, ExecutorConfig, Host, Order},
    spec::DeviceSpec,
};

/// Stack of a device's thread: naga recurses over the text of a module.
const STACK_BYTES: usize = 16 << 20;

/// How long the end of an executor waits for its thread: without it a process would unload the driver under a thread
/// that still uses it. A hung device is left to the process' end.
const CLOSE_PATIENCE: Duration = Duration::from_secs(2);

/// The handle of a device's thread.
#[derive(Debug)]
pub(crate) struct RealDevice {
    inbox: mpsc::Sender<Message>,
    shared: Arc<Shared>,
    /// Closed when the thread has dropped its device. A lock for `Sync` only: nobody but the drop takes it.
    ended: Mutex<mpsc::Receiver<()>>,
}

/// What the handle and the thread both see.
#[derive(Debug, Default)]
struct Shared {
    /// Jobs taken and not yet finished.
    held: AtomicUsize,
    lost: AtomicBool,
}

impl RealDevice {
    pub(crate) fn start(
        spec: DeviceSpec,
        config: ExecutorConfig,
        host: Box<dyn Host>,
    ) -> Result<(Self, DeviceInfo), OpenError> {
        let gpu = Gpu::open(spec)?;
        let score = score::measure(&gpu).map_err(|reason| OpenError::Device {
            spec,
            adapter: gpu.name.clone(),
            reason,
        })?;
        let info = DeviceInfo {
            name: gpu.name.clone(),
            kind: gpu.kind,
            score,
            features: gpu.farm_features(),
            limits: gpu.farm_limits(),
        };
        tracing::info!(%spec, name = info.name, score, "device open");
        let shared = Arc::<Shared>::default();
        // Bounded by DEPTH orders and the aborts of these.
        let (sender, inbox) = mpsc::channel();
        let (ending, ended) = mpsc::channel();
        let thread = DeviceThread::new(spec, gpu, config, inbox, Arc::clone(&shared), host);
        std_thread::Builder::new()
            .name(format!("device {spec}"))
            .stack_size(STACK_BYTES)
            .spawn(move || {
                thread.run();
                drop(ending);
            })
            .map_err(|source| OpenError::Thread { spec, source })?;
        Ok((Self { inbox: sender, shared, ended: Mutex::new(ended) }, info))
    }

    pub(crate) fn submit(&self, order: Order) -> Result<(), Busy> {
        let job = order.job;
        if self.shared.lost.load(Ordering::Acquire) {
            return Err(Busy::Lost { job });
        }
        let take = |held| (held < DEPTH).then_some(held + 1);
        if self.shared.held.fetch_update(Ordering::AcqRel, Ordering::Acquire, take).is_err() {
            return Err(Busy::Full { job });
        }
        self.inbox.send(Message::Order(order)).map_err(|_| Busy::Lost { job })
    }

    pub(crate) fn abort(&self, job: JobAttempt) {
        // A thread that has ended holds no job.
        let _ = self.inbox.send(Message::Abort(job));
    }
}

impl Drop for RealDevice {
    fn drop(&mut self) {
        if self.inbox.send(Message::Close).is_ok() {
            let ended = self.ended.get_mut().unwrap_or_else(PoisonError::into_inner);
            // Closed without a message is the good case; too late is the hung one.
            let _ = ended.recv_timeout(CLOSE_PATIENCE);
        }
    }
}
