//! The null model as a device sees it: the WGSL module, the bytes of an alignment, and the programs of its jobs.
//!
//! Owns every binary layout that crosses to a device and back. Never decides how iterations are split over jobs, never
//! names a GPU library. What a kernel computes is what [`crate::Reference`] and [`crate::NullModel`] define, bit for bit.

mod job;
mod layout;
mod pack;

use std::fmt::Write as _;

pub use self::{
    job::{DecodeError, MiJob, Pass},
    pack::{AlignmentContents, Chunk, MAX_KERNEL_ROWS, PackedAlignment, Shape, ShapeError},
};

/// The WGSL text for `q` symbols: one self-contained module, one file per stage.
#[must_use]
pub fn module_source(q: u32) -> String {
    const TEXT: &str = concat!(
        include_str!("../shaders/layout.wgsl"),
        include_str!("../shaders/permutation.wgsl"),
        include_str!("../shaders/shuffle.wgsl"),
        include_str!("../shaders/count.wgsl"),
    );
    let mut text = String::with_capacity(TEXT.len() + 32);
    // A constant, not an override: it sizes workgroup memory.
    writeln!(text, "const SYMBOLS: u32 = {}u;", q.max(1)).expect("a string takes any text");
    text.push_str(TEXT);
    text
}
