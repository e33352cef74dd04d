//! Sums as a file keeps them, so that a later run goes on where this one ended. Little-endian, with a digest at the end.
//!
//! Layout: magic, digest of the alignment, n, l, q, scale bits and, in the second byte of the same word, how gaps count (u32 each), seed (u64), number of iterations (u64); then for
//! each iteration its number (u64) and largest score (i32); then sums (i64), sums of squares (u64) and counts (u32) of all
//! pairs; then blake3 of all before.

use std::collections::BTreeMap;

use thiserror::Error;

use crate::{Accumulators, Alignment, GapMode, NullModelError, Seed, fixed_point::scale_bits, pair_count};

const MAGIC: &[u8; 8] = b"GLEANMI1";
const DIGEST_BYTES: usize = 32;

/// A file of sums that cannot be continued. Not to be retried.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum SavedError {
    /// Not such a file, or one that was cut short or changed.
    #[error("byte {at}: {what}")]
    Damaged {
        /// Where.
        at: usize,
        /// What is wrong.
        what: &'static str,
    },
    /// Sums of something else.
    #[error("the sums are of another {what}")]
    Other {
        /// `alignment`, `seed` or `way of counting gaps`.
        what: &'static str,
    },
    /// Parts that do not fit.
    #[error(transparent)]
    Sums(#[from] NullModelError),
}

/// What names an alignment: blake3 of its alphabet and symbols. Names of sequences do not matter.
#[must_use]
pub fn alignment_digest(alignment: &Alignment) -> [u8; DIGEST_BYTES] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&(alignment.n() as u64).to_le_bytes());
    hasher.update(&(alignment.l() as u64).to_le_bytes());
    hasher.update(alignment.alphabet());
    for column in 0..alignment.l() {
        hasher.update(alignment.column(column));
    }
    *hasher.finalize().as_bytes()
}

fn header(alignment: &Alignment, seed: Seed, iterations: usize) -> Vec<u8> {
    let narrow = |value: usize| u32::try_from(value).expect("an alignment's sizes are bounded");
    let sizes = [alignment.n(), alignment.l(), alignment.q()].map(narrow);
    let gaps = alignment.gaps();
    let scale = scale_bits(sizes[0], gaps.scale_symbols(sizes[2])).unwrap_or(0);
    let mode = match gaps {
        GapMode::Ormi => 0,
        GapMode::Sumi => 1,
        GapMode::Demi => 2,
        GapMode::Esmi => 3,
    };
    let mut bytes = MAGIC.to_vec();
    bytes.extend(alignment_digest(alignment));
    for word in [sizes[0], sizes[1], sizes[2], scale | mode << 8] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.extend(seed.0.to_le_bytes());
    bytes.extend((iterations as u64).to_le_bytes());
    bytes
}

/// The file of sums. The same sums give the same bytes.
#[must_use]
pub fn save(alignment: &Alignment, seed: Seed, sums: &Accumulators) -> Vec<u8> {
    let mut bytes = header(alignment, seed, sums.iterations());
    bytes.reserve(sums.iterations() * 12 + sums.sum().len() * 20 + DIGEST_BYTES);
    for (iteration, largest) in sums.maxima() {
        bytes.extend(iteration.to_le_bytes());
        bytes.extend(largest.to_le_bytes());
    }
    bytes.extend(sums.sum().iter().flat_map(|value| value.to_le_bytes()));
    bytes.extend(sums.sum_of_squares().iter().flat_map(|value| value.to_le_bytes()));
    bytes.extend(sums.at_least_observed().iter().flat_map(|value| value.to_le_bytes()));
    let digest = blake3::hash(&bytes);
    bytes.extend(digest.as_bytes());
    bytes
}

