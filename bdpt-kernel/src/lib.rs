//! The tiled bidirectional path tracer (thesis 5.5.2): scenes, their hierarchy, kernels with CPU twins, the film, images,
//! and (feature `farm`) the application that renders on a farm. Names no GPU library: kernels are WGSL text and plain
//! programs.

pub mod bvh;
pub mod gpu;
pub mod scene;
