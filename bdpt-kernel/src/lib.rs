//! The tiled bidirectional path tracer (thesis 5.5.2): scenes, their hierarchy, kernels with CPU twins, the film, images,
//! and (feature `farm`) the application that renders on a farm. Names no GPU library: kernels are WGSL text and plain
//! programs.

pub mod bvh;
pub mod film;
pub mod generate;
pub mod gpu;
#[cfg(feature = "farm")]
pub mod job;
pub mod output;
pub mod plan;
pub mod scene;
pub mod twin;
