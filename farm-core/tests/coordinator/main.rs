//! The coordinator's machine by itself: what it decides, seen from its effects.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

mod breaker;
mod durable;
mod farm;
mod guard;
mod hearing;
mod inventory;
mod losses;
mod policies;
mod projects;
mod speculation;
mod spread;
mod succession;
