//! The integer definition and the null model against what mathematics says of them (design 60-mi.md, section 5).

#![allow(clippy::unwrap_used, reason = "a panic in a test is its failure, also in its helpers")]

use std::fmt::Write as _;

use mi_kernel::{
    Accumulators, Alignment, NullModel, NullModelError, PairIndex, PairStatistics, Reference, Seed,
    ShuffleKind, parse,
};

const KINDS: [ShuffleKind; 2] = [ShuffleKind::Feistel, ShuffleKind::FisherYates];

/// A deterministic source of test data (SplitMix64), apart from the generator under test.
struct Draw(u64);

impl Draw {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % bound
    }

    fn shuffle<T>(&mut self, values: &mut [T]) {
        for last in (1..values.len()).rev() {
            let other = usize::try_from(self.below(last as u64 + 1)).unwrap();
            values.swap(last, other);
        }
    }
}

/// Rows of `l` residues; column `c` draws from `2 + c % 7` symbols with unequal chances.
fn random_rows(n: usize, l: usize, seed: u64) -> Vec<String> {
    const SYMBOLS: &[u8] = b"-ACDEFGHIKLMNPQRSTVWY";
    let mut draw = Draw(seed);
    let mut residue = |column: usize| {
        let bound = 2 + column as u64 % 7;
        // The smaller of two draws: early symbols are more frequent.
        let index = draw.below(bound).min(draw.below(bound)) + column as u64 % 5;
        char::from(SYMBOLS[usize::try_from(index).unwrap()])
    };
    (0..n).map(|_| (0..l).map(&mut residue).collect()).collect()
}

fn alignment(rows: &[String]) -> Alignment {
    parse(rows.join("\n").as_bytes()).unwrap().alignment
}

fn counts(column: &[u8], q: usize) -> Vec<u64> {
    let mut counts = vec![0; q];
    for code in column {
        counts[usize::from(*code)] += 1;
    }
    counts
}

fn statistics_of(sums: &Accumulators, null: &NullModel<'_, '_>) -> Vec<PairStatistics> {
    sums.statistics(null)
}

#[test]
fn identical_columns_share_their_entropy() {
    let mut rows = random_rows(150, 6, 1);
    for row in &mut rows {
        // Column 6 repeats column 5; column 7 is column 5 under other names, a bijection of symbols.
        let symbol = row.as_bytes()[5];
        row.push(char::from(symbol));
        row.push(if symbol == b'-' { 'Z' } else { char::from(symbol + 1) });
    }
    let alignment = alignment(&rows);
    let reference = Reference::new(&alignment).unwrap();
    let l = alignment.l();
    for (i, j) in [(5, 6), (5, 7), (6, 7)] {
        assert_eq!(
            reference.observed()[PairIndex { i, j }.place(l)],
            reference.entropy(5),
            "columns {i} and {j}"
        );
    }
    let independent = reference.observed()[PairIndex { i: 0, j: 5 }.place(l)];
    assert!(independent < reference.entropy(5) / 2, "negative control: other columns do not");
}

#[test]
fn the_order_of_sequences_does_not_matter() {
    let rows = random_rows(101, 12, 2);
    let mut other = rows.clone();
    Draw(3).shuffle(&mut other);
    assert_ne!(rows, other, "the order did change");
    let (first, second) = (alignment(&rows), alignment(&other));
    let matrices = [&first, &second].map(|alignment| Reference::new(alignment).unwrap().observed().to_vec());
    assert_eq!(matrices[0], matrices[1]);
    // Negative control: within one column alone it does.
    let mut column: Vec<u8> = rows.iter().map(|row| row.as_bytes()[3]).collect();
    Draw(4).shuffle(&mut column);
    let broken: Vec<String> = rows
        .iter()
        .zip(column)
        .map(|(row, symbol)| format!("{}{}{}", &row[..3], char::from(symbol), &row[4..]))
        .collect();
    let broken = alignment(&broken);
    assert_ne!(Reference::new(&broken).unwrap().observed(), matrices[0]);
}