/// Reads a file of sums of this alignment and seed.
///
/// # Errors
/// The file is damaged, or of another alignment or seed.
pub fn load(alignment: &Alignment, seed: Seed, bytes: &[u8]) -> Result<Accumulators, SavedError> {
    let expected = header(alignment, seed, 0);
    let seed_at = expected.len() - 16;
    if bytes.get(..MAGIC.len()) != Some(&MAGIC[..]) {
        return Err(SavedError::Damaged { at: 0, what: "not a file of sums" });
    }
    let Some(body) = bytes.len().checked_sub(DIGEST_BYTES).filter(|end| *end >= expected.len()) else {
        return Err(SavedError::Damaged { at: bytes.len(), what: "the file ends early" });
    };
    let (body, digest) = bytes.split_at(body);
    if blake3::hash(body).as_bytes() != digest {
        return Err(SavedError::Damaged { at: body.len(), what: "the digest is not that of the bytes" });
    }
    let scale_at = seed_at - 4;
    if body[..scale_at] != expected[..scale_at] {
        return Err(SavedError::Other { what: "alignment" });
    }
    if body[scale_at..seed_at] != expected[scale_at..seed_at] {
        return Err(SavedError::Other { what: "way of counting gaps" });
    }
    if body[seed_at..seed_at + 8] != expected[seed_at..seed_at + 8] {
        return Err(SavedError::Other { what: "seed" });
    }
    let mut rest = Reader { bytes: body, at: seed_at + 8 };
    let iterations = u64::from_le_bytes(rest.take()?);
    let mut maxima = BTreeMap::new();
    for _ in 0..iterations {
        let iteration = u64::from_le_bytes(rest.take()?);
        if maxima.insert(iteration, i32::from_le_bytes(rest.take()?)).is_some() {
            return Err(NullModelError::Doubled { iteration }.into());
        }
    }
    let pairs = pair_count(alignment.l());
    let sum = rest.all(pairs, i64::from_le_bytes)?;
    let squares = rest.all(pairs, u64::from_le_bytes)?;
    let reached = rest.all(pairs, u32::from_le_bytes)?;
    if rest.at != body.len() {
        return Err(SavedError::Damaged { at: rest.at, what: "the sums are followed by more" });
    }
    Ok(Accumulators::from_parts(alignment.l(), sum, squares, reached, maxima)?)
}

struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], SavedError> {
        let found = self.bytes.get(self.at..).and_then(|rest| rest.first_chunk::<N>());
        let found = *found.ok_or(SavedError::Damaged { at: self.at, what: "the file ends early" })?;
        self.at += N;
        Ok(found)
    }

    fn all<T, const N: usize>(
        &mut self,
        count: usize,
        value: fn([u8; N]) -> T,
    ) -> Result<Vec<T>, SavedError> {
        (0..count).map(|_| self.take().map(value)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{NullModel, Reference, ShuffleKind, parse};

    #[test]
    fn sums_come_back_and_damage_is_seen() {
        let alignment = parse(b"ACA\nACC\nGTA\nGTC\n").unwrap().alignment;
        let reference = Reference::new(&alignment).unwrap();
        let sums = NullModel::new(&reference, Seed(3), ShuffleKind::Feistel).run(4..9).unwrap();
        let bytes = save(&alignment, Seed(3), &sums);
        assert_eq!(load(&alignment, Seed(3), &bytes).unwrap(), sums);
        assert_eq!(load(&alignment, Seed(4), &bytes), Err(SavedError::Other { what: "seed" }));
        let other = parse(b"ACA\nACC\nGTA\nGTA\n").unwrap().alignment;
        assert_eq!(load(&other, Seed(3), &bytes), Err(SavedError::Other { what: "alignment" }));
        let gappy = parse(b"A-A\nACC\nGTA\nGTC\n").unwrap().alignment;
        let [symbol, apart] = [GapMode::Ormi, GapMode::Sumi].map(|gaps| gappy.clone().with_gaps(gaps));
        let of_symbol = save(&symbol, Seed(3), &sums);
        let error = load(&apart, Seed(3), &of_symbol).unwrap_err();
        assert_eq!(error, SavedError::Other { what: "way of counting gaps" });
        for at in 0..bytes.len() {
            let mut damaged = bytes.clone();
            damaged[at] ^= 1;
            assert!(load(&alignment, Seed(3), &damaged).is_err(), "byte {at}");
            assert!(load(&alignment, Seed(3), &bytes[..at]).is_err(), "cut at {at}");
        }
    }
}
