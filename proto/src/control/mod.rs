//! The control plane: gRPC sessions of applications and nodes with the coordinator.

mod session;

pub use self::session::{
    ADMIN_TIMEOUT, Session, SessionError, SessionReceiver, SessionSender, connect_app, connect_node, drain,
    status,
};
