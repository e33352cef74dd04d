//! Executors of job programs. The only crate that names wgpu.
//!
//! It owns devices (a wgpu adapter, or a simulated one), pipelines, device memory, readback and measured device time.
//! It never sees a network, a scheduler or a disk: orders come in by [`Executor::submit`], events go out to the
//! [`Host`] given at the start.
//!
//! What a kernel's author has to know of lavapipe (Mesa 22.3, found by measurement): an invocation's loops run at most
//! 65,535 rounds *in all, nested ones together*; then every loop ends early, without any error. Kernels that need more
//! are cut into launches, or into slices ([`farm_core::program::Slicing`]).
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
mod text;

pub use self::{
    error::{Busy, OpenError},
    executor::{Executor, ExecutorConfig, ExecutorEvent, Host, HungDevice, Order, expand},
    real::{Adapter, enumerate},
    sim::{SimClock, SimulatedTime, simulate_time},
    spec::{DeviceSpec, SimSpec, SpecError},
};
