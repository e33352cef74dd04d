//! Kernels against the host reference, bit for bit: scores, sums, and their independence of chunks, cuts and jobs.

#![allow(clippy::unwrap_used, reason = "a panic in a test is its failure, also in its helpers")]

mod device;

use std::{ops::Range, time::Duration};

use device::Device;
use mi_kernel::{
    Accumulators, Alignment, GapMode, NullModel, Reference, Seed, ShuffleKind,
    gpu::{Method, MiJob, Pass, Shape},
    parse,
};
use proptest::{
    prelude::*,
    test_runner::{Config, TestRunner},
};

const COARSE: Duration = Duration::from_millis(500);

/// Random residues; column `c` takes `1 + c % kinds` symbols with unequal chances.
fn alignment(n: usize, l: usize, kinds: usize, mut state: u64) -> Alignment {
    const SYMBOLS: &[u8] = b"-ACDEFGHIKLMNPQRSTVWYBZXUOJ";
    let mut below = |bound: usize| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        usize::try_from((state >> 33) % bound as u64).unwrap()
    };
    let mut text = Vec::new();
    for _ in 0..n {
        for column in 0..l {
            let bound = 1 + column % kinds;
            text.push(SYMBOLS[below(bound).min(below(bound)) + column % (SYMBOLS.len() - bound + 1)]);
        }
        text.push(b'\n');
    }
    parse(&text).unwrap().alignment
}

fn reduce(shape: &Shape, seed: u64, iterations: Range<u64>) -> MiJob {
    let chunks = 0..shape.chunks().len();
    MiJob { seed: Seed(seed), pass: Pass::Reduce { iterations, chunks } }
}

/// The sums of as many jobs as there are parts, each of these chunks.
fn sums_of_parts(
    device: &Device,
    reference: &Reference<'_>,
    shape: &Shape,
    (seed, iterations): (u64, Range<u64>),
    parts: impl IntoIterator<Item = Range<usize>>,
) -> Accumulators {
    let of_parts = parts.into_iter().map(|chunks| {
        let job = MiJob { seed: Seed(seed), pass: Pass::Reduce { iterations: iterations.clone(), chunks } };
        device.part(reference, shape, &job)
    });
    let mut sums = Accumulators::new(reference.alignment().l());
    sums.merge_parts(of_parts.collect()).unwrap();
    sums
}

#[test]
fn random_alignments_give_the_hosts_bits() {
    let device = Device::open(COARSE);
    let cases = (2_usize..90, 2_usize..40, 1_usize..28, any::<u64>(), 0_u64..u64::MAX - 3);
    let mut runner = TestRunner::new(Config { cases: 12, failure_persistence: None, ..Config::default() });
    let outcome = runner.run(&cases, |(n, l, kinds, seed, first)| {
        let alignment = alignment(n, l, kinds, seed);
        let reference = Reference::new(&alignment).unwrap();
        let shape = Shape::new(&alignment).unwrap();
        prop_assert_eq!(device.observed(&reference, &shape), reference.observed(), "observed");
        let host =
            NullModel::new(&reference, Seed(seed), ShuffleKind::Feistel).run(first..first + 3).unwrap();
        let sums = device.sums(&reference, &shape, &reduce(&shape, seed, first..first + 3));
        prop_assert!(sums == host, "reduce");
        let matrix = MiJob { seed: Seed(seed), pass: Pass::Matrix(first..first + 3) };
        prop_assert!(device.sums(&reference, &shape, &matrix) == host, "matrix summed is reduce");
        Ok(())
    });
    outcome.unwrap_or_else(|error| panic!("{error}"));
}

#[test]
fn gaps_that_stand_apart_give_the_hosts_bits() {
    let device = Device::open(COARSE);
    for (n, l, kinds, seed) in [(40, 9, 4, 2), (1_030, 7, 27, 4)] {
        let gappy = alignment(n, l, kinds, seed);
        let mut seen = Vec::new();
        for gaps in [GapMode::Sumi, GapMode::Demi, GapMode::Esmi] {
            let alignment = gappy.clone().with_gaps(gaps);
            assert_eq!(alignment.gaps(), gaps, "the set has gaps");
            let reference = Reference::new(&alignment).unwrap();
            let shape = Shape::with_binding_bytes(&alignment, 20_000).unwrap();
            assert_eq!(device.observed(&reference, &shape), reference.observed(), "{gaps:?}, {n} x {l}");
            let host = NullModel::new(&reference, Seed(seed), ShuffleKind::Feistel).run(0..3).unwrap();
            assert!(
                device.sums(&reference, &shape, &reduce(&shape, seed, 0..3)) == host,
                "{gaps:?}, {n} x {l}"
            );
            seen.push(host);
        }
        assert!(seen[0] != seen[1] && seen[1] != seen[2], "the ways differ: {n} x {l}");
    }
}

