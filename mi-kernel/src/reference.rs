//! Mutual information of all pairs of columns as integers: the definition that kernels are compared with, bit for
//! bit.

use thiserror::Error;

use crate::{
    Alignment, FixedPoint, GapMode, SCORE_BITS,
    gaps::{ColumnTerms, residue_entropy},
};

/// Most pairs the host holds at once (8 GiB of accumulators); a kernel splits its accumulators over bindings instead.
const MAX_PAIRS: usize = 1 << 28;

/// The alignment is too large for the fixed point or the host. Not to be retried.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum ReferenceError {
    /// No scale keeps scores in 31 bits.
    #[error("{n} sequences over {q} symbols do not fit 32-bit scores")]
    Scale {
        /// Sequences.
        n: usize,
        /// Symbols.
        q: usize,
    },
    /// Too many pairs of columns.
    #[error("{l} columns make more than {limit} pairs")]
    Pairs {
        /// Columns.
        l: usize,
        /// Most pairs.
        limit: usize,
    },
    /// Scores of another alignment.
    #[error("{scores} scores for {pairs} pairs of columns")]
    Scores {
        /// Pairs of the alignment.
        pairs: usize,
        /// Scores given.
        scores: usize,
    },
}

/// A pair of columns, `i < j`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct PairIndex {
    /// The first column.
    pub i: usize,
    /// The second column.
    pub j: usize,
}

impl PairIndex {
    /// Place of the pair in the order of all results: (0,1), (0,2), ..., (1,2), ... for `l` columns.
    #[must_use]
    pub fn place(self, l: usize) -> usize {
        self.i * (2 * l - self.i - 1) / 2 + self.j - self.i - 1
    }

    /// All pairs of `l` columns in the order of [`Self::place`].
    pub fn all(l: usize) -> impl Iterator<Item = Self> {
        (0..l).flat_map(move |i| (i + 1..l).map(move |j| Self { i, j }))
    }
}

/// Number of pairs of `l` columns.
#[must_use]
pub fn pair_count(l: usize) -> usize {
    l * l.saturating_sub(1) / 2
}

/// An alignment with its table and observed scores: `X(i,j) = N * MI(i,j) * 2^s`, or `MI(i,j) * 2^`[`SCORE_BITS`] where gaps
/// stand apart.
#[derive(Clone, Debug)]
pub struct Reference<'a> {
    alignment: &'a Alignment,
    fixed_point: FixedPoint,
    column_terms: ColumnTerms,
    /// The diagonal, as scores.
    entropies: Vec<i32>,
    /// Which columns hold one symbol only, or one residue where gaps stand apart.
    constant: Vec<bool>,
    observed: Vec<i32>,
}

impl<'a> Reference<'a> {
    /// Counts columns and scores all pairs.
    ///
    /// # Errors
    /// The alignment is too large.
    pub fn new(alignment: &'a Alignment) -> Result<Self, ReferenceError> {
        let mut reference = Self::unscored(alignment)?;
        let columns: Vec<&[u8]> = (0..alignment.l()).map(|column| alignment.column(column)).collect();
        let mut observed = vec![0; pair_count(alignment.l())];
        reference.score_pairs(&columns, &mut observed);
        reference.observed = observed;
        Ok(reference)
    }

    /// Takes the scores of all pairs from elsewhere: a device computes them faster.
    ///
    /// # Errors
    /// The alignment is too large, or there is not one score for each pair.
    pub fn with_observed(alignment: &'a Alignment, observed: Vec<i32>) -> Result<Self, ReferenceError> {
        let reference = Self::unscored(alignment)?;
        let pairs = pair_count(alignment.l());
        if observed.len() != pairs {
            return Err(ReferenceError::Scores { pairs, scores: observed.len() });
        }
        Ok(Self { observed, ..reference })
    }

    /// Counts columns only: what a device needs to score the pairs. [`Self::observed`] is empty.
    ///
    /// # Errors
    /// The alignment is too large.
    pub fn unscored(alignment: &'a Alignment) -> Result<Self, ReferenceError> {
        let (n, q, l) = (alignment.n(), alignment.q(), alignment.l());
        if pair_count(l) > MAX_PAIRS {
            return Err(ReferenceError::Pairs { l, limit: MAX_PAIRS });
        }
        let sizes = u32::try_from(n).ok().zip(u32::try_from(q).ok());
        let fixed_point = sizes
            .and_then(|(n, q)| FixedPoint::new(n, alignment.gaps().scale_symbols(q)))
            .ok_or(ReferenceError::Scale { n, q })?;
        let compositions: Vec<Vec<u32>> =
            (0..l).map(|column| composition(alignment.column(column), q)).collect();
        let column_terms = ColumnTerms::new(alignment.gaps(), &fixed_point, &compositions);
        let all_rows = fixed_point.table()[n];
        let (entropies, uncounted) = match alignment.gaps() {
            GapMode::Ormi => {
                // sum T(c_aa) is the column's own term, so one of the two subtracted terms cancels.
                let own = |counts: &Vec<u32>| all_rows.wrapping_sub(fixed_point.sum(counts)).cast_signed();
                (compositions.iter().map(own).collect(), 0)
            }
            GapMode::Sumi | GapMode::Demi | GapMode::Esmi => {
                (compositions.iter().map(|counts| residue_entropy(counts)).collect(), 1)
            }
        };
        let constant = compositions
            .iter()
            .map(|counts| counts[uncounted..].iter().filter(|count| **count > 0).count() <= 1)
            .collect();
        Ok(Self { alignment, fixed_point, column_terms, entropies, constant, observed: Vec::new() })
    }

