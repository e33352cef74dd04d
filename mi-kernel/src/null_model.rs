//! The shuffling null model: each iteration permutes every column by itself, so compositions stay and couplings go.
//!
//! Owns the sums over iterations and the statistics made of them. All sums are integers, so any split of the iterations
//! over jobs, in any order, gives the same bytes. Never decides how iterations are split.

use std::{collections::BTreeMap, ops::Range};

use thiserror::Error;

use crate::{
    reference::{PairIndex, Reference, pair_count},
    shuffle::{Seed, ShuffleKind},
};

/// Sums that cannot be made or joined. Not to be retried.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum NullModelError {
    /// A sum left its integer.
    #[error("pair ({i}, {j}): the sums of {iterations} iterations leave 64 bits")]
    Overflow {
        /// First column.
        i: usize,
        /// Second column.
        j: usize,
        /// Iterations summed.
        iterations: usize,
    },
    /// An iteration would count twice.
    #[error("iteration {iteration} is in both sums")]
    Doubled {
        /// Which.
        iteration: u64,
    },
    /// No iterations make such sums: they were damaged, or made up.
    #[error("pair ({i}, {j}): no {iterations} iterations have these sums")]
    Impossible {
        /// First column.
        i: usize,
        /// Second column.
        j: usize,
        /// Iterations that they are said to be of.
        iterations: usize,
    },
    /// Sums of different alignments.
    #[error("sums over {ours} pairs cannot take sums over {theirs}")]
    Pairs {
        /// Pairs here.
        ours: usize,
        /// Pairs there.
        theirs: usize,
    },
}

/// The null model of one alignment.
#[derive(Clone, Copy, Debug)]
pub struct NullModel<'r, 'a> {
    reference: &'r Reference<'a>,
    seed: Seed,
    kind: ShuffleKind,
}

impl<'r, 'a> NullModel<'r, 'a> {
    /// A null model; two of the same arguments are the same.
    #[must_use]
    pub fn new(reference: &'r Reference<'a>, seed: Seed, kind: ShuffleKind) -> Self {
        Self { reference, seed, kind }
    }

    /// Sums over a range of iterations (`reduce` mode: one job).
    ///
    /// # Errors
    /// A sum leaves 64 bits.
    pub fn run(&self, iterations: Range<u64>) -> Result<Accumulators, NullModelError> {
        let mut sums = Accumulators::new(self.reference.alignment().l());
        for iteration in iterations {
            sums.add(iteration, &self.scores(iteration), self.reference.observed())?;
        }
        Ok(sums)
    }

    /// X of all pairs in one iteration (`matrix` mode: one job).
    #[must_use]
    pub fn scores(&self, iteration: u64) -> Vec<i32> {
        let alignment = self.reference.alignment();
        let shuffled: Vec<Vec<u8>> =
            (0..alignment.l()).map(|column| self.shuffled_column(iteration, column)).collect();
        let columns: Vec<&[u8]> = shuffled.iter().map(Vec::as_slice).collect();
        let mut scores = vec![0; pair_count(alignment.l())];
        self.reference.score_pairs(&columns, &mut scores);
        scores
    }

    /// One column as one iteration has it.
    ///
    /// # Panics
    /// `column` is not below L.
    #[must_use]
    pub fn shuffled_column(&self, iteration: u64, column: usize) -> Vec<u8> {
        let codes = self.reference.alignment().column(column);
        let mut sources = vec![0; codes.len()];
        let key_column = u32::try_from(column).expect("columns are bounded by MAX_COLUMNS");
        self.kind.fill(&mut sources, self.seed, iteration, key_column);
        sources.iter().map(|source| codes[*source as usize]).collect()
    }
}

/// Sums over iterations for all pairs, in the order of [`PairIndex::place`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Accumulators {
    l: usize,
    sum: Vec<i64>,
    sum_of_squares: Vec<u64>,
    at_least_observed: Vec<u32>,
    /// The largest X of each iteration over all pairs; its keys say which iterations are in.
    maxima: BTreeMap<u64, i32>,
}