#[test]
fn bit_planes_and_histograms_agree() {
    let device = Device::open(COARSE);
    for (q, symbols) in (2..=7).map(|q| (q, &b"-ACGTUN"[..q])) {
        // Past a word of rows and a block of columns, neither full.
        let mut state = q as u64;
        let mut text = Vec::new();
        for _ in 0..101 {
            for column in 0..259 {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                let kinds = 1 + column % q;
                text.push(symbols[usize::try_from(state >> 40).unwrap() % kinds]);
            }
            text.push(b'\n');
        }
        let alignment = parse(&text).unwrap().alignment;
        let reference = Reference::new(&alignment).unwrap();
        let shape = Shape::with_binding_bytes(&alignment, 100_000).unwrap();
        assert_eq!((alignment.q(), shape.method() == Method::Planes), (q, q <= 6));
        assert!(shape.chunks().len() > 1, "several bindings");
        let host = NullModel::new(&reference, Seed(4), ShuffleKind::Feistel).run(5..7).unwrap();
        assert!(device.observed(&reference, &shape) == reference.observed(), "{q} symbols, observed");
        assert!(device.sums(&reference, &shape, &reduce(&shape, 4, 5..7)) == host, "{q} symbols");
        let histograms = shape.with_histograms();
        assert!(
            device.sums(&reference, &histograms, &reduce(&histograms, 4, 5..7)) == host,
            "{q} symbols, histograms"
        );
    }
}

#[test]
fn several_blocks_chunks_and_cuts_do_not_show() {
    // Two blocks of columns, and more rows than one lane of any kernel takes.
    let alignment = alignment(601, 270, 21, 5);
    let reference = Reference::new(&alignment).unwrap();
    let whole = Shape::new(&alignment).unwrap();
    let chunked = Shape::with_binding_bytes(&alignment, 60_000).unwrap();
    assert_eq!(whole.chunks().len(), 1);
    assert!(chunked.chunks().len() > 4, "{} chunks", chunked.chunks().len());
    let host = NullModel::new(&reference, Seed(9), ShuffleKind::Feistel).run(7..9).unwrap();
    let coarse = Device::open(COARSE);
    assert!(coarse.observed(&reference, &chunked) == reference.observed(), "chunks show in observed scores");
    assert!(coarse.sums(&reference, &whole, &reduce(&whole, 9, 7..9)) == host, "one binding");
    // Jobs of a part of the pairs each, as large alignments have them.
    let last = chunked.chunks().len() - 1;
    let parts = sums_of_parts(&coarse, &reference, &chunked, (9, 7..9), [0..1, 1..last, last..last + 1]);
    assert!(parts == host, "jobs of some of the pairs");
    let fine = Device::open(Duration::from_millis(1));
    assert!(fine.sums(&reference, &chunked, &reduce(&chunked, 9, 7..9)) == host, "many bindings, many cuts");
}

#[test]
fn large_alignments_come_in_parts_of_their_pairs() {
    // 73 MB of sums.
    let alignment = alignment(6, 2_700, 7, 8);
    let reference = Reference::new(&alignment).unwrap();
    let shape = Shape::new(&alignment).unwrap();
    let parts = shape.parts();
    assert_eq!(parts, [0..1, 1..2]);
    let [first, second] = [0, 1].map(|part: usize| shape.pairs_of(parts[part].clone()));
    assert_eq!(first + second, shape.pairs());
    assert!(first.abs_diff(second) <= 2 * alignment.l(), "{first} and {second} pairs");
    let device = Device::open(COARSE);
    let sums = sums_of_parts(&device, &reference, &shape, (3, 1..3), parts);
    assert!(sums == NullModel::new(&reference, Seed(3), ShuffleKind::Feistel).run(1..3).unwrap());
}

#[test]
fn jobs_of_any_size_merge_to_the_same_and_another_seed_does_not() {
    let device = Device::open(COARSE);
    let alignment = alignment(50, 9, 5, 3);
    let reference = Reference::new(&alignment).unwrap();
    let shape = Shape::new(&alignment).unwrap();
    let at_once = device.sums(&reference, &shape, &reduce(&shape, 1, 0..11));
    let mut merged = device.sums(&reference, &shape, &reduce(&shape, 1, 8..11));
    for part in [0..1, 5..8, 1..5] {
        merged.merge(device.sums(&reference, &shape, &reduce(&shape, 1, part))).unwrap();
    }
    assert!(merged == at_once, "the split shows");
    // Negative controls: what must differ does.
    assert!(
        device.sums(&reference, &shape, &reduce(&shape, 2, 0..11)) != at_once,
        "the seed does not matter"
    );
    assert!(
        device.sums(&reference, &shape, &reduce(&shape, 1, 1..12)) != at_once,
        "the iterations do not matter"
    );
}

#[test]
fn what_no_device_holds_is_refused() {
    let one = parse(b"A\nC\n").unwrap().alignment;
    assert_eq!(Shape::new(&one).unwrap_err().to_string(), "1 column: mutual information needs at least two");
    let many = parse("AC\n".repeat(65_536).as_bytes()).unwrap().alignment;
    assert!(Shape::new(&many).unwrap_err().to_string().contains("65536 sequences"));
}
