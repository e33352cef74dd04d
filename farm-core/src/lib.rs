//! The pure heart of Gleaner: identities, time, job programs, messages between the tiers, and the three
//! deterministic state machines (coordinator, worker, application ledger).
//!
//! Nothing here reads a clock, opens a socket, spawns a thread or draws entropy: time, randomness seeds and
//! identities come in as arguments, decisions go out as data. The same machines run in production, in the seeded
//! simulator and in the benchmarks.

pub mod coordinator;
pub mod device;
pub mod holding;
pub mod id;
pub mod ledger;
pub mod message;
pub mod program;
pub mod project;
mod pulse;
pub mod time;
pub mod worker;
