//! An alignment's bytes as kernels bind them, and how its pairs are split over bindings.

use std::ops::Range;

use farm_core::program::Content;
use rayon::prelude::*;
use thiserror::Error;

use super::layout::{BLOCK_COLUMNS, ChunkRange, Sizes};
use crate::{Alignment, GapMode, Reference, fixed_point::scale_bits, pair_count};

/// Most sequences of one pass: two counts share a 32-bit word.
pub const MAX_KERNEL_ROWS: usize = 65_535;

/// Most bytes of one binding: what lavapipe has, the least of all devices.
const BINDING_BYTES: u64 = 128 << 20;

/// Most bytes of one job's result: sums, squares, counts. Under the farm's quota of 1 GiB.
const RESULT_BYTES: u64 = 1 << 30;

/// Bytes of a pair's accumulators in a result: sum, sum of squares, count.
pub const PAIR_BYTES: u64 = 20;

/// Bytes of the sums of one part of the pairs, but for a column's. Where all pairs have more, a job is of one part: for the same bytes
/// over the network it has as many times more iterations, and at the end of a run devices wait for less. Each part shuffles anew,
/// some hundredths of a part's work.
const PART_BYTES: u64 = 64 << 20;

/// Alphabets that bit planes are made for.
pub(super) const PLANES_SYMBOLS: std::ops::RangeInclusive<u32> = 2..=6;

/// Columns i of one cut of a launch at first; more where z would leave its limit.
const COLUMNS_X: u32 = 16;

/// Most workgroups in one dimension that WebGPU guarantees.
const GROUPS: u32 = 65_535;

/// An alignment that the kernels cannot hold. Not to be retried.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum ShapeError {
    /// Too many sequences.
    #[error("{n} sequences: a device counts up to {MAX_KERNEL_ROWS} in one pass")]
    Rows {
        /// Sequences.
        n: usize,
    },
    /// No pair.
    #[error("{l} column: mutual information needs at least two")]
    Columns {
        /// Columns.
        l: usize,
    },
    /// More symbols than a binding holds.
    #[error("{n} sequences of {l} columns are more than the {BINDING_BYTES} symbols of one binding")]
    Symbols {
        /// Sequences.
        n: usize,
        /// Columns.
        l: usize,
    },
    /// More pairs than a result holds.
    #[error("{l} columns: the sums of all pairs are more than the {RESULT_BYTES} B of one result")]
    Pairs {
        /// Columns.
        l: usize,
    },
}

/// Columns i whose pairs (i, j) share a binding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Chunk {
    pub(super) first_i: u32,
    pub(super) columns: u32,
    /// Place of its first pair.
    pub(super) first_place: u32,
    pub(super) pairs: u32,
}

/// Sizes of an alignment, checked against what devices hold, and its chunks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shape {
    pub(super) n: u32,
    pub(super) l: u32,
    pub(super) q: u32,
    pub(super) chunks: Vec<Chunk>,
    pub(super) method: Method,
    pub(super) gaps: GapMode,
}

/// How pairs are counted; the scores are the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Method {
    /// A histogram a lane, rows grouped by symbol: the work does not depend on the alphabet.
    Histograms,
    /// Bit planes: `(q - 1)^2` operations for 32 rows, for alphabets of 2 to 6 symbols.
    Planes,
}

impl Method {
    /// The quicker one for an alphabet of `q` symbols; bit planes know no gaps that stand apart.
    fn of(q: u32, gaps: GapMode) -> Self {
        if gaps == GapMode::Ormi && PLANES_SYMBOLS.contains(&q) { Self::Planes } else { Self::Histograms }
    }
}

fn narrow(value: usize) -> u32 {
    u32::try_from(value).expect("a shape's sizes are bounded far below 2^32")
}

impl Shape {
    /// The shape of an alignment.
    ///
    /// # Errors
    /// A size that no device holds.
    pub fn new(alignment: &Alignment) -> Result<Self, ShapeError> {
        Self::with_binding_bytes(alignment, BINDING_BYTES)
    }