impl Accumulators {
    /// Empty sums for `l` columns.
    #[must_use]
    pub fn new(l: usize) -> Self {
        let pairs = pair_count(l);
        Self {
            l,
            sum: vec![0; pairs],
            sum_of_squares: vec![0; pairs],
            at_least_observed: vec![0; pairs],
            maxima: BTreeMap::new(),
        }
    }

    /// Sums as a job returns them or a file keeps them; `maxima` says which iterations they are of.
    ///
    /// # Errors
    /// A part has another number of pairs than `l` columns make, or no iterations make such sums.
    pub fn from_parts(
        l: usize,
        sum: Vec<i64>,
        sum_of_squares: Vec<u64>,
        at_least_observed: Vec<u32>,
        maxima: BTreeMap<u64, i32>,
    ) -> Result<Self, NullModelError> {
        let pairs = pair_count(l);
        for length in [sum.len(), sum_of_squares.len(), at_least_observed.len()] {
            if length != pairs {
                return Err(NullModelError::Pairs { ours: pairs, theirs: length });
            }
        }
        let sums = Self { l, sum, sum_of_squares, at_least_observed, maxima };
        match (0..pairs).find(|place| !sums.is_possible(*place)) {
            None => Ok(sums),
            Some(place) => {
                let pair = sums.pair(place);
                Err(NullModelError::Impossible { i: pair.i, j: pair.j, iterations: sums.iterations() })
            }
        }
    }

    /// Adds one iteration's scores.
    ///
    /// # Errors
    /// The iteration is in already, a slice has another number of pairs, or a sum leaves 64 bits; the sums are then not to be
    /// used any more.
    pub fn add(&mut self, iteration: u64, scores: &[i32], observed: &[i32]) -> Result<(), NullModelError> {
        for slice in [scores, observed] {
            if slice.len() != self.sum.len() {
                return Err(NullModelError::Pairs { ours: self.sum.len(), theirs: slice.len() });
            }
        }
        if self.maxima.contains_key(&iteration) {
            return Err(NullModelError::Doubled { iteration });
        }
        self.maxima.insert(iteration, scores.iter().copied().max().unwrap_or(0));
        for (place, (score, seen)) in scores.iter().zip(observed).enumerate() {
            let magnitude = u64::from(score.unsigned_abs());
            let reached = u32::from(score >= seen);
            self.add_at(place, i64::from(*score), magnitude * magnitude, reached)?;
        }
        Ok(())
    }

    /// Takes in the sums of other iterations. The order of merging does not matter.
    ///
    /// # Errors
    /// An iteration is in both, the alignments differ, or a sum leaves 64 bits; the sums are then not to be used any more.
    pub fn merge(&mut self, other: Self) -> Result<(), NullModelError> {
        if other.sum.len() != self.sum.len() {
            return Err(NullModelError::Pairs { ours: self.sum.len(), theirs: other.sum.len() });
        }
        if let Some(iteration) = other.maxima.keys().find(|iteration| self.maxima.contains_key(iteration)) {
            return Err(NullModelError::Doubled { iteration: *iteration });
        }
        self.maxima.extend(&other.maxima);
        for place in 0..other.sum.len() {
            let reached = other.at_least_observed[place];
            self.add_at(place, other.sum[place], other.sum_of_squares[place], reached)?;
        }
        Ok(())
    }

    /// Number of iterations summed.
    #[must_use]
    pub fn iterations(&self) -> usize {
        self.maxima.len()
    }

    /// Sum of X of each pair.
    #[must_use]
    pub fn sum(&self) -> &[i64] {
        &self.sum
    }

    /// Sum of X^2 of each pair.
    #[must_use]
    pub fn sum_of_squares(&self) -> &[u64] {
        &self.sum_of_squares
    }

