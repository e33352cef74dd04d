//! How the pieces of a content prove themselves: the blake3 chaining values of its megabytes, whose tree's root is the
//! content's digest (blake3 paper, section 2.1). Computed with the digest, in one pass over the bytes.

use std::{fmt, ops::Deref, sync::Arc};

use blake3::{
    Hasher,
    hazmat::{
        ChainingValue, HasherExt as _, Mode, left_subtree_len, merge_subtrees_non_root, merge_subtrees_root,
    },
};
use bytes::Bytes;
use farm_core::{id::ContentHash, program::Content};

/// A piece, in bytes: what is checked at once. A power of two, so that a piece is a subtree.
pub const PIECE_BYTES: usize = 1 << 20;

/// The bytes of a content with its outline. Whoever has one knows that they belong together.
#[derive(Clone, PartialEq, Eq)]
pub struct ContentBytes {
    hash: ContentHash,
    bytes: Bytes,
    outline: Outline,
}

impl ContentBytes {
    /// Digests the bytes: about a second for three gigabytes.
    #[must_use]
    pub fn new(bytes: impl Into<Bytes>) -> Self {
        let bytes = bytes.into();
        let pieces = bytes.chunks(PIECE_BYTES).enumerate().map(|(index, piece)| chaining_value(index, piece));
        let outline = Outline::of(bytes.len(), || pieces.collect());
        let hash = outline.root(bytes.len()).unwrap_or_else(|| ContentHash(*blake3::hash(&bytes).as_bytes()));
        Self { hash, bytes, outline }
    }

    /// Bytes all of whose pieces were checked against `outline`, and that against the digest.
    pub(super) const fn checked(hash: ContentHash, bytes: Bytes, outline: Outline) -> Self {
        Self { hash, bytes, outline }
    }

    /// Digest and size.
    #[must_use]
    pub fn content(&self) -> Content {
        Content { hash: self.hash, size_bytes: self.bytes.len() as u64 }
    }

    /// The bytes; cloning them copies nothing.
    #[must_use]
    pub const fn bytes(&self) -> &Bytes {
        &self.bytes
    }

    /// The bytes alone.
    #[must_use]
    pub fn into_bytes(self) -> Bytes {
        self.bytes
    }

    pub(super) const fn outline(&self) -> &Outline {
        &self.outline
    }
}

impl Deref for ContentBytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.bytes
    }
}

impl fmt::Debug for ContentBytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("ContentBytes").field(&self.content()).finish()
    }
}

/// The chaining value of each piece, in order; none for a content of at most one piece, which its digest proves.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Outline(Arc<[ChainingValue]>);

impl Outline {
    fn of(size: usize, values: impl FnOnce() -> Vec<ChainingValue>) -> Self {
        if Self::values(size) == 0 { Self::default() } else { Self(values().into()) }
    }

    /// How many values the outline of so many bytes holds.
    pub(super) const fn values(size: usize) -> usize {
        if size <= PIECE_BYTES { 0 } else { size.div_ceil(PIECE_BYTES) }
    }

    /// As it travels: the values one after the other.
    pub(super) fn as_bytes(&self) -> &[u8] {
        self.0.as_flattened()
    }

    /// The outline of a content of `size` bytes, if it is that of `hash`.
    pub(super) fn parse(bytes: &[u8], hash: ContentHash, size: usize) -> Option<Self> {
        let (values, rest) = bytes.as_chunks();
        let outline = Self(values.into());
        let complete = rest.is_empty() && values.len() == Self::values(size);
        (complete && outline.root(size).is_none_or(|root| root == hash)).then_some(outline)
    }

    /// Whether piece `index` of the content `hash` is the right one.
    pub(super) fn proves(&self, hash: ContentHash, index: usize, piece: &[u8]) -> bool {
        match self.0.get(index) {
            Some(value) => chaining_value(index, piece) == *value,
            None => self.0.is_empty() && index == 0 && *blake3::hash(piece).as_bytes() == hash.0,
        }
    }