#[test]
fn integers_and_floats_agree() {
    for (n, l, seed) in [(200, 30, 5), (1_000, 16, 6), (2, 5, 7), (3, 5, 8)] {
        let alignment = alignment(&random_rows(n, l, seed));
        let (q, unit) = (alignment.q(), 1.0 / (n as f64 * 16_384.0));
        assert_eq!(Reference::new(&alignment).unwrap().fixed_point().scale_bits(), 14);
        for (pair, error) in errors(&alignment) {
            // Half a unit for each rounded term: the cells of the joint table, both columns, and T(N).
            let present =
                |column| counts(alignment.column(column), q).iter().filter(|count| **count > 0).count();
            let (first, second) = (present(pair.i), present(pair.j));
            let bound = 0.5 * (first * second + first + second + 1) as f64 * unit;
            assert!(error <= bound, "N = {n}, {pair:?}: {error} above {bound}");
        }
    }
}

#[test]
fn proteins_are_as_exact_as_the_design_says() {
    // The design's 1.4e-6 bits at N = 200 is a measurement on one set, not a bound: this set reaches 1.53e-6 there. From
    // N = 1,000 on, where the unit is a fifth, it holds with room.
    for n in [1_000, 2_767] {
        let mut draw = Draw(20);
        let mut residue = |_| char::from(b"-ACDEFGHIKLMNPQRSTVWY"[usize::try_from(draw.below(21)).unwrap()]);
        let rows: Vec<String> = (0..n).map(|_| (0..24).map(&mut residue).collect()).collect();
        let worst = errors(&alignment(&rows)).into_iter().map(|(_, error)| error).fold(0.0, f64::max);
        assert!(worst < 1.4e-6, "N = {n}: {worst} bits");
    }
}

/// How far the integers are from the floats, for each pair.
fn errors(alignment: &Alignment) -> Vec<(PairIndex, f64)> {
    let matrix = Reference::new(alignment).unwrap().matrix_bits();
    let l = alignment.l();
    let error = |pair: PairIndex| {
        let integers = matrix[pair.i * l + pair.j];
        assert_eq!(integers, matrix[pair.j * l + pair.i], "the matrix is symmetric");
        (pair, (integers - mutual_information(alignment, pair.i, pair.j)).abs())
    };
    PairIndex::all(l).map(error).collect()
}

/// The definition with floats: `sum p_ab log2(p_ab / (p_a p_b))`.
fn mutual_information(alignment: &Alignment, i: usize, j: usize) -> f64 {
    let (n, q) = (alignment.n() as f64, alignment.q());
    let (first, second) = (alignment.column(i), alignment.column(j));
    let mut joint = vec![0.0; q * q];
    for (a, b) in first.iter().zip(second) {
        joint[usize::from(*a) * q + usize::from(*b)] += 1.0 / n;
    }
    let (p_first, p_second) = (counts(first, q), counts(second, q));
    let mut bits = 0.0;
    for a in 0..q {
        for b in 0..q {
            let p: f64 = joint[a * q + b];
            if p > 0.0 {
                bits += p * (p / (p_first[a] as f64 / n * (p_second[b] as f64 / n))).log2();
            }
        }
    }
    bits
}

#[test]
fn constant_columns_are_zero_and_flagged() {
    let mut rows = random_rows(40, 4, 9);
    for row in &mut rows {
        row.push('W');
    }
    let alignment = alignment(&rows);
    let reference = Reference::new(&alignment).unwrap();
    for kind in KINDS {
        let null = NullModel::new(&reference, Seed(1), kind);
        let sums = null.run(0..50).unwrap();
        for pair in statistics_of(&sums, &null) {
            let constant = pair.j == 4;
            assert_eq!(pair.z_undefined, constant, "{pair:?}");
            assert!(pair.z.is_finite() && pair.p > 0.0 && pair.p <= 1.0, "{pair:?}");
            if constant {
                assert_eq!(
                    (pair.mi_bits, pair.null_mean_bits, pair.null_sd_bits, pair.z),
                    (0.0, 0.0, 0.0, 0.0)
                );
                assert_eq!(pair.p, 1.0, "every shuffle reaches 0");
            }
        }
        let none = Accumulators::new(alignment.l());
        let silent =
            statistics_of(&none, &null).iter().all(|pair| pair.z == 0.0 && pair.z_undefined && pair.p == 1.0);
        assert!(silent, "no iteration says nothing");
    }
}

