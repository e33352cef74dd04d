//! The simulator: the real coordinator, worker and application machines in one process, over a seeded network with virtual
//! time, in trouble (20-delivery.md, "Simulation").
//!
//! A run has two modes. In safety mode faults come, and the invariants hold at every event; in liveness mode no fault
//! follows, and everything gets to its end within a bound. A seed decides everything: the same seed is the same run.
//!
//! `world` is virtual time and the event loop, `network` the connections, `clock` what processes see of time, `hosts` the
//! thin drivers of the machines, `work` what jobs do; `faults` what can go wrong, `weather` and `storm` when; `auditor`
//! judges by what is said, `lookout` by what is; `diary` is for whoever measures; `scenario` names it all. `million` measures the coordinator.
//!
//! A new kind of trouble is a variant of [`faults::Fault`] and of `weather::Kind`; a new kind of farm a
//! [`scenario::Scenario`]. What a machine newly wants of its driver is carried out in its host.

pub mod auditor;
pub mod clock;
pub mod diary;
pub mod faults;
pub mod hosts;
pub mod log;
mod lookout;
pub mod million;
pub mod network;
pub mod scenario;
mod storm;
mod weather;
pub mod work;
pub mod world;