    /// How many iterations reached each pair's observed X.
    #[must_use]
    pub fn at_least_observed(&self) -> &[u32] {
        &self.at_least_observed
    }

    /// The largest X of each iteration.
    #[must_use]
    pub fn maxima(&self) -> &BTreeMap<u64, i32> {
        &self.maxima
    }

    /// The pair with the highest Z so far, as a run goes on: `observed` holds the observed scores. `None` while no pair's null
    /// model varies.
    ///
    /// # Panics
    /// There is not one observed score for each pair.
    #[must_use]
    pub fn leading(&self, observed: &[i32]) -> Option<(PairIndex, f64)> {
        assert_eq!(observed.len(), self.sum.len(), "one score for each pair");
        let z = |place: usize| {
            let (mean, sd) = moments(self.sum[place], self.sum_of_squares[place], self.iterations());
            (sd > 0.0).then(|| (f64::from(observed[place]) - mean) / sd)
        };
        PairIndex::all(self.l)
            .enumerate()
            .filter_map(|(place, pair)| Some((pair, z(place)?)))
            .max_by(|(_, first), (_, second)| first.total_cmp(second))
    }

    /// What the sums say about each pair, in order.
    ///
    /// # Panics
    /// The null model is that of an alignment with another number of columns.
    #[must_use]
    pub fn statistics(&self, null: &NullModel<'_, '_>) -> Vec<PairStatistics> {
        let reference = null.reference;
        assert_eq!(self.l, reference.alignment().l(), "sums and null model are of one alignment");
        let runs = self.iterations();
        PairIndex::all(self.l)
            .enumerate()
            .map(|(place, PairIndex { i, j })| {
                let observed = reference.observed()[place];
                let (mean, sd) = moments(self.sum[place], self.sum_of_squares[place], runs);
                let undefined = reference.is_constant(i) || reference.is_constant(j) || sd == 0.0;
                let distance = f64::from(observed) - mean;
                PairStatistics {
                    i,
                    j,
                    mi_bits: reference.bits(f64::from(observed)),
                    null_mean_bits: reference.bits(mean),
                    null_sd_bits: reference.bits(sd),
                    z: if undefined { 0.0 } else { distance / sd },
                    z_undefined: undefined,
                    p: (1.0 + f64::from(self.at_least_observed[place])) / (runs as f64 + 1.0),
                }
            })
            .collect()
    }

    fn add_at(&mut self, place: usize, sum: i64, squares: u64, reached: u32) -> Result<(), NullModelError> {
        let sums = self.sum[place]
            .checked_add(sum)
            .zip(self.sum_of_squares[place].checked_add(squares))
            .zip(self.at_least_observed[place].checked_add(reached));
        let Some(((sum, squares), reached)) = sums else {
            return Err(self.overflow(place));
        };
        self.sum[place] = sum;
        self.sum_of_squares[place] = squares;
        self.at_least_observed[place] = reached;
        Ok(())
    }

    /// Cauchy-Schwarz: (sum of X)^2 <= iterations * (sum of X^2). [`moments`] takes the root of the difference.
    fn is_possible(&self, place: usize) -> bool {
        let runs = self.iterations() as u128;
        let square = u128::from(self.sum[place].unsigned_abs()).pow(2);
        square <= u128::from(self.sum_of_squares[place]) * runs
            && (runs > 0 || self.sum_of_squares[place] == 0)
            && u128::from(self.at_least_observed[place]) <= runs
    }

    fn pair(&self, place: usize) -> PairIndex {
        PairIndex::all(self.l).nth(place).expect("the place is of a pair")
    }

    fn overflow(&self, place: usize) -> NullModelError {
        let pair = self.pair(place);
        NullModelError::Overflow { i: pair.i, j: pair.j, iterations: self.iterations() }
    }
}

