//! Wire formats of Gleaner: the protobuf control plane, the QUIC data plane, conversions and codecs.
//!
//! It owns how bytes look and travel; it never decides what to say. Everything that comes in is checked here once and
//! leaves as a domain type of `farm_core`.

pub mod codec;
pub mod control;
pub mod link;
pub mod memory;
pub mod net;
pub mod tls;
pub mod trust;
