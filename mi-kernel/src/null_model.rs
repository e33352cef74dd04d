//! The shuffling null model: each iteration permutes every column by itself, so compositions stay and couplings go.
//!
//! Owns the sums over iterations and the statistics made of them. All sums are integers, so any split of the iterations
//! over jobs, in any order, gives the same bytes. Never decides how iterations are split.

use std::{collections::BTreeMap, ops::Range};

use rayon::prelude::*;
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
    /// Parts of sums that are to be joined are of different iterations.
    #[error("the sums of the pairs from place {place} are of other iterations than those before")]
    OtherIterations {
        /// The first of their pairs, in the order of [`PairIndex::place`].
        place: usize,
    },
    /// Sums of different alignments, or not of all pairs.
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

/// Fewest pairs that are worth a core of their own.
const PAIRS_A_CORE: usize = 1 << 15;

/// Sums over iterations for consecutive pairs, in the order of [`PairIndex::place`]: what one job brings back.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PairSums {
    l: usize,
    first_place: usize,
    sum: Vec<i64>,
    sum_of_squares: Vec<u64>,
    at_least_observed: Vec<u32>,
    /// The largest X of each iteration over these pairs; its keys say which iterations are in.
    maxima: BTreeMap<u64, i32>,
}

impl PairSums {
    /// Sums of the pairs from `first_place` on of an alignment of `l` columns; `maxima` says which iterations they are of.
    ///
    /// # Errors
    /// The parts are of unequal lengths or leave the alignment, or no iterations make such sums.
    pub fn new(
        l: usize,
        first_place: usize,
        sum: Vec<i64>,
        sum_of_squares: Vec<u64>,
        at_least_observed: Vec<u32>,
        maxima: BTreeMap<u64, i32>,
    ) -> Result<Self, NullModelError> {
        same_pairs(sum.len(), &[sum_of_squares.len(), at_least_observed.len()])?;
        let end = first_place.saturating_add(sum.len());
        if end > pair_count(l) {
            return Err(NullModelError::Pairs { ours: pair_count(l), theirs: end });
        }
        let iterations = maxima.len();
        let impossible = (&sum, &sum_of_squares, &at_least_observed)
            .into_par_iter()
            .with_min_len(PAIRS_A_CORE)
            .enumerate()
            .filter(|(_, (sum, squares, reached))| !is_possible(**sum, **squares, **reached, iterations))
            .map(|(at, _)| at)
            .min();
        if let Some(at) = impossible {
            let pair = pair_at(l, first_place + at);
            return Err(NullModelError::Impossible { i: pair.i, j: pair.j, iterations });
        }
        Ok(Self { l, first_place, sum, sum_of_squares, at_least_observed, maxima })
    }

    /// How many pairs they are of.
    #[must_use]
    pub fn pairs(&self) -> usize {
        self.sum.len()
    }
}

/// Sums over iterations for all pairs, in the order of [`PairIndex::place`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Accumulators(PairSums);

impl Accumulators {
    /// Empty sums for `l` columns.
    #[must_use]
    pub fn new(l: usize) -> Self {
        let pairs = pair_count(l);
        Self(PairSums {
            l,
            first_place: 0,
            sum: vec![0; pairs],
            sum_of_squares: vec![0; pairs],
            at_least_observed: vec![0; pairs],
            maxima: BTreeMap::new(),
        })
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
        same_pairs(pair_count(l), &[sum.len(), sum_of_squares.len(), at_least_observed.len()])?;
        PairSums::new(l, 0, sum, sum_of_squares, at_least_observed, maxima).map(Self)
    }

    /// Adds one iteration's scores.
    ///
    /// # Errors
    /// The iteration is in already, a slice has another number of pairs, or a sum leaves 64 bits; the sums are then not to be
    /// used any more.
    pub fn add(&mut self, iteration: u64, scores: &[i32], observed: &[i32]) -> Result<(), NullModelError> {
        same_pairs(self.0.pairs(), &[scores.len(), observed.len()])?;
        if self.0.maxima.contains_key(&iteration) {
            return Err(NullModelError::Doubled { iteration });
        }
        self.0.maxima.insert(iteration, scores.iter().copied().max().unwrap_or(0));
        for (place, (score, seen)) in scores.iter().zip(observed).enumerate() {
            let magnitude = u64::from(score.unsigned_abs());
            let reached = u32::from(score >= seen);
            let sums = (
                &mut self.0.sum[place],
                &mut self.0.sum_of_squares[place],
                &mut self.0.at_least_observed[place],
            );
            let more = (i64::from(*score), magnitude * magnitude, reached);
            add_to(sums, more).ok_or_else(|| self.overflow(place))?;
        }
        Ok(())
    }

