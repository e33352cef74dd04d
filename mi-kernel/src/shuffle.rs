//! Permutations of a column's rows: a keyed Feistel network with cycle walking, as the kernel has it, and Fisher-Yates on
//! Philox as the reference. Both depend on seed, iteration and column alone, never on the job.
//!
//! The Feistel permutation is not uniform over N!: it is one of 2^256 keyed ones. That its null model is that of uniform
//! shuffles is a test (`tests/null_model.rs`), not a claim.

use crate::philox::{PhiloxStream, philox4x32_10, split};

/// Rounds of the Feistel network. Six already pass every test of the null model; eight leave a margin.
pub const FEISTEL_ROUNDS: usize = 8;

/// The user's seed of the null model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Seed(pub u64);

impl Seed {
    fn key(self) -> [u32; 2] {
        let (high, low) = split(self.0);
        [low, high]
    }
}

/// Which permutation the null model uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ShuffleKind {
    /// The kernel's: each row alone, no memory, invertible.
    Feistel,
    /// The reference (`--rng reference`): uniform, sequential.
    FisherYates,
}

/// Sets the two kinds of stream apart in Philox's counter: Feistel keys count blocks from 0, Fisher-Yates from here.
const FISHER_YATES_FIRST_BLOCK: u32 = 1 << 31;

impl ShuffleKind {
    /// Writes the permutation of one column in one iteration: row `r` of the shuffled column is row `target[r]` of the
    /// column.
    pub fn fill(self, target: &mut [u32], seed: Seed, iteration: u64, column: u32) {
        let n = u32::try_from(target.len()).expect("rows are bounded by MAX_ROWS");
        match self {
            Self::Feistel => {
                let feistel = Feistel::new(n, seed, iteration, column);
                for (row, source) in (0..n).zip(target) {
                    *source = feistel.forward(row);
                }
            }
            Self::FisherYates => {
                let (high, low) = split(iteration);
                let mut stream = PhiloxStream::new([low, high, column, FISHER_YATES_FIRST_BLOCK], seed.key());
                for (row, source) in (0..n).zip(target.iter_mut()) {
                    *source = row;
                }
                for last in (1..n).rev() {
                    target.swap(last as usize, stream.below(last + 1) as usize);
                }
            }
        }
    }
}

/// A keyed permutation of 0..n without memory (after Mitchell, Stokes, Frank and Holmes, "Bandwidth-optimal random shuffling
/// for GPUs", 2022; here a plain Feistel network whose halves may differ by one bit, so the domain is below 2n).
#[derive(Clone, Copy, Debug)]
pub struct Feistel {
    n: u32,
    left_bits: u32,
    right_bits: u32,
    keys: [u32; FEISTEL_ROUNDS],
}

impl Feistel {
    /// The permutation of `n` rows for one column in one iteration.
    ///
    /// The round keys are two Philox blocks at (iteration, column): no two columns and iterations of a seed share their
    /// keys. A 32-bit hash would give two columns of one iteration the same permutation about once per 4e9 pairs, and
    /// that pair's shuffled score would then be its observed one.
    ///
    /// # Panics
    /// `n` is 0 or above 2^31.
    #[must_use]
    pub fn new(n: u32, seed: Seed, iteration: u64, column: u32) -> Self {
        assert!((1..=1 << 31).contains(&n), "a permutation of {n} rows");
        // At least one bit in each half.
        let bits = n.next_power_of_two().trailing_zeros().max(2);
        let (high, low) = split(iteration);
        let [a, b, c, d] = philox4x32_10([low, high, column, 0], seed.key());
        let [e, f, g, h] = philox4x32_10([low, high, column, 1], seed.key());
        Self { n, left_bits: bits / 2, right_bits: bits - bits / 2, keys: [a, b, c, d, e, f, g, h] }
    }

    /// Where a row comes from.
    ///
    /// # Panics
    /// `row` is not below n.
    #[must_use]
    pub fn forward(&self, row: u32) -> u32 {
        self.walk(row, Self::encrypt)
    }

    /// The inverse of [`Self::forward`].
    ///
    /// # Panics
    /// `row` is not below n.
    #[must_use]
    pub fn backward(&self, row: u32) -> u32 {
        self.walk(row, Self::decrypt)
    }

