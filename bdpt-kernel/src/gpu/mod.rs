//! The path tracer as a device sees it: the WGSL module, the bytes of a scene, and the programs of the two kinds of job.
//!
//! Owns every binary layout that crosses to a device and back. Never loads scenes, never merges layers, never names a
//! GPU library.

pub mod frame;
pub mod layout;
pub mod light_job;
pub mod normalise;
pub mod pack;
pub mod source;
pub mod tile_job;

use farm_core::program::{Buffer, DispatchError, JobProgram, Kernel};
use thiserror::Error;

pub use self::{
    frame::{FrameError, FrameParams, Integrator, RenderOptions},
    layout::Counters,
    light_job::{LightJob, SplatLayer},
    normalise::NormalisedScene,
    pack::{PackError, PackedScene, SceneContents},
    source::{module, module_source},
    tile_job::{FirstHit, PixelSum, TileJob, TileLayer},
};

/// A job's result does not have the shape that its program asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum DecodeError {
    /// Too few or too many sections.
    #[error("result has {got} sections, expected {expected}")]
    SectionCount {
        /// What the program asks for.
        expected: usize,
        /// What came.
        got: usize,
    },
    /// A section of another length.
    #[error("section {section} has {got} B, expected {expected} B")]
    SectionSize {
        /// Its index.
        section: usize,
        /// What the program asks for.
        expected: usize,
        /// What came.
        got: usize,
    },
}

/// Checks the lengths of a result's sections against those that its program asked for.
fn check_sections<B: AsRef<[u8]>, const N: usize>(
    sections: &[B],
    expected: [usize; N],
) -> Result<[&[u8]; N], DecodeError> {
    if sections.len() != N {
        return Err(DecodeError::SectionCount { expected: N, got: sections.len() });
    }
    let slices: [&[u8]; N] = std::array::from_fn(|index| sections[index].as_ref());
    for (section, (slice, expected)) in slices.iter().zip(expected).enumerate() {
        if slice.len() != expected {
            return Err(DecodeError::SectionSize { section, expected, got: slice.len() });
        }
    }
    Ok(slices)
}

/// Binds the scene's five arrays and the counters, which every tracing kernel reads at the same places.
fn bind_scene(
    cmd: &mut JobProgram,
    kernel: Kernel,
    scene: &SceneContents,
    counters: Buffer,
) -> Result<(), DispatchError> {
    let contents = [scene.nodes, scene.triangles, scene.shading, scene.materials, scene.lights];
    for (binding, content) in (layout::binding::NODES..).zip(contents) {
        let buffer = cmd.task_allocation(content);
        cmd.param_in(kernel, binding, buffer)?;
    }
    cmd.param_in_out(kernel, layout::binding::COUNTERS, counters)
}
