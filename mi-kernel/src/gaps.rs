//! How gaps count in a pair's score: the four ways of Hamacher's group (BioPhysConnectoR, `get.mie`), in integers. The
//! counts are the same for all of them; what is made of the counts is here. Twins: `shaders/gaps_counted.wgsl`,
//! `shaders/gaps_apart.wgsl`.
//!
//! Where gaps are a symbol, all pairs have the same N rows, and a score is `N * MI * 2^s`. Where they stand apart, the
//! rows N' that count differ by pair and iteration, so a score is divided by its own N': `MI * 2^`[`SCORE_BITS`].

use crate::{FixedPoint, fixed_point::LOG_BITS, log2_q57};

/// Fractional bits of a score whose gaps stand apart: 1e-6 bits of mutual information. The largest score, some 32 bits
/// (two symbols that meet in two rows of 65,535), stays below 2^25, its square below 2^50.
pub const SCORE_BITS: u32 = 20;

/// Fractional bits of a surprisal below those of the table: `sum_a r_a * low(a)` is below 2^31 for N up to 65,535, so
/// both columns' sums fit a word.
const LOW_BITS: u32 = 15;

/// Rows with residues in both columns that a score needs.
const LEAST_ROWS: u32 = 2;

/// How gaps count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum GapMode {
    /// A gap is a symbol like all others.
    #[default]
    Ormi,
    /// Each pair is scored over the rows in which neither column has a gap.
    Sumi,
    /// `H(X) + H(Y) - H(X,Y)`, where H(X) and H(Y) are over each column's own residues, H(X,Y) over the rows with both.
    /// May be below 0.
    Demi,
    /// `sum p(x,y) log2(p(x,y) / (p(x) p(y)))`, where p(x) and p(y) are over each column's own residues, p(x,y) over the
    /// rows with both.
    Esmi,
}

impl GapMode {
    /// The alphabet that a table's scale is made for: apart from gaps a score before its division is up to `2 * N * log2 q`,
    /// as much as `q^2` symbols make.
    pub(crate) fn scale_symbols(self, q: u32) -> u32 {
        match self {
            Self::Ormi => q,
            Self::Sumi | Self::Demi | Self::Esmi => q * q,
        }
    }
}

/// What a column adds to each of its pairs' scores, as kernels bind it: [`Self::stride`] words a column. Shuffling does
/// not change it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ColumnTerms {
    gaps: GapMode,
    /// ORMI: `sum_a T(c_a)`. SUMI: nothing. DEMI: the entropy of its residues as a score. ESMI: of each symbol its
    /// surprisal `log2(residues / c_a)`, high part and low part.
    words: Vec<u32>,
    stride: usize,
}

impl ColumnTerms {
    /// The terms of columns of these compositions; the gap is symbol 0 unless it is a symbol like all others.
    pub(crate) fn new(gaps: GapMode, fixed_point: &FixedPoint, compositions: &[Vec<u32>]) -> Self {
        let symbols = compositions.first().map_or(0, Vec::len);
        let (stride, words) = match gaps {
            GapMode::Ormi => (1, compositions.iter().map(|counts| fixed_point.sum(counts)).collect()),
            GapMode::Sumi => (1, vec![0; compositions.len()]),
            GapMode::Demi => {
                (1, compositions.iter().map(|counts| residue_entropy(counts).cast_unsigned()).collect())
            }
            GapMode::Esmi => {
                let words = |counts: &Vec<u32>| surprisals(counts, fixed_point.scale_bits());
                (2 * symbols, compositions.iter().flat_map(words).collect())
            }
        };
        Self { gaps, words, stride }
    }

    /// All words, column after column.
    pub(crate) fn words(&self) -> &[u32] {
        &self.words
    }

