//! Mutual information of sequence alignments with the shuffling null model (thesis 5.5.1; Hamacher 2008, Weil 2009,
//! Waechter 2012).
//!
//! Owns the alignment formats ([`parse`]), [`Filters`], the integer definition of mutual information on the host ([`Reference`]) and
//! the null model with its order-independent sums ([`NullModel`], [`Accumulators`]), and the kernels that compute the same
//! ([`gpu`]). Everything that a result depends on is an
//! integer, so the same alignment, seed and iterations give the same bytes on any machine and in any split over jobs. It never
//! opens a file, never asks a clock and never names a GPU library: whoever runs it hands in bytes and a seed.
//!
//! ```
//! use mi_kernel::{NullModel, Reference, Seed, ShuffleKind, parse};
//!
//! let parsed = parse(b">a\nACA\n>b\nACC\n>c\nGTA\n>d\nGTC\n")?;
//! let reference = Reference::new(&parsed.alignment)?;
//! let null = NullModel::new(&reference, Seed(1), ShuffleKind::Feistel);
//! let mut sums = null.run(0..50)?;
//! sums.merge(null.run(50..100)?)?;
//! let best = sums.statistics(&null).into_iter().max_by(|a, b| a.mi_bits.total_cmp(&b.mi_bits));
//! assert_eq!(best.map(|pair| (pair.i, pair.j)), Some((0, 1)), "columns 0 and 1 vary together");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod alignment;
mod filter;
mod fixed_point;
mod formats;
mod gaps;
pub mod generate;
pub mod gpu;
pub mod histogram;
#[cfg(feature = "farm")]
pub mod job;
mod null_model;
pub mod output;
mod philox;
mod reference;
pub mod saved;
mod shuffle;

pub use self::{
    alignment::{Alignment, AlignmentError, GAP, MAX_COLUMNS, MAX_ROWS},
    filter::{FilterError, Filters},
    fixed_point::{FixedPoint, MAX_SCALE_BITS, log2_q57},
    formats::{Format, MAX_LINE_BYTES, Parsed, ParsingNotes, parse, parse_as},
    gaps::{GapMode, SCORE_BITS},
    null_model::{Accumulators, NullModel, NullModelError, PairStatistics, PairSums},
    philox::philox4x32_10,
    reference::{PairIndex, Reference, ReferenceError, pair_count},
    shuffle::{FEISTEL_ROUNDS, Feistel, Seed, ShuffleKind},
};