    /// Takes in the sums of other iterations. The order of merging does not matter.
    ///
    /// # Errors
    /// An iteration is in both, the alignments differ, or a sum leaves 64 bits; the sums are then not to be used any more.
    pub fn merge(&mut self, other: Self) -> Result<(), NullModelError> {
        self.merge_parts(vec![other.0])
    }

    /// Takes in the sums of other iterations, the same for all parts, which together are of all pairs. The order of parts and of
    /// merging does not matter.
    ///
    /// # Errors
    /// A pair is missing or in two parts, parts are of different iterations, an iteration is in already, the alignments differ, or
    /// a sum leaves 64 bits; the sums are then not to be used any more.
    pub fn merge_parts(&mut self, mut parts: Vec<PairSums>) -> Result<(), NullModelError> {
        parts.sort_by_key(|part| part.first_place);
        let mut covered = 0;
        for part in &parts {
            if part.l != self.0.l || part.first_place != covered {
                break;
            }
            covered += part.pairs();
        }
        let named: usize = parts.iter().map(PairSums::pairs).sum();
        if covered != self.0.pairs() || named != covered {
            return Err(NullModelError::Pairs { ours: self.0.pairs(), theirs: named });
        }
        let Some(first) = parts.first() else { return Ok(()) };
        if let Some(iteration) = first.maxima.keys().find(|iteration| self.0.maxima.contains_key(iteration)) {
            return Err(NullModelError::Doubled { iteration: *iteration });
        }
        if let Some(other) = parts.iter().find(|part| !part.maxima.keys().eq(first.maxima.keys())) {
            return Err(NullModelError::OtherIterations { place: other.first_place });
        }
        for part in &parts {
            for (&iteration, &largest) in &part.maxima {
                self.0.maxima.entry(iteration).and_modify(|x| *x = largest.max(*x)).or_insert(largest);
            }
        }
        let overflown = parts.iter().find_map(|part| self.add_part(part));
        overflown.map_or(Ok(()), |place| Err(self.overflow(place)))
    }

    /// Adds sums to those of the same pairs. Gives the first pair whose sums leave their integers.
    fn add_part(&mut self, part: &PairSums) -> Option<usize> {
        let places = part.first_place..part.first_place + part.pairs();
        let ours = (
            &mut self.0.sum[places.clone()],
            &mut self.0.sum_of_squares[places.clone()],
            &mut self.0.at_least_observed[places.clone()],
        );
        let theirs = (&part.sum, &part.sum_of_squares, &part.at_least_observed);
        (ours.0, ours.1, ours.2, theirs.0, theirs.1, theirs.2)
            .into_par_iter()
            .with_min_len(PAIRS_A_CORE)
            .zip(places)
            .filter_map(|((sum, squares, reached, more, more_squares, more_reached), place)| {
                let added = add_to((sum, squares, reached), (*more, *more_squares, *more_reached));
                added.is_none().then_some(place)
            })
            .min()
    }

    /// As the one part that they are.
    #[must_use]
    pub fn into_pair_sums(self) -> PairSums {
        self.0
    }

    /// Number of iterations summed.
    #[must_use]
    pub fn iterations(&self) -> usize {
        self.0.maxima.len()
    }

    /// Sum of X of each pair.
    #[must_use]
    pub fn sum(&self) -> &[i64] {
        &self.0.sum
    }

    /// Sum of X^2 of each pair.
    #[must_use]
    pub fn sum_of_squares(&self) -> &[u64] {
        &self.0.sum_of_squares
    }

    /// How many iterations reached each pair's observed X.
    #[must_use]
    pub fn at_least_observed(&self) -> &[u32] {
        &self.0.at_least_observed
    }

    /// The largest X of each iteration.
    #[must_use]
    pub fn maxima(&self) -> &BTreeMap<u64, i32> {
        &self.0.maxima
    }