    /// The score of columns `i` and `j` with these joint counts, row by row of column i's symbols.
    pub(crate) fn score(&self, fixed_point: &FixedPoint, joint: &[u32], i: usize, j: usize) -> i32 {
        let table = fixed_point.table();
        if self.gaps == GapMode::Ormi {
            let rows = joint.iter().sum::<u32>() as usize;
            let [first, second] = [i, j].map(|column| self.words[column]);
            let all = fixed_point.sum(joint).wrapping_add(table[rows]);
            return all.wrapping_sub(first).wrapping_sub(second).cast_signed();
        }
        let symbols = joint.len().isqrt();
        let (mut rows, mut terms, mut low) = (0_u32, 0_u32, 0_u32);
        for symbol in 1..symbols {
            let in_first: u32 = (1..symbols).map(|other| joint[symbol * symbols + other]).sum();
            let in_second: u32 = (1..symbols).map(|other| joint[other * symbols + symbol]).sum();
            rows += in_first;
            for other in 1..symbols {
                terms = terms.wrapping_add(table[joint[symbol * symbols + other] as usize]);
            }
            for (count, column) in [(in_first, i), (in_second, j)] {
                match self.gaps {
                    GapMode::Ormi | GapMode::Demi => {}
                    GapMode::Sumi => terms = terms.wrapping_sub(table[count as usize]),
                    GapMode::Esmi => {
                        let at = column * self.stride + 2 * symbol;
                        terms = terms.wrapping_add(count.wrapping_mul(self.words[at]));
                        low = low.wrapping_add(count.wrapping_mul(self.words[at + 1]));
                    }
                }
            }
        }
        if rows < LEAST_ROWS {
            return 0;
        }
        let all_rows = table[rows as usize];
        let quotient = |terms: u32| quotient(terms, rows, SCORE_BITS - fixed_point.scale_bits());
        match self.gaps {
            GapMode::Ormi | GapMode::Sumi => quotient(terms.wrapping_add(all_rows)),
            GapMode::Demi => {
                let own = self.words[i].wrapping_add(self.words[j]).cast_signed();
                quotient(terms.wrapping_sub(all_rows)).wrapping_add(own)
            }
            GapMode::Esmi => {
                let carried = low.wrapping_add(1 << (LOW_BITS - 1)) >> LOW_BITS;
                quotient(terms.wrapping_sub(all_rows).wrapping_add(carried))
            }
        }
    }
}

/// `terms * 2^bits / rows` of a signed number, rounded, halves away from zero. Long division: the product may leave a word.
fn quotient(terms: u32, rows: u32, bits: u32) -> i32 {
    let magnitude = terms.cast_signed().unsigned_abs();
    let (whole, rest) = (magnitude / rows, magnitude % rows);
    let value = ((whole << bits) + ((rest << bits) + rows / 2) / rows).cast_signed();
    if terms.cast_signed() < 0 { -value } else { value }
}

/// Entropy of a column's residues (all symbols but the first) as a score, rounded; 0 without any.
pub(crate) fn residue_entropy(counts: &[u32]) -> i32 {
    let rows: u128 = counts[1..].iter().copied().map(u128::from).sum();
    let own = |count: u128| count * u128::from(log2_q57(u64::try_from(count.max(1)).unwrap_or(u64::MAX)));
    let terms = own(rows) - counts[1..].iter().map(|count| own(u128::from(*count))).sum::<u128>();
    let entropy = terms / rows.max(1);
    i32::try_from(rounded(entropy, LOG_BITS - SCORE_BITS)).expect("an entropy is a few bits")
}

/// `log2(residues / c_a)` of each symbol, in parts of the table's scale and of [`LOW_BITS`] below it; 0 for the gap and
/// for symbols that do not occur.
fn surprisals(counts: &[u32], scale_bits: u32) -> Vec<u32> {
    let rows: u64 = counts[1..].iter().copied().map(u64::from).sum();
    let mut words = vec![0; 2 * counts.len()];
    for (symbol, count) in counts.iter().enumerate().skip(1).filter(|(_, count)| **count > 0) {
        let surprisal = u128::from(log2_q57(rows)).saturating_sub(u128::from(log2_q57(u64::from(*count))));
        let parts = rounded(surprisal, LOG_BITS - scale_bits - LOW_BITS);
        words[2 * symbol] = u32::try_from(parts >> LOW_BITS).expect("a surprisal is below 32 bits");
        words[2 * symbol + 1] = u32::try_from(parts & ((1 << LOW_BITS) - 1)).expect("masked");
    }
    words
}

fn rounded(value: u128, dropped_bits: u32) -> u128 {
    (value + (1 << (dropped_bits - 1))) >> dropped_bits
}
