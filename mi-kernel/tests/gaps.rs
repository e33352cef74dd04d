//! Gaps that stand apart (SUMI, DEMI, ESMI) against their definitions in floating point.

#![allow(clippy::unwrap_used, reason = "a panic in a test is its failure, also in its helpers")]

use std::collections::BTreeMap;

use mi_kernel::{Alignment, GapMode, NullModel, PairIndex, Reference, SCORE_BITS, Seed, ShuffleKind, parse};
use proptest::prelude::*;

const APART: [GapMode; 3] = [GapMode::Sumi, GapMode::Demi, GapMode::Esmi];

type Counts<K> = BTreeMap<K, f64>;

fn entropy<K>(counts: &Counts<K>) -> f64 {
    let all: f64 = counts.values().sum();
    -counts.values().map(|count| count / all * (count / all).log2()).sum::<f64>()
}

fn counted<K: Ord>(keys: impl IntoIterator<Item = K>) -> Counts<K> {
    let mut counts = Counts::new();
    for key in keys {
        *counts.entry(key).or_default() += 1.0;
    }
    counts
}

/// The definitions of `reference/mi.md`, read once more; rows that count, and cells that a rounding can touch.
fn defined(rows: &[&[u8]], gaps: GapMode, i: usize, j: usize) -> (f64, f64, f64) {
    let residue = |column: usize| rows.iter().map(move |row| row[column]).filter(|symbol| *symbol != b'-');
    let both: Vec<(u8, u8)> =
        rows.iter().map(|row| (row[i], row[j])).filter(|(a, b)| *a != b'-' && *b != b'-').collect();
    let all = both.len() as f64;
    let joint = counted(both.iter().copied());
    let (first, second) = (counted(both.iter().map(|pair| pair.0)), counted(both.iter().map(|pair| pair.1)));
    let cells = (joint.len() + first.len() + second.len()) as f64;
    if both.len() < 2 {
        return (0.0, all, cells);
    }
    let (own_first, own_second) = (counted(residue(i)), counted(residue(j)));
    let bits = match gaps {
        GapMode::Ormi => unreachable!("gaps stand apart"),
        GapMode::Sumi => entropy(&first) + entropy(&second) - entropy(&joint),
        GapMode::Demi => entropy(&own_first) + entropy(&own_second) - entropy(&joint),
        GapMode::Esmi => {
            let (n_first, n_second): (f64, f64) = (own_first.values().sum(), own_second.values().sum());
            let term = |((a, b), count): (&(u8, u8), &f64)| {
                let p = count / all;
                p * (p / (own_first[a] / n_first * (own_second[b] / n_second))).log2()
            };
            joint.iter().map(term).sum()
        }
    };
    (bits, all, cells)
}

fn of(rows: &[String], gaps: GapMode) -> Alignment {
    parse((rows.join("\n") + "\n").as_bytes()).unwrap().alignment.with_gaps(gaps)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn scores_are_the_definitions(rows in (2_usize..7).prop_flat_map(|l| {
        let gappy = prop::sample::select(b"--ACDEFGAAC-".to_vec());
        prop::collection::vec(prop::collection::vec(gappy, l), 2..150)
    })) {
        let rows: Vec<String> = rows.into_iter().map(|row| String::from_utf8(row).unwrap()).collect();
        let bytes: Vec<&[u8]> = rows.iter().map(String::as_bytes).collect();
        prop_assume!(rows.iter().any(|row| row.contains('-')) && rows.iter().any(|row| row.contains('A')));
        for gaps in APART {
            let alignment = of(&rows, gaps);
            let reference = Reference::new(&alignment).unwrap();
            let unit = 1.0 / f64::from(1_u32 << reference.fixed_point().scale_bits());
            let step = 1.0 / f64::from(1_u32 << SCORE_BITS);
            for (place, PairIndex { i, j }) in PairIndex::all(alignment.l()).enumerate() {
                let (bits, all, cells) = defined(&bytes, gaps, i, j);
                let score = reference.bits(f64::from(reference.observed()[place]));
                // Half a unit for each rounded term over the rows, half a step for the division and for each own entropy.
                let bound = 0.5 * (cells + 3.0) * unit / all.max(1.0) + 1.5 * step + 1e-12;
                prop_assert!((score - bits).abs() <= bound, "{gaps:?} ({i}, {j}): {score}, by definition {bits}");
            }
        }
    }
}

#[test]
fn the_ways_differ_where_gaps_are_and_agree_where_none_are() {
    let gappy: Vec<String> = ["AC-C", "ACGC", "CAGA", "C-GA", "GATT", "GA-T"].map(str::to_owned).to_vec();
    let scores = |rows: &[String], gaps| {
        let alignment = of(rows, gaps);
        Reference::new(&alignment).unwrap().matrix_bits()
    };
    let all = [GapMode::Ormi, GapMode::Sumi, GapMode::Demi, GapMode::Esmi];
    let gapless: Vec<String> = gappy.iter().map(|row| row.replace('-', "T")).collect();
    for (at, gaps) in all.into_iter().enumerate() {
        for other in &all[at + 1..] {
            assert_ne!(scores(&gappy, gaps), scores(&gappy, *other), "{gaps:?} and {other:?}");
            assert_eq!(scores(&gapless, gaps), scores(&gapless, *other), "{gaps:?} and {other:?}, no gap");
        }
    }
}

#[test]
fn columns_of_gaps_alone_are_zero_and_flagged() {
    let rows: Vec<String> = ["A-C", "C-A", "A-C", "C-A"].map(str::to_owned).to_vec();
    for gaps in APART {
        let alignment = of(&rows, gaps);
        let reference = Reference::new(&alignment).unwrap();
        let null = NullModel::new(&reference, Seed(1), ShuffleKind::Feistel);
        let pairs = null.run(0..20).unwrap().statistics(&null);
        let of_gaps: Vec<_> = pairs.iter().filter(|pair| pair.i == 1 || pair.j == 1).collect();
        assert_eq!(of_gaps.len(), 2);
        for pair in of_gaps {
            assert_eq!((pair.mi_bits, pair.z, pair.z_undefined), (0.0, 0.0, true), "{gaps:?}");
        }
        assert_eq!((pairs[1].mi_bits, reference.entropy(1)), (1.0, 0), "{gaps:?}");
    }
}