    /// The pair with the highest Z so far, as a run goes on: `observed` holds the observed scores. `None` while no pair's null
    /// model varies.
    ///
    /// # Panics
    /// There is not one observed score for each pair.
    #[must_use]
    pub fn leading(&self, observed: &[i32]) -> Option<(PairIndex, f64)> {
        assert_eq!(observed.len(), self.0.pairs(), "one score for each pair");
        let z = |place: usize| {
            let (mean, sd) = moments(self.0.sum[place], self.0.sum_of_squares[place], self.iterations());
            (sd > 0.0).then(|| (f64::from(observed[place]) - mean) / sd)
        };
        PairIndex::all(self.0.l)
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
        assert_eq!(self.0.l, reference.alignment().l(), "sums and null model are of one alignment");
        let runs = self.iterations();
        PairIndex::all(self.0.l)
            .enumerate()
            .map(|(place, PairIndex { i, j })| {
                let observed = reference.observed()[place];
                let (mean, sd) = moments(self.0.sum[place], self.0.sum_of_squares[place], runs);
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
                    p: (1.0 + f64::from(self.0.at_least_observed[place])) / (runs as f64 + 1.0),
                }
            })
            .collect()
    }

    fn overflow(&self, place: usize) -> NullModelError {
        let pair = pair_at(self.0.l, place);
        NullModelError::Overflow { i: pair.i, j: pair.j, iterations: self.iterations() }
    }
}

fn same_pairs(ours: usize, lengths: &[usize]) -> Result<(), NullModelError> {
    let other = lengths.iter().find(|length| **length != ours);
    other.map_or(Ok(()), |&theirs| Err(NullModelError::Pairs { ours, theirs }))
}

/// Adds to a pair's sums: sum of X, sum of squares, count. `None` if one leaves its integer; then none is changed.
fn add_to(sums: (&mut i64, &mut u64, &mut u32), more: (i64, u64, u32)) -> Option<()> {
    let (sum, squares) = (sums.0.checked_add(more.0)?, sums.1.checked_add(more.1)?);
    *sums.2 = sums.2.checked_add(more.2)?;
    (*sums.0, *sums.1) = (sum, squares);
    Some(())
}

fn pair_at(l: usize, place: usize) -> PairIndex {
    PairIndex::all(l).nth(place).expect("the place is of a pair")
}

/// Cauchy-Schwarz: (sum of X)^2 <= iterations * (sum of X^2). [`moments`] takes the root of the difference.
fn is_possible(sum: i64, squares: u64, reached: u32, iterations: usize) -> bool {
    let runs = iterations as u128;
    let square = u128::from(sum.unsigned_abs()).pow(2);
    square <= u128::from(squares) * runs && (runs > 0 || squares == 0) && u128::from(reached) <= runs
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
    fn parts_that_are_not_all_pairs_of_the_same_iterations_are_refused() {
        let part = |first_place, sum: &[i64], iterations: Range<u64>| {
            let squares = sum.iter().map(|x| x.unsigned_abs().pow(2)).collect();
            let maxima =
                iterations.map(|iteration| (iteration, 4 + i32::try_from(first_place).unwrap())).collect();
            PairSums::new(3, first_place, sum.to_vec(), squares, vec![0; sum.len()], maxima).unwrap()
        };
        let merged = |parts: Vec<PairSums>| {
            let mut sums = Accumulators::new(3);
            sums.merge_parts(parts).map(|()| sums)
        };
        let whole = merged(vec![part(1, &[2, 3], 0..1), part(0, &[1], 0..1)]).unwrap();
        assert_eq!((whole.sum(), &whole.maxima()[&0]), (&[1, 2, 3][..], &5), "the largest of both");
        let error = |parts| merged(parts).unwrap_err();
        let hole = NullModelError::Pairs { ours: 3, theirs: 2 };
        assert_eq!(error(vec![part(0, &[1], 0..1), part(2, &[3], 0..1)]), hole);
        let twice = NullModelError::Pairs { ours: 3, theirs: 4 };
        assert_eq!(error(vec![part(0, &[1, 2], 0..1), part(1, &[2, 3], 0..1)]), twice);
        assert_eq!(error(Vec::new()), NullModelError::Pairs { ours: 3, theirs: 0 });
        let other = NullModelError::OtherIterations { place: 1 };
        assert_eq!(error(vec![part(0, &[1], 0..1), part(1, &[2, 3], 1..2)]), other);
        assert_eq!(error(vec![part(0, &[1], 0..1), part(1, &[2, 3], 0..2)]), other);
        let beyond = PairSums::new(3, 2, vec![0; 2], vec![0; 2], vec![0; 2], BTreeMap::new()).unwrap_err();
        assert_eq!(beyond, NullModelError::Pairs { ours: 3, theirs: 4 });
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
