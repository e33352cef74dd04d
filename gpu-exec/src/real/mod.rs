//! Devices that compute: one thread, one wgpu device each.

mod adapter;

pub(crate) use self::adapter::all;
pub use self::adapter::{Adapter, enumerate};
use crate::{
    error::{Busy, OpenError},
    executor::{EventSink, ExecutorConfig, Order},
    spec::DeviceSpec,
};
use farm_core::{device::DeviceInfo, id::JobAttempt};

#[derive(Debug)]
pub(crate) struct RealDevice {}

impl RealDevice {
    pub(crate) fn start(
        spec: DeviceSpec,
        _config: ExecutorConfig,
        _on_event: EventSink,
    ) -> Result<(Self, DeviceInfo), OpenError> {
        let gpu = adapter::Gpu::open(spec)?;
        let reason = "the executor of real devices is still to come".to_owned();
        Err(OpenError::Device { spec, adapter: gpu.name, reason })
    }

    pub(crate) fn submit(&self, order: Order) -> Result<(), Busy> {
        Err(Busy::Lost { job: order.job })
    }

    pub(crate) fn abort(&self, _job: JobAttempt) {}
}
