//! The executor on a real Vulkan device (lavapipe where there is no GPU). A machine without any fails these tests with
//! the name of the package to install.

#![allow(
    clippy::unwrap_used,
    clippy::missing_assert_message,
    reason = "a test that cannot go on panics, and its name says what was expected"
)]

mod compute;
mod device;
mod faults;
mod limits;
mod memory;
mod yields;
