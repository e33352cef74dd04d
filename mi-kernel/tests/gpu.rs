//! Kernels against the host reference, bit for bit: scores, sums, and their independence of chunks, cuts and jobs.

#![allow(clippy::unwrap_used, reason = "a panic in a test is its failure, also in its helpers")]

mod device;

use std::time::Duration;

use device::Device;
use mi_kernel::{
    Alignment, NullModel, Reference, Seed, ShuffleKind,
    gpu::{MiJob, Pass, Shape},
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

fn reduce(seed: u64, iterations: std::ops::Range<u64>) -> MiJob {
    MiJob { seed: Seed(seed), pass: Pass::Reduce(iterations) }
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
        let sums = device.sums(&reference, &shape, &reduce(seed, first..first + 3));
        prop_assert!(sums == host, "reduce");
        let matrix = MiJob { seed: Seed(seed), pass: Pass::Matrix(first..first + 3) };
        prop_assert!(device.sums(&reference, &shape, &matrix) == host, "matrix summed is reduce");
        Ok(())
    });
    outcome.unwrap_or_else(|error| panic!("{error}"));
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
    assert!(coarse.sums(&reference, &whole, &reduce(9, 7..9)) == host, "one binding");
    let fine = Device::open(Duration::from_millis(1));
    assert!(fine.sums(&reference, &chunked, &reduce(9, 7..9)) == host, "many bindings, many cuts");
}

#[test]
fn jobs_of_any_size_merge_to_the_same_and_another_seed_does_not() {
    let device = Device::open(COARSE);
    let alignment = alignment(50, 9, 5, 3);
    let reference = Reference::new(&alignment).unwrap();
    let shape = Shape::new(&alignment).unwrap();
    let at_once = device.sums(&reference, &shape, &reduce(1, 0..11));
    let mut merged = device.sums(&reference, &shape, &reduce(1, 8..11));
    for part in [0..1, 5..8, 1..5] {
        merged.merge(device.sums(&reference, &shape, &reduce(1, part))).unwrap();
    }
    assert!(merged == at_once, "the split shows");
    // Negative controls: what must differ does.
    assert!(device.sums(&reference, &shape, &reduce(2, 0..11)) != at_once, "the seed does not matter");
    assert!(device.sums(&reference, &shape, &reduce(1, 1..12)) != at_once, "the iterations do not matter");
}

#[test]
fn what_no_device_holds_is_refused() {
    let one = parse(b"A\nC\n").unwrap().alignment;
    assert_eq!(Shape::new(&one).unwrap_err().to_string(), "1 column: mutual information needs at least two");
    let many = parse("AC\n".repeat(65_536).as_bytes()).unwrap().alignment;
    assert!(Shape::new(&many).unwrap_err().to_string().contains("65536 sequences"));
}
