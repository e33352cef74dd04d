//! Alignments in every format, saved sums, and the results of null-model jobs.

use std::sync::LazyLock;

use mi_kernel::{
    Accumulators, Alignment, Format, NullModel, Reference, Seed, ShuffleKind,
    gpu::{MiJob, Pass, Shape},
    parse, parse_as, saved,
};

use super::{Verdict, refused, scene::sections};

/// The alignment of the corpus' sums.
pub(crate) const ROWS: &[u8] = b"ACA\nACC\nGTA\nGTC\n";
/// Their seed.
pub(crate) const SEED: Seed = Seed(3);

pub(super) fn any_format(bytes: &[u8]) -> Verdict {
    parse(bytes).map(drop).map_err(refused)
}

pub(super) fn fasta(bytes: &[u8]) -> Verdict {
    read(Format::Fasta, bytes)
}

pub(super) fn a2m(bytes: &[u8]) -> Verdict {
    read(Format::A2m, bytes)
}

pub(super) fn a3m(bytes: &[u8]) -> Verdict {
    read(Format::A3m, bytes)
}

pub(super) fn stockholm(bytes: &[u8]) -> Verdict {
    read(Format::Stockholm, bytes)
}

pub(super) fn clustal(bytes: &[u8]) -> Verdict {
    read(Format::Clustal, bytes)
}

pub(super) fn plain(bytes: &[u8]) -> Verdict {
    read(Format::Plain, bytes)
}

fn read(format: Format, bytes: &[u8]) -> Verdict {
    parse_as(format, bytes).map(drop).map_err(refused)
}

/// The alignment that the sums of the corpus are of.
pub(crate) fn alignment() -> Alignment {
    parse(ROWS).expect("four rows").alignment
}

/// A file of sums without its digest, which is put behind it here: a hostile one is right, a bit that flips by itself is
/// found by it (which `mi_kernel::saved` tests).
pub(super) fn saved_sums(bytes: &[u8]) -> Verdict {
    static ALIGNMENT: LazyLock<Alignment> = LazyLock::new(alignment);
    let whole = [bytes, &proto::codec::content_hash(bytes).0].concat();
    let sums = saved::load(&ALIGNMENT, SEED, &whole).map_err(refused)?;
    in_use(sums)
}

/// What a run does with sums that it goes on with: nothing that it prints may be NaN.
fn in_use(sums: Accumulators) -> Verdict {
    static ALIGNMENT: LazyLock<Alignment> = LazyLock::new(alignment);
    static REFERENCE: LazyLock<Reference<'static>> =
        LazyLock::new(|| Reference::new(&ALIGNMENT).expect("small"));
    let null = NullModel::new(&REFERENCE, SEED, ShuffleKind::Feistel);
    for pair in sums.statistics(&null) {
        let numbers = [pair.mi_bits, pair.null_mean_bits, pair.null_sd_bits, pair.z, pair.p];
        assert!(numbers.iter().all(|number| number.is_finite()), "impossible sums give {pair:?}");
    }
    let _ = sums.leading(REFERENCE.observed());
    let mut all = Accumulators::new(ALIGNMENT.l());
    all.merge(sums).map_err(refused)
}

/// The first byte says of which pass.
pub(super) fn result(bytes: &[u8]) -> Verdict {
    static SHAPE: LazyLock<Shape> = LazyLock::new(|| Shape::new(&alignment()).expect("small"));
    static OBSERVED: LazyLock<Vec<i32>> =
        LazyLock::new(|| Reference::new(&alignment()).expect("small").observed().to_vec());
    let (kind, rest) = bytes.split_first().ok_or("no kind")?;
    let sections = sections(rest);
    let pass = match kind % 3 {
        0 => Pass::Reduce { iterations: 4..9, chunks: 0..SHAPE.chunks().len() },
        1 => Pass::Matrix(4..9),
        _ => Pass::Observed,
    };
    let job = MiJob { seed: SEED, pass };
    if job.pass == Pass::Observed {
        return job.scores(&SHAPE, &sections).map(drop).map_err(refused);
    }
    let part = job.sums(&SHAPE, &OBSERVED, &sections).map_err(refused)?;
    let mut sums = Accumulators::new(alignment().l());
    sums.merge_parts(vec![part]).map_err(refused)?;
    in_use(sums)
}
