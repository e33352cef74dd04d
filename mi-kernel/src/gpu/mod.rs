//! The null model as a device sees it: the WGSL module, the bytes of an alignment, and the programs of its jobs.
//!
//! Owns every binary layout that crosses to a device and back. Never decides how iterations are split over jobs, never
//! names a GPU library. What a kernel computes is what [`crate::Reference`] and [`crate::NullModel`] define, bit for bit.

mod job;
mod layout;
mod pack;

use std::fmt::Write as _;

use crate::GapMode;

pub use self::{
    job::{DecodeError, MiJob, Pass},
    pack::{
        AlignmentContents, Chunk, MAX_KERNEL_ROWS, Method, PAIR_BYTES, PackedAlignment, Shape, ShapeError,
    },
};

/// The WGSL text for a shape's alphabet and gaps: one self-contained module, one file per stage.
#[must_use]
pub fn module_source(shape: &Shape) -> String {
    const TEXT: &str = concat!(
        include_str!("../shaders/layout.wgsl"),
        include_str!("../shaders/permutation.wgsl"),
        include_str!("../shaders/shuffle.wgsl"),
        include_str!("../shaders/count.wgsl"),
    );
    const GAPS_APART: &str = include_str!("../shaders/gaps_apart.wgsl");
    let q = shape.symbols();
    let mut text = String::with_capacity(TEXT.len() + GAPS_APART.len() + 32);
    // A constant, not an override: it sizes workgroup memory.
    writeln!(text, "const SYMBOLS: u32 = {}u;", q.max(1)).expect("a string takes any text");
    text.push_str(TEXT);
    let mode = match shape.gaps() {
        GapMode::Ormi => None,
        GapMode::Sumi => Some("SUMI"),
        GapMode::Demi => Some("DEMI"),
        GapMode::Esmi => Some("ESMI"),
    };
    if let Some(mode) = mode {
        writeln!(text, "const GAPS: u32 = {mode};").expect("a string takes any text");
        text.push_str(GAPS_APART);
        return text;
    }
    text.push_str(include_str!("../shaders/gaps_counted.wgsl"));
    if pack::PLANES_SYMBOLS.contains(&q) {
        text.push_str(include_str!("../shaders/planes.wgsl"));
        text.push_str(&joint_planes(q));
    }
    text
}

/// `joint_planes` of `shaders/planes.wgsl`, `sum_ab T(c_ab)` of a pair: written out, so that every count is a register
/// and the only loop is that over words (lavapipe ends loops after 65,535 rounds in all).
fn joint_planes(q: u32) -> String {
    let mut text = String::from("fn joint_planes(i: u32, j: u32) -> u32 {\n");
    let mut line = |written: std::fmt::Arguments<'_>| {
        text.write_fmt(written).expect("a string takes any text");
        text.push('\n');
    };
    for (a, b) in symbol_pairs(q) {
        line(format_args!("var c_{a}_{b} = 0u;"));
    }
    line(format_args!("for (var word = 0u; word < sizes.plane_words; word += 1u) {{"));
    for symbol in 1..q {
        line(format_args!("let at_{symbol} = (word * (SYMBOLS - 1u) + {}u) * sizes.l;", symbol - 1));
        line(format_args!("let a_{symbol} = planes[at_{symbol} + i];"));
        line(format_args!("let b_{symbol} = planes[at_{symbol} + j];"));
    }
    for (a, b) in symbol_pairs(q) {
        line(format_args!("c_{a}_{b} += countOneBits(a_{a} & b_{b});"));
    }
    line(format_args!("}}\nvar total = 0u;\nvar rest = margin(i, 0u);"));
    for a in 1..q {
        // The pairs of a symbol with the first one are what its others leave.
        line(format_args!("var row_{a} = margin(i, {a}u);\nvar column_{a} = margin(j, {a}u);"));
    }
    for (a, b) in symbol_pairs(q) {
        line(format_args!("total += table[c_{a}_{b}];\nrow_{a} -= c_{a}_{b};\ncolumn_{b} -= c_{a}_{b};"));
    }
    for a in 1..q {
        line(format_args!("total += table[row_{a}] + table[column_{a}];\nrest -= column_{a};"));
    }
    line(format_args!("return total + table[rest];\n}}"));
    text
}

/// Pairs of symbols but the first.
fn symbol_pairs(q: u32) -> impl Iterator<Item = (u32, u32)> {
    (1..q).flat_map(move |a| (1..q).map(move |b| (a, b)))
}