    /// The digest; of a single piece nothing is known.
    fn root(&self, size: usize) -> Option<ContentHash> {
        if self.0.is_empty() {
            return None;
        }
        let (left, right) = self.0.split_at(left_pieces(size));
        let (left, right) = halves(left, right, size);
        Some(ContentHash(*merge_subtrees_root(&left, &right, Mode::Hash).as_bytes()))
    }
}

fn chaining_value(index: usize, piece: &[u8]) -> ChainingValue {
    Hasher::new().set_input_offset((index * PIECE_BYTES) as u64).update(piece).finalize_non_root()
}

/// Pieces in the left subtree of `size` bytes, more than one piece.
fn left_pieces(size: usize) -> usize {
    left_subtree_bytes(size) / PIECE_BYTES
}

fn left_subtree_bytes(size: usize) -> usize {
    usize::try_from(left_subtree_len(size as u64)).expect("a part of a length")
}

fn halves(left: &[ChainingValue], right: &[ChainingValue], size: usize) -> (ChainingValue, ChainingValue) {
    let left_bytes = left_subtree_bytes(size);
    (subtree(left, left_bytes), subtree(right, size - left_bytes))
}

/// The chaining value of a subtree of `size` bytes. As deep as the logarithm of its pieces: 14 at most.
fn subtree(values: &[ChainingValue], size: usize) -> ChainingValue {
    if let [value] = values {
        return *value;
    }
    let (left, right) = values.split_at(left_pieces(size));
    let (left, right) = halves(left, right, size);
    merge_subtrees_non_root(&left, &right, Mode::Hash)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(size: usize) -> Vec<u8> {
        (0..size).map(|at| (at * 31 + at / 251).to_le_bytes()[0]).collect()
    }

    #[test]
    fn the_root_of_an_outline_is_the_digest() {
        for size in [
            0,
            1,
            5_000,
            PIECE_BYTES - 1,
            PIECE_BYTES,
            PIECE_BYTES + 1,
            2 * PIECE_BYTES,
            7 * PIECE_BYTES + 77,
        ] {
            let bytes = pattern(size);
            let content = ContentBytes::new(bytes.clone());
            assert_eq!(content.content().hash.0, *blake3::hash(&bytes).as_bytes(), "{size} B");
            assert_eq!(content.outline.0.len(), Outline::values(size), "{size} B");
        }
    }

    #[test]
    fn pieces_are_proved_and_others_are_not() {
        let content = ContentBytes::new(pattern(3 * PIECE_BYTES + 5));
        let hash = content.content().hash;
        let told = content.outline.as_bytes();
        let outline = Outline::parse(told, hash, content.len()).unwrap();
        for (index, piece) in content.chunks(PIECE_BYTES).enumerate() {
            assert!(outline.proves(hash, index, piece), "piece {index}");
            assert!(!outline.proves(hash, index ^ 1, piece), "piece {index} in another place");
            let mut wrong = piece.to_vec();
            wrong[0] ^= 1;
            assert!(!outline.proves(hash, index, &wrong), "a changed piece {index}");
        }
        assert!(!outline.proves(hash, 4, b""), "past the end");
    }

    #[test]
    fn an_outline_of_another_content_is_refused() {
        let content = ContentBytes::new(pattern(3 * PIECE_BYTES + 5));
        let (hash, size) = (content.content().hash, content.len());
        let told = content.outline.as_bytes();
        for bit in [0, 700, told.len() * 8 - 1] {
            let mut wrong = told.to_vec();
            wrong[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(Outline::parse(&wrong, hash, size), None, "bit {bit}");
        }
        assert_eq!(Outline::parse(&told[..96], hash, size), None, "too short");
        assert_eq!(Outline::parse(told, hash, size + PIECE_BYTES), None, "of another size");
        assert_eq!(Outline::parse(told, hash, 2 * PIECE_BYTES + 5), None, "of a smaller size");
    }
}
