//! A worker's machine by itself: what it hands to which device and brings from where, seen from its effects.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

mod contents;
mod inventory;
mod node;
mod spool;
mod staging;