    /// What each column adds to its pairs' scores.
    pub(crate) fn column_terms(&self) -> &ColumnTerms {
        &self.column_terms
    }

    /// A score in bits of mutual information.
    #[must_use]
    pub fn bits(&self, score: f64) -> f64 {
        match self.alignment.gaps() {
            GapMode::Ormi => {
                let rows = self.alignment.n() as f64;
                score / (rows * f64::from(1_u32 << self.fixed_point.scale_bits()))
            }
            GapMode::Sumi | GapMode::Demi | GapMode::Esmi => score / f64::from(1_u32 << SCORE_BITS),
        }
    }

    /// The alignment.
    #[must_use]
    pub fn alignment(&self) -> &'a Alignment {
        self.alignment
    }

    /// The table and scale.
    #[must_use]
    pub fn fixed_point(&self) -> &FixedPoint {
        &self.fixed_point
    }

    /// Observed X of all pairs, in the order of [`PairIndex::place`].
    #[must_use]
    pub fn observed(&self) -> &[i32] {
        &self.observed
    }

    /// Whether a column holds one symbol only: its mutual information is 0 with everything and its Z undefined.
    ///
    /// # Panics
    /// `column` is not below L.
    #[must_use]
    pub fn is_constant(&self, column: usize) -> bool {
        self.constant[column]
    }

    /// Entropy of a column as a score, the diagonal `MI(i,i) = H(i)`.
    ///
    /// # Panics
    /// `column` is not below L.
    #[must_use]
    pub fn entropy(&self, column: usize) -> i32 {
        self.entropies[column]
    }

    /// The L x L matrix of mutual information in bits, row by row, entropies on the diagonal.
    #[must_use]
    pub fn matrix_bits(&self) -> Vec<f64> {
        let l = self.alignment.l();
        let mut matrix = vec![0.0; l * l];
        for column in 0..l {
            matrix[column * l + column] = self.bits(f64::from(self.entropy(column)));
        }
        for (pair, score) in PairIndex::all(l).zip(&self.observed) {
            let bits = self.bits(f64::from(*score));
            matrix[pair.i * l + pair.j] = bits;
            matrix[pair.j * l + pair.i] = bits;
        }
        matrix
    }

    /// X of all pairs of columns that have the compositions of this alignment's.
    pub(crate) fn score_pairs(&self, columns: &[&[u8]], scores: &mut [i32]) {
        let q = self.alignment.q();
        let mut joint = vec![0u32; q * q];
        let mut scores = scores.iter_mut();
        for (i, first) in columns.iter().enumerate() {
            for (j, second) in columns.iter().enumerate().skip(i + 1) {
                joint.fill(0);
                for (a, b) in first.iter().zip(*second) {
                    joint[usize::from(*a) * q + usize::from(*b)] += 1;
                }
                let score = self.column_terms.score(&self.fixed_point, &joint, i, j);
                *scores.next().expect("one score for each pair") = score;
            }
        }
    }
}

/// How often each symbol occurs in a column.
pub(crate) fn composition(column: &[u8], q: usize) -> Vec<u32> {
    let mut counts = vec![0; q];
    for code in column {
        counts[usize::from(*code)] += 1;
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parse;

    #[test]
    fn pairs_are_numbered_without_holes() {
        for l in 0..9 {
            let places: Vec<usize> = PairIndex::all(l).map(|pair| pair.place(l)).collect();
            assert_eq!(places, (0..pair_count(l)).collect::<Vec<_>>(), "{l} columns");
        }
    }

    #[test]
    fn the_textbook_case() {
        // Column 0 and 1 are the same fair bit (1 bit); column 2 is independent of both; column 3 is constant.
        let parsed = parse(b"AAAC\nAACC\nCCAC\nCCCC\n").unwrap();
        let reference = Reference::new(&parsed.alignment).unwrap();
        let expected = [1., 1., 0., 0., 1., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 0.];
        assert_eq!(reference.matrix_bits(), expected);
        assert_eq!(
            (0..4).map(|column| reference.is_constant(column)).collect::<Vec<_>>(),
            [false, false, false, true]
        );
    }

    #[test]
    fn too_many_pairs_are_refused() {
        let wide = "A".repeat(30_000);
        let parsed = parse(format!("{wide}\n{wide}\n").as_bytes()).unwrap();
        let error = Reference::new(&parsed.alignment).unwrap_err();
        assert_eq!(error, ReferenceError::Pairs { l: 30_000, limit: MAX_PAIRS });
    }
}
