//! Everything that crosses between host and device, byte for byte; `shaders/layout.wgsl` is the twin. That both agree is
//! tested by results: `tests/gpu.rs` compares every score with the host's.

use bytemuck::{Pod, Zeroable};

/// Storage bindings of the module.
pub(super) mod binding {
    pub(crate) const CODES: u32 = 0;
    pub(crate) const SYMBOL_ORDER: u32 = 1;
    pub(crate) const BOUNDS: u32 = 2;
    pub(crate) const TABLE: u32 = 3;
    pub(crate) const COLUMN_TERMS: u32 = 4;
    pub(crate) const ROUND_KEYS: u32 = 5;
    pub(crate) const SHUFFLED: u32 = 6;
    pub(crate) const GROUPED: u32 = 7;
    pub(crate) const OBSERVED: u32 = 8;
    pub(crate) const SUMS: u32 = 9;
    pub(crate) const SQUARES: u32 = 10;
    pub(crate) const REACHED: u32 = 11;
    pub(crate) const MAXIMA: u32 = 12;
    pub(crate) const SCORES: u32 = 13;
    pub(crate) const PLANES: u32 = 14;
}

/// Lanes of every workgroup.
pub(super) const LANES: u32 = 64;
/// Columns j of one counting workgroup.
pub(super) const BLOCK_COLUMNS: u32 = 256;
/// Rows that a lane of `shuffle` writes.
pub(super) const ROWS_A_LANE: u32 = 16;
/// Words that a lane of `group` writes.
pub(super) const WORDS_A_LANE: u32 = 8;
/// Words before the first column's round keys.
pub(super) const KEYS_HEADER: u64 = 8;

/// `Sizes` in WGSL. 48 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct Sizes {
    pub(super) n: u32,
    pub(super) l: u32,
    pub(super) row_words: u32,
    pub(super) column_words: u32,
    pub(super) order_words: u32,
    pub(super) left_bits: u32,
    pub(super) right_bits: u32,
    pub(super) plane_words: u32,
    pub(super) scale_bits: u32,
    pub(super) padding: [u32; 3],
}

/// `Chunk` in WGSL. 32 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct ChunkRange {
    pub(super) first_i: u32,
    pub(super) columns: u32,
    pub(super) first_place: u32,
    pub(super) first_block: u32,
    pub(super) columns_x: u32,
    pub(super) column_groups: u32,
    pub(super) padding: [u32; 2],
}

/// `Iteration` in WGSL. 32 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct Iteration {
    pub(super) number_lo: u32,
    pub(super) number_hi: u32,
    pub(super) seed_lo: u32,
    pub(super) seed_hi: u32,
    pub(super) slot: u32,
    pub(super) shuffled: u32,
    pub(super) padding: [u32; 2],
}
