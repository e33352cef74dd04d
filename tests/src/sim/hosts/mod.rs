//! The drivers of the three machines, as thin as they can be: they keep what machines do not (programs, payloads), carry
//! effects out, and object to effects that a real driver could not carry out.

mod app;
mod coordinator;
mod worker;

pub(super) use self::coordinator::{PLUGIN, PROJECTS, Store};
pub use self::{
    app::{AppHost, Ending},
    worker::WorkerHost,
};