#[test]
fn shuffling_keeps_the_composition_of_columns() {
    let alignment = alignment(&random_rows(333, 9, 10));
    let reference = Reference::new(&alignment).unwrap();
    for kind in KINDS {
        let null = NullModel::new(&reference, Seed(11), kind);
        for iteration in 0..20 {
            for column in 0..alignment.l() {
                let shuffled = null.shuffled_column(iteration, column);
                assert_ne!(shuffled, alignment.column(column), "{kind:?}: it does move");
                let q = alignment.q();
                assert_eq!(
                    counts(&shuffled, q),
                    counts(alignment.column(column), q),
                    "{kind:?} {iteration} {column}"
                );
            }
        }
    }
}

#[test]
fn a_planted_coupling_is_the_top_pair() {
    let mut rows = random_rows(300, 40, 12);
    let mut draw = Draw(13);
    for row in &mut rows {
        // Column 31 follows column 8 in four of five sequences.
        if draw.below(5) > 0 {
            let mut bytes = std::mem::take(row).into_bytes();
            bytes[31] = match bytes[8] {
                b'D' => b'A',
                b'E' => b'C',
                _ => b'G',
            };
            *row = String::from_utf8(bytes).unwrap();
        }
    }
    let alignment = alignment(&rows);
    let reference = Reference::new(&alignment).unwrap();
    let null = NullModel::new(&reference, Seed(14), ShuffleKind::Feistel);
    let sums = null.run(0..60).unwrap();
    let mut pairs = statistics_of(&sums, &null);
    pairs.sort_by(|a, b| b.z.total_cmp(&a.z));
    assert_eq!((pairs[0].i, pairs[0].j), (8, 31));
    assert!(pairs[0].z > 3.0 * pairs[1].z, "{:?} and {:?}", pairs[0], pairs[1]);
    assert_eq!(pairs[0].p, 1.0 / 61.0, "no shuffle reached it");
    let above = sums
        .maxima()
        .values()
        .filter(|maximum| **maximum >= reference.observed()[PairIndex { i: 8, j: 31 }.place(40)]);
    assert_eq!(above.count(), 0, "nor did any pair of any iteration");
}

#[test]
fn any_split_gives_the_same_sums() {
    let alignment = alignment(&random_rows(64, 10, 15));
    let reference = Reference::new(&alignment).unwrap();
    for kind in KINDS {
        let null = NullModel::new(&reference, Seed(16), kind);
        let whole = null.run(0..97).unwrap();
        let mut parts = Accumulators::new(alignment.l());
        for range in [60..97, 0..1, 33..60, 1..1, 1..33] {
            parts.merge(null.run(range).unwrap()).unwrap();
        }
        assert_eq!(parts, whole, "{kind:?}: ranges in another order");
        let mut matrices = Accumulators::new(alignment.l());
        for iteration in (0..97).rev() {
            matrices.add(iteration, &null.scores(iteration), reference.observed()).unwrap();
        }
        assert_eq!(matrices, whole, "{kind:?}: matrix mode summed on the host");
        assert_eq!(statistics_of(&matrices, &null), statistics_of(&whole, &null));
        assert_eq!(parts.merge(null.run(5..6).unwrap()), Err(NullModelError::Doubled { iteration: 5 }));
        assert_ne!(null.run(0..96).unwrap(), whole, "negative control: one iteration less");
        let other = NullModel::new(&reference, Seed(17), kind).run(0..97).unwrap();
        assert_ne!(other, whole, "negative control: another seed");
    }
}

