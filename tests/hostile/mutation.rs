//! Inputs made of others: the same seed makes the same ones.

/// Longest input that a mutation makes, in bytes.
const MAX_BYTES: usize = 64 << 10;
/// Most times that a chunk is repeated.
const MAX_REPEATS: u64 = 64;
/// Most mutations of one input.
const MAX_STEPS: u64 = 3;

/// What parsers trip over: numbers at the ends of their types, in text and in the binary forms of our codecs, and marks that
/// nest.
const TOKENS: [&[u8]; 30] = [
    b"0",
    b"-1",
    b"1e999",
    b"-1e999",
    b"NaN",
    b"inf",
    b"1e-46",
    b"4294967296",
    b"-9223372036854775808",
    b"18446744073709551616",
    b"99999999999999999999999999999999",
    b"\0",
    b"\n",
    b"\r\n",
    b"//",
    b"#",
    b">",
    b"[[",
    b"{",
    b"\"",
    b"'''",
    b"\\",
    b"=",
    b"\xef\xbb\xbf",
    b"\xff",
    b"\xed\xa0\x80",
    // 2^64 - 1, as bincode and as protobuf write it.
    b"\xfd\xff\xff\xff\xff\xff\xff\xff\xff",
    b"\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01",
    // 2^32 - 1 and 2^31 as protobuf writes them.
    b"\xff\xff\xff\xff\x0f",
    b"\x80\x80\x80\x80\x08",
];

/// SplitMix64 (Steele, Lea and Flood 2014): one word of state, the same everywhere.
#[derive(Debug)]
pub(crate) struct Draw(u64);

impl Draw {
    pub(crate) fn of(name: &str) -> Self {
        Self(name.bytes().fold(1, |seed, byte| (seed ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)))
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut word = self.0;
        word = (word ^ (word >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        word = (word ^ (word >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        word ^ (word >> 31)
    }

    /// Below `end`; 0 where `end` is.
    fn below(&mut self, end: usize) -> usize {
        let end = u64::try_from(end).unwrap_or(u64::MAX).max(1);
        usize::try_from(self.next() % end).unwrap_or(0)
    }

    fn byte(&mut self) -> u8 {
        self.next().to_le_bytes()[0]
    }

    /// A start and an end of a short stretch.
    fn stretch(&mut self, length: usize) -> std::ops::Range<usize> {
        let start = self.below(length + 1);
        start..(start + self.below(65)).min(length)
    }
}

/// Another input, made of `seed` and maybe of one of `others`.
pub(crate) fn mutated(draw: &mut Draw, seed: &[u8], others: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..=draw.next() % MAX_STEPS {
        step(draw, &mut bytes, others);
        bytes.truncate(MAX_BYTES);
    }
    bytes
}

fn step(draw: &mut Draw, bytes: &mut Vec<u8>, others: &[Vec<u8>]) {
    let at = draw.below(bytes.len());
    match draw.next() % 10 {
        0 => {
            if let Some(byte) = bytes.get_mut(at) {
                *byte ^= 1 << (draw.next() % 8);
            }
        }
        1 => {
            if let Some(byte) = bytes.get_mut(at) {
                *byte = draw.byte();
            }
        }
        2 => bytes.truncate(at),
        3 => {
            // A length field of any width, small, at its end, or at the end of its sign.
            let width = 1 << (draw.next() % 4);
            let value = [0, 1, u64::MAX, u64::MAX >> 1, 1 << 31, 1 << 20, draw.next()][draw.below(7)];
            let value = if draw.next().is_multiple_of(2) { value.to_le_bytes() } else { value.to_be_bytes() };
            for (byte, value) in bytes.iter_mut().skip(at).take(width).zip(value) {
                *byte = value;
            }
        }
        4 => drop(bytes.drain(draw.stretch(bytes.len()))),
        5 => {
            let stretch = draw.stretch(bytes.len());
            let chunk =
                bytes[stretch.clone()].repeat(usize::try_from(draw.next() % MAX_REPEATS).unwrap_or(1));
            drop(bytes.splice(stretch, chunk));
        }
        6 => {
            let other = &others[draw.below(others.len())];
            let stretch = draw.stretch(other.len());
            drop(bytes.splice(at..at, other[stretch].iter().copied()));
        }
        7 => {
            let other = &others[draw.below(others.len())];
            bytes.truncate(at);
            bytes.extend_from_slice(&other[draw.below(other.len())..]);
        }
        8 => {
            let token = TOKENS[draw.below(TOKENS.len())];
            drop(bytes.splice(at..at, token.iter().copied()));
        }
        _ => {
            let token = TOKENS[draw.below(TOKENS.len())];
            let end = (at + token.len()).min(bytes.len());
            drop(bytes.splice(at..end, token.iter().copied()));
        }
    }
}