    /// Goes on along the cycle until it is back below n. It ends: the cycle holds `row` itself, which is below n.
    fn walk(&self, row: u32, step: fn(&Self, u32) -> u32) -> u32 {
        assert!(row < self.n, "row {row} of {}", self.n);
        let mut value = step(self, row);
        while value >= self.n {
            value = step(self, value);
        }
        value
    }

    fn encrypt(&self, value: u32) -> u32 {
        let (mut left, mut right) = (value >> self.right_bits, value & mask(self.right_bits));
        let (mut left_bits, mut right_bits) = (self.left_bits, self.right_bits);
        for key in self.keys {
            (left, right) = (right, left ^ (mix(right ^ key) & mask(left_bits)));
            (left_bits, right_bits) = (right_bits, left_bits);
        }
        (left << right_bits) | right
    }

    fn decrypt(&self, value: u32) -> u32 {
        // An even number of rounds: the halves are as wide as they were.
        let (mut left, mut right) = (value >> self.right_bits, value & mask(self.right_bits));
        let (mut left_bits, mut right_bits) = (self.left_bits, self.right_bits);
        for key in self.keys.iter().rev() {
            (left_bits, right_bits) = (right_bits, left_bits);
            (left, right) = (right ^ (mix(left ^ key) & mask(left_bits)), left);
        }
        (left << right_bits) | right
    }
}

fn mask(bits: u32) -> u32 {
    (1 << bits) - 1
}

/// The finaliser of MurmurHash3 (Appleby): every input bit changes each output bit with chance about one half.
fn mix(mut value: u32) -> u32 {
    value ^= value >> 16;
    value = value.wrapping_mul(0x85eb_ca6b);
    value ^= value >> 13;
    value = value.wrapping_mul(0xc2b2_ae35);
    value ^ (value >> 16)
}

#[cfg(test)]
mod tests {
    use super::*;

    const KINDS: [ShuffleKind; 2] = [ShuffleKind::Feistel, ShuffleKind::FisherYates];

    fn permutation(kind: ShuffleKind, n: usize, seed: u64, iteration: u64, column: u32) -> Vec<u32> {
        let mut rows = vec![0; n];
        kind.fill(&mut rows, Seed(seed), iteration, column);
        rows
    }

    #[test]
    fn every_size_gives_a_bijection_with_an_inverse() {
        for n in (1..=300).chain([511, 512, 513, 1_000, 2_767, 4_096, 4_097, 4_176, 45_000, 65_535]) {
            let feistel = Feistel::new(n, Seed(7), 3, n);
            let mut hit = vec![false; n as usize];
            for row in 0..n {
                let source = feistel.forward(row);
                assert!(!std::mem::replace(&mut hit[source as usize], true), "n = {n}: {source} twice");
                assert_eq!(feistel.backward(source), row, "n = {n}");
            }
        }
    }

    #[test]
    fn fisher_yates_is_a_bijection() {
        for n in [1, 2, 3, 17, 1_000] {
            let mut rows = permutation(ShuffleKind::FisherYates, n, 1, 2, 3);
            rows.sort_unstable();
            assert!(rows.iter().zip(0..).all(|(row, wanted)| *row == wanted), "n = {n}");
        }
    }

    #[test]
    fn seed_iteration_and_column_each_change_the_permutation() {
        for kind in KINDS {
            let base = permutation(kind, 200, 1, 2, 3);
            assert_eq!(base, permutation(kind, 200, 1, 2, 3), "{kind:?}");
            let high = 1u64 << 32;
            for other in [(2, 2, 3), (1, 3, 3), (1, 2, 4), (1 + high, 2, 3), (1, 2 + high, 3)] {
                assert_ne!(base, permutation(kind, 200, other.0, other.1, other.2), "{kind:?} {other:?}");
            }
        }
    }

    #[test]
    fn a_row_goes_everywhere_equally_often() {
        const ROWS: usize = 11;
        const RUNS: u64 = 22_000;
        for kind in KINDS {
            let mut counts = [[0u32; ROWS]; ROWS];
            for iteration in 0..RUNS {
                for (row, source) in permutation(kind, ROWS, 9, iteration, 5).into_iter().enumerate() {
                    counts[row][source as usize] += 1;
                }
            }
            // 2,000 expected, standard deviation 43: six of them.
            let worst = counts.iter().flatten().map(|count| count.abs_diff(2_000)).max();
            assert!(worst.is_some_and(|worst| worst < 260), "{kind:?}: {counts:?}");
        }
    }
}
