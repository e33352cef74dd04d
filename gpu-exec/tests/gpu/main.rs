//! The executor on a real Vulkan device (lavapipe where there is no GPU). A machine without any fails these tests with
//! the name of the package to install.

mod compute;
mod device;
mod faults;
mod limits;
mod memory;