    /// A shape whose bindings hold at most `binding_bytes` (more only where one column needs it).
    ///
    /// # Errors
    /// A size that no device holds.
    pub fn with_binding_bytes(alignment: &Alignment, binding_bytes: u64) -> Result<Self, ShapeError> {
        let (n, l) = (alignment.n(), alignment.l());
        if n > MAX_KERNEL_ROWS {
            return Err(ShapeError::Rows { n });
        }
        if l < 2 {
            return Err(ShapeError::Columns { l });
        }
        if n.next_multiple_of(4) as u64 * l.next_multiple_of(4) as u64 > BINDING_BYTES {
            return Err(ShapeError::Symbols { n, l });
        }
        if pair_count(l) as u64 * PAIR_BYTES > RESULT_BYTES {
            return Err(ShapeError::Pairs { l });
        }
        let column_bytes = n.div_ceil(2) as u64 * 4;
        // Parts of equal size, but for the column where one ends; smaller where a binding holds fewer columns.
        let parts = (pair_count(l) as u64 * PAIR_BYTES).div_ceil(PART_BYTES);
        let most_pairs = (pair_count(l) as u64).div_ceil(parts) + l as u64;
        let mut chunks: Vec<Chunk> = Vec::new();
        let mut first_place = 0;
        for i in 0..narrow(l) - 1 {
            let pairs = narrow(l) - 1 - i;
            match chunks.last_mut() {
                Some(chunk)
                    if u64::from(chunk.columns + 1) * column_bytes <= binding_bytes
                        && u64::from(chunk.pairs + pairs) * 8 <= binding_bytes
                        && u64::from(chunk.pairs + pairs) <= most_pairs =>
                {
                    chunk.columns += 1;
                    chunk.pairs += pairs;
                }
                _ => chunks.push(Chunk { first_i: i, columns: 1, first_place, pairs }),
            }
            first_place += pairs;
        }
        let q = narrow(alignment.q());
        let gaps = alignment.gaps();
        Ok(Self { n: narrow(n), l: narrow(l), q, chunks, method: Method::of(q, gaps), gaps })
    }

    /// The shape with histograms also for a small alphabet: to compare the two.
    #[must_use]
    pub fn with_histograms(self) -> Self {
        Self { method: Method::Histograms, ..self }
    }

    /// How pairs are counted.
    #[must_use]
    pub fn method(&self) -> Method {
        self.method
    }

    /// Pairs of columns.
    #[must_use]
    pub fn pairs(&self) -> usize {
        pair_count(self.l as usize)
    }

    /// Sequences.
    #[must_use]
    pub fn rows(&self) -> u32 {
        self.n
    }

    /// Size of the alphabet.
    #[must_use]
    pub fn symbols(&self) -> u32 {
        self.q
    }

    /// How gaps count.
    #[must_use]
    pub fn gaps(&self) -> GapMode {
        self.gaps
    }

    /// The parts of the pairs that share bindings.
    #[must_use]
    pub fn chunks(&self) -> &[Chunk] {
        &self.chunks
    }

    /// The chunks, in parts whose sums are few enough bytes for one job's result.
    #[must_use]
    pub fn parts(&self) -> Vec<Range<usize>> {
        let mut parts: Vec<Range<usize>> = Vec::new();
        let mut bytes = 0;
        for (index, chunk) in self.chunks.iter().enumerate() {
            let more = u64::from(chunk.pairs) * PAIR_BYTES;
            match parts.last_mut() {
                Some(part) if bytes + more <= PART_BYTES => {
                    part.end = index + 1;
                    bytes += more;
                }
                _ => {
                    parts.push(index..index + 1);
                    bytes = more;
                }
            }
        }
        parts
    }

    /// Pairs of some of the chunks.
    #[must_use]
    pub fn pairs_of(&self, chunks: Range<usize>) -> usize {
        self.chunks.get(chunks).unwrap_or_default().iter().map(|chunk| chunk.pairs as usize).sum()
    }

    pub(super) fn sizes(&self) -> Sizes {
        // As crate::Feistel::new.
        let bits = self.n.next_power_of_two().trailing_zeros().max(2);
        Sizes {
            n: self.n,
            l: self.l,
            row_words: self.l.div_ceil(4),
            column_words: self.n.div_ceil(4),
            order_words: self.n.div_ceil(2),
            left_bits: bits / 2,
            right_bits: bits - bits / 2,
            plane_words: self.n.div_ceil(32),
            // An alignment without a scale has no reference, and no job.
            scale_bits: scale_bits(self.n, self.gaps.scale_symbols(self.q)).unwrap_or(0),
            padding: [0; 3],
        }
    }

