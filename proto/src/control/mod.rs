//! The control plane: gRPC sessions of applications and nodes with the coordinator, package `gleaner.v1`.
//!
//! It owns message shapes, their caps and the connection settings that both ends share; it never decides what to say.

mod convert;
mod incoming;
mod session;
mod stream;
mod transport;
mod trust;

#[allow(
    missing_docs,
    missing_debug_implementations,
    unreachable_pub,
    unused_qualifications,
    elided_lifetimes_in_paths,
    clippy::all,
    clippy::pedantic,
    clippy::restriction,
    clippy::nursery,
    reason = "generated from proto/gleaner/v1; tests/generated.rs keeps it in step"
)]
#[rustfmt::skip]
#[path = "../gen/gleaner.v1.rs"]
pub mod v1;

pub use self::{
    convert::{
        MAX_ADDRESSES, MAX_CERTIFICATE_BYTES, MAX_CONTENTS, MAX_ENTRIES, MAX_JOBS, MAX_NAME_BYTES,
        MAX_TEXT_BYTES, MessageError, WireError, decode, encode, eviction, quota_change,
    },
    incoming::Incoming,
    session::{
        CAPABILITY_METADATA, Heard, QUEUED_MESSAGES, Session, SessionError, SessionReceiver, SessionSender,
        connect_app, connect_node, contents, drain, evict, status, timeline,
    },
    stream::{Caller, ControlStream},
    transport::{
        ADMIN_TIMEOUT, CONNECTION_WINDOW_BYTES, MAX_MESSAGE_BYTES, admin_server, apps_server,
        coordinator_addresses, nodes_server, server, trust_server,
    },
    trust::{
        Invitation, create_token, expel, join, list_members, list_tokens, remove_project, renew,
        revoke_token, set_project,
    },
};
