//! Executors of job programs. The only crate that names wgpu.
//!
//! It owns devices (a wgpu adapter, or a simulated one), pipelines, device memory, readback and measured device time.
//! It never sees a network, a scheduler or a disk: orders come in by [`Executor::submit`], events go out by the
//! callback given at the start.
//!
//! ```no_run
//! use std::{sync::{Arc, mpsc}, time::Duration};
//! use gpu_exec::{DeviceSpec, Executor, ExecutorConfig, Order};
//! # fn order() -> Order { unimplemented!() }
//! let (events, inbox) = mpsc::channel();
//! let spec: DeviceSpec = "cpu".parse()?;
//! let executor = Executor::start(&spec, ExecutorConfig::default(), move |event| drop(events.send(event)))?;
//! executor.submit(order())?;
//! let started = inbox.recv()?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod error;
mod executor;
mod real;
mod sim;
mod spec;

pub use self::{
    error::{Busy, OpenError},
    executor::{Executor, ExecutorConfig, ExecutorEvent, Order, expand, open},
    real::{Adapter, enumerate},
    spec::{DeviceSpec, SimSpec, SpecError},
};