    /// The uniform of a chunk, and the z extent of its launch.
    pub(super) fn range(&self, chunk: Chunk) -> (ChunkRange, u32) {
        let first_block = (chunk.first_i + 1) / BLOCK_COLUMNS;
        let blocks = self.l.div_ceil(BLOCK_COLUMNS) - first_block;
        let mut columns_x = COLUMNS_X.min(chunk.columns);
        while blocks * chunk.columns.div_ceil(columns_x) > GROUPS {
            columns_x *= 2;
        }
        let column_groups = chunk.columns.div_ceil(columns_x);
        let range = ChunkRange {
            first_i: chunk.first_i,
            columns: chunk.columns,
            first_place: chunk.first_place,
            first_block,
            columns_x,
            column_groups,
            padding: [0; 2],
        };
        (range, blocks * column_groups)
    }
}

/// An alignment's arrays as kernels bind them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PackedAlignment {
    /// Symbol codes, a byte each, each column padded to four.
    pub codes: Vec<u8>,
    /// For each chunk: its columns' rows in the order of their symbols, 16 bits each, each column padded to four bytes.
    pub orders: Vec<Vec<u8>>,
    /// Where each symbol begins in that order, `q + 1` words a column.
    pub bounds: Vec<u8>,
    /// The fixed-point table.
    pub table: Vec<u8>,
    /// What each column adds to its pairs' scores.
    pub column_terms: Vec<u8>,
}

impl PackedAlignment {
    /// Packs an alignment of a shape.
    #[must_use]
    pub fn new(reference: &Reference<'_>, shape: &Shape) -> Self {
        let alignment = reference.alignment();
        let column_bytes = alignment.n().next_multiple_of(4);
        let mut codes = Vec::with_capacity(column_bytes * alignment.l());
        let mut bounds = Vec::with_capacity(alignment.l() * (alignment.q() + 1));
        for column in 0..alignment.l() {
            codes.extend_from_slice(alignment.column(column));
            codes.resize(column_bytes * (column + 1), 0);
            let mut start = 0_u32;
            for count in crate::reference::composition(alignment.column(column), alignment.q()) {
                bounds.push(start);
                start += count;
            }
            bounds.push(start);
        }
        let orders = shape.chunks.iter().map(|chunk| symbol_order(alignment, &bounds, *chunk)).collect();
        Self {
            codes,
            orders,
            bounds: bytemuck::cast_slice(&bounds).to_vec(),
            table: bytemuck::cast_slice(reference.fixed_point().table()).to_vec(),
            column_terms: bytemuck::cast_slice(reference.column_terms().words()).to_vec(),
        }
    }
}

/// On all cores: it is what an application does before its first job, and of large alignments it takes half a second of one.
fn symbol_order(alignment: &Alignment, bounds: &[u32], chunk: Chunk) -> Vec<u8> {
    let stride = 2 * alignment.n().next_multiple_of(2);
    let columns = chunk.columns as usize;
    let mut orders = vec![0; stride * columns];
    let first = chunk.first_i as usize;
    orders.par_chunks_exact_mut(stride).zip(first..first + columns).for_each(|(order, column)| {
        order_column(alignment, bounds, column, order);
    });
    orders
}

fn order_column(alignment: &Alignment, bounds: &[u32], column: usize, order: &mut [u8]) {
    let first = column * (alignment.q() + 1);
    let mut next = bounds[first..first + alignment.q()].to_vec();
    for (row, code) in (0_u16..).zip(alignment.column(column)) {
        let place = &mut next[usize::from(*code)];
        let at = 2 * *place as usize;
        order[at..at + 2].copy_from_slice(&row.to_ne_bytes());
        *place += 1;
    }
}

/// The names of a packed alignment's arrays in the farm, and of the module.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AlignmentContents {
    /// [`PackedAlignment::codes`].
    pub codes: Content,
    /// [`PackedAlignment::orders`].
    pub orders: Vec<Content>,
    /// [`PackedAlignment::bounds`].
    pub bounds: Content,
    /// [`PackedAlignment::table`].
    pub table: Content,
    /// [`PackedAlignment::column_terms`].
    pub column_terms: Content,
    /// [`super::module_source`] of the shape.
    pub module: Content,
}

impl Shape {
    /// Observed scores of all pairs as each chunk binds them.
    ///
    /// # Panics
    /// There is not one score for each pair.
    #[must_use]
    pub fn observed_bytes(&self, observed: &[i32]) -> Vec<Vec<u8>> {
        assert_eq!(observed.len(), self.pairs(), "one score for each pair");
        let part = |chunk: &Chunk| {
            let first = chunk.first_place as usize;
            bytemuck::cast_slice(&observed[first..first + chunk.pairs as usize]).to_vec()
        };
        self.chunks.iter().map(part).collect()
    }
}