#[test]
fn the_null_mean_is_the_closed_form() {
    const ITERATIONS: u64 = 4_000;
    let alignment = alignment(&random_rows(60, 9, 18));
    let reference = Reference::new(&alignment).unwrap();
    for kind in KINDS {
        let null = NullModel::new(&reference, Seed(19), kind);
        let sums = null.run(0..ITERATIONS).unwrap();
        let mut report = String::new();
        let (mut worst, mut worst_control) = (0.0f64, 0.0f64);
        for pair in statistics_of(&sums, &null) {
            let q = alignment.q();
            let (first, second) = (counts(alignment.column(pair.i), q), counts(alignment.column(pair.j), q));
            let standard_error = pair.null_sd_bits / (ITERATIONS as f64).sqrt();
            let z = (pair.null_mean_bits - expected_mutual_information(&first, &second)) / standard_error;
            worst = worst.max(z.abs());
            writeln!(report, "({}, {}): {z:.2}", pair.i, pair.j).unwrap();
            // Negative control: the asymptotic bias instead of the closed form is told apart.
            let present = |counts: &[u64]| counts.iter().filter(|count| **count > 0).count() as f64;
            let bias =
                (present(&first) - 1.0) * (present(&second) - 1.0) / (2.0 * 60.0 * std::f64::consts::LN_2);
            worst_control = worst_control.max(((pair.null_mean_bits - bias) / standard_error).abs());
        }
        assert!(worst < 5.0, "{kind:?}, |z| up to {worst}:\n{report}");
        assert!(worst_control > 5.0, "{kind:?}: the comparison sees nothing ({worst_control})");
    }
}

/// Expected mutual information in bits of two columns with these compositions under random permutations (Vinh, Epps, Bailey
/// 2010, equation 24): each joint count is hypergeometric.
fn expected_mutual_information(first: &[u64], second: &[u64]) -> f64 {
    let n: u64 = first.iter().sum();
    let bound = usize::try_from(n).unwrap();
    let ln_factorial: Vec<f64> = (0..=bound)
        .scan(0.0, |sum, k| {
            *sum += (k.max(1) as f64).ln();
            Some(*sum)
        })
        .collect();
    let ln_choose = |n: u64, k: u64| {
        let [n, k] = [n, k].map(|value| usize::try_from(value).unwrap());
        ln_factorial[n] - ln_factorial[k] - ln_factorial[n - k]
    };
    let mut bits = 0.0;
    for a in first.iter().copied().filter(|a| *a > 0) {
        for b in second.iter().copied().filter(|b| *b > 0) {
            for joint in (a + b).saturating_sub(n).max(1)..=a.min(b) {
                let chance = (ln_choose(a, joint) + ln_choose(n - a, b - joint) - ln_choose(n, b)).exp();
                let (joint, n, a, b) = (joint as f64, n as f64, a as f64, b as f64);
                bits += chance * joint / n * (n * joint / (a * b)).log2();
            }
        }
    }
    bits
}

#[test]
fn results_are_pinned() {
    // A change of these numbers changes the meaning of a seed: it breaks "extend 1,000 -> 10,000 iterations exactly".
    let alignment = alignment(&["ACA".into(), "ACC".into(), "GTA".into(), "GTC".into(), "GTC".into()]);
    let reference = Reference::new(&alignment).unwrap();
    assert_eq!(reference.observed(), PINNED_OBSERVED);
    for (kind, sums) in KINDS.into_iter().zip(PINNED_SUMS) {
        assert_eq!(
            NullModel::new(&reference, Seed(2_026), kind).run(0..100).unwrap().sum(),
            sums,
            "{kind:?}"
        );
    }
}

/// Computed by a separate program (Python integers), not recorded from this one.
const PINNED_OBSERVED: [i32; 3] = [79_540, 1_636, 1_636];
const PINNED_SUMS: [[i64; 3]; 2] = [[1_872_512, 1_606_032, 2_007_280], [1_835_408, 1_667_232, 1_757_504]];