/// Mean and population standard deviation, from exact integers up to the last division.
fn moments(sum: i64, squares: u64, runs: usize) -> (f64, f64) {
    if runs == 0 {
        return (0.0, 0.0);
    }
    // |sum| <= sqrt(squares * runs) and squares < 2^64, so for fewer than 2^63 runs nothing leaves 128 bits, and by
    // Cauchy-Schwarz the difference is not negative.
    let spread = i128::from(squares) * (runs as i128) - i128::from(sum) * i128::from(sum);
    let runs = runs as f64;
    (sum as f64 / runs, (spread as f64).sqrt() / runs)
}

/// One pair's result. Never NaN or infinite.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairStatistics {
    /// First column, from 0.
    pub i: usize,
    /// Second column, above `i`.
    pub j: usize,
    /// Observed mutual information.
    pub mi_bits: f64,
    /// Mean over the iterations.
    pub null_mean_bits: f64,
    /// Population standard deviation over the iterations.
    pub null_sd_bits: f64,
    /// `(mi - null mean) / null sd`; 0 where undefined.
    pub z: f64,
    /// The null model does not vary: a constant column, or too few iterations.
    pub z_undefined: bool,
    /// Empirical: `(1 + iterations that reached the observed value) / (iterations + 1)`.
    pub p: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_those_of_the_population() {
        let (mean, sd) = moments(1 + 2 + 3 + 10, 1 + 4 + 9 + 100, 4);
        assert_eq!((mean, sd), (4.0, 12.5f64.sqrt()));
        assert_eq!(moments(-6, 12, 3), (-2.0, 0.0));
        assert_eq!(moments(0, 0, 0), (0.0, 0.0));
    }

    #[test]
    fn an_iteration_counts_once() {
        let mut sums = Accumulators::new(2);
        sums.add(4, &[7], &[7]).unwrap();
        assert_eq!(sums.add(4, &[7], &[7]), Err(NullModelError::Doubled { iteration: 4 }));
        let copy = sums.clone();
        assert_eq!(sums.merge(copy), Err(NullModelError::Doubled { iteration: 4 }));
        assert_eq!(sums.merge(Accumulators::new(3)), Err(NullModelError::Pairs { ours: 1, theirs: 3 }));
        assert_eq!((sums.iterations(), sums.at_least_observed()), (1, &[1][..]));
    }

    #[test]
    fn sums_that_no_iterations_have_are_refused_by_their_pair() {
        let of = |sum, squares, reached, runs: u64| {
            let maxima = (0..runs).map(|iteration| (iteration, 0)).collect();
            Accumulators::from_parts(3, vec![0, sum, 0], vec![0, squares, 0], vec![0, reached, 0], maxima)
        };
        assert!(of(6, 12, 3, 3).is_ok(), "2 three times");
        assert!(of(-(1 << 32), 1 << 63, 0, 2).is_ok(), "the least X twice: both sides are equal");
        for (case, (sum, squares, reached, runs)) in [
            ("a sum without squares", (7, 12, 0, 3)),
            ("a sum below", (-7, 12, 0, 3)),
            ("squares of no iteration", (0, 1, 0, 0)),
            ("reached too often", (6, 12, 4, 3)),
        ] {
            let error = of(sum, squares, reached, runs).unwrap_err();
            let iterations = usize::try_from(runs).unwrap();
            assert_eq!(error, NullModelError::Impossible { i: 0, j: 2, iterations }, "{case}");
        }
    }

    #[test]
    fn a_sum_that_does_not_fit_is_an_error() {
        let mut sums = Accumulators::new(3);
        for iteration in 0..3 {
            sums.add(iteration, &[0, i32::MIN, 0], &[0, 0, 0]).unwrap();
        }
        let error = sums.add(3, &[0, i32::MIN, 0], &[0, 0, 0]).unwrap_err();
        assert_eq!(error, NullModelError::Overflow { i: 0, j: 2, iterations: 4 });
    }
}
