//! Binary encodings of the data plane: job programs and frame headers, and the digest that names contents.
//!
//! The one module that names bincode (pinned to 2.0.1, see the workspace manifest). Every decoder has a byte cap, and
//! what it may allocate is bounded by a small multiple of the bytes that really came.

use bytes::{BufMut, Bytes, BytesMut};
use farm_core::{id::ContentHash, program::JobProgram};
use serde::{Serialize, de::DeserializeOwned};
use thiserror::Error;

/// Most bytes of one frame header (a `Jobs` header of 4,096 tickets is about 0.5 MB).
pub const MAX_HEADER_BYTES: usize = 16 << 20;
/// Most bytes of one encoded job program, its host-to-device bytes included.
pub const MAX_PROGRAM_BYTES: usize = 256 << 20;
/// Programs below this size are packed side by side into one buffer, in bytes.
const PACK_BELOW_BYTES: usize = 64 << 10;

/// Some bytes could not be encoded or decoded. Not to be retried: the same bytes fail the same way.
#[derive(Debug, Error)]
pub enum CodecError {
    /// More bytes than the cap of their type.
    #[error("{what} of {bytes} B is over the cap of {cap} B")]
    TooLarge {
        /// What was coded.
        what: &'static str,
        /// Its size.
        bytes: u64,
        /// The most it may have.
        cap: u64,
    },
    /// The bytes are not a value of the type.
    #[error("{what} does not decode: {reason}")]
    Malformed {
        /// What was decoded.
        what: &'static str,
        /// The decoder's words.
        reason: String,
    },
    /// The value does not encode.
    #[error("{what} does not encode: {reason}")]
    Unencodable {
        /// What was encoded.
        what: &'static str,
        /// The encoder's words.
        reason: String,
    },
}

/// The name of some bytes: their blake3 digest.
#[must_use]
pub fn content_hash(bytes: &[u8]) -> ContentHash {
    ContentHash(*blake3::hash(bytes).as_bytes())
}

/// Encodes a job program.
///
/// # Errors
/// It is over [`MAX_PROGRAM_BYTES`].
pub fn encode_program(program: &JobProgram) -> Result<Bytes, CodecError> {
    let mut buffer = BytesMut::with_capacity(256);
    encode_into(&mut buffer, "job program", program, MAX_PROGRAM_BYTES)?;
    Ok(buffer.freeze())
}

/// Decodes a job program. The result is well-formed but not yet valid: `farm_core::program::validate` says that.
///
/// # Errors
/// The bytes are not one program, or are over [`MAX_PROGRAM_BYTES`].
pub fn decode_program(bytes: &[u8]) -> Result<JobProgram, CodecError> {
    decode("job program", bytes, MAX_PROGRAM_BYTES)
}

/// Most bytes of the payload of a frame of one program.
pub const MAX_PACKED_BYTES: u64 = (PACKED_LENGTH_BYTES + MAX_PROGRAM_BYTES) as u64;
/// Of the length before each program.
const PACKED_LENGTH_BYTES: usize = size_of::<u32>();

/// The payload of a `Jobs` frame: the encoded programs in the order of the tickets, each behind its length (`u32`,
/// little-endian). Small ones are copied side by side, large ones are passed on as they are.
#[must_use]
pub fn pack_programs<'a>(programs: impl IntoIterator<Item = &'a Bytes>) -> Vec<Bytes> {
    let mut chunks = Vec::new();
    let mut buffer = BytesMut::new();
    for program in programs {
        let length = u32::try_from(program.len()).expect("encode_program caps programs far below 4 GiB");
        buffer.put_u32_le(length);
        if program.len() < PACK_BELOW_BYTES {
            buffer.extend_from_slice(program);
        } else {
            chunks.push(buffer.split().freeze());
            chunks.push(program.clone());
        }
    }
    if !buffer.is_empty() {
        chunks.push(buffer.freeze());
    }
    chunks
}

/// The encoded programs of a `Jobs` frame's payload: `count` of them, as slices of the payload (no copy).
///
/// # Errors
/// The payload does not hold exactly `count` programs within their cap.
pub fn unpack_programs(mut payload: Bytes, count: usize) -> Result<Vec<Bytes>, CodecError> {
    const WHAT: &str = "payload of programs";
    // Each program takes at least its length field: the count is bounded by the bytes before anything is allocated.
    if count > payload.len() / PACKED_LENGTH_BYTES {
        return Err(malformed(WHAT, format!("{} B cannot hold {count} programs", payload.len())));
    }
    let mut programs = Vec::with_capacity(count);
    for index in 0..count {
        let Some((length, _)) = payload.split_first_chunk::<PACKED_LENGTH_BYTES>() else {
            return Err(malformed(WHAT, format!("ends before program {index} of {count}")));
        };
        let length = u32::from_le_bytes(*length) as usize;
        if length > MAX_PROGRAM_BYTES {
            return Err(too_large("job program", length, MAX_PROGRAM_BYTES));
        }
        let _ = payload.split_to(PACKED_LENGTH_BYTES);
        if length > payload.len() {
            return Err(malformed(WHAT, format!("ends inside program {index} of {count}")));
        }
        programs.push(payload.split_to(length));
    }
    if payload.is_empty() {
        Ok(programs)
    } else {
        Err(malformed(WHAT, format!("{} B follow the last of {count} programs", payload.len())))
    }
}

/// Appends a frame header to `buffer`; gives the bytes appended.
pub(crate) fn encode_header<H: Serialize>(buffer: &mut BytesMut, header: &H) -> Result<usize, CodecError> {
    encode_into(buffer, "frame header", header, MAX_HEADER_BYTES)
}

/// Decodes a whole frame header.
pub(crate) fn decode_header<H: DeserializeOwned>(bytes: &[u8]) -> Result<H, CodecError> {
    decode("frame header", bytes, MAX_HEADER_BYTES)
}

fn encode_into<T: Serialize>(
    buffer: &mut BytesMut,
    what: &'static str,
    value: &T,
    cap: usize,
) -> Result<usize, CodecError> {
    struct Appender<'a> {
        buffer: &'a mut BytesMut,
        end: usize,
    }
    impl bincode::enc::write::Writer for Appender<'_> {
        fn write(&mut self, bytes: &[u8]) -> Result<(), bincode::error::EncodeError> {
            if self.buffer.len() + bytes.len() > self.end {
                return Err(bincode::error::EncodeError::Other(OVER_CAP));
            }
            self.buffer.extend_from_slice(bytes);
            Ok(())
        }
    }
    const OVER_CAP: &str = "over the cap";

    let start = buffer.len();
    let mut appender = Appender { buffer, end: start + cap };
    let outcome = bincode::serde::encode_into_writer(value, &mut appender, bincode::config::standard());
    match outcome {
        Ok(()) => Ok(buffer.len() - start),
        Err(error) => {
            buffer.truncate(start);
            Err(match error {
                bincode::error::EncodeError::Other(OVER_CAP) => too_large(what, cap + 1, cap),
                error => CodecError::Unencodable { what, reason: error.to_string() },
            })
        }
    }
}

fn decode<T: DeserializeOwned>(what: &'static str, bytes: &[u8], cap: usize) -> Result<T, CodecError> {
    // bincode's limit counts what is claimed in memory, not what is read: a one-byte varint claims eight. Sixteen times
    // the input is enough for every honest value; the limit is a constant of the type, so the next power of four is taken.
    if bytes.len() > cap {
        return Err(too_large(what, bytes.len(), cap));
    }
    match bytes.len() {
        0..=0x1000 => decode_within::<T, { 64 << 10 }>(what, bytes),
        0x1001..=0x4000 => decode_within::<T, { 256 << 10 }>(what, bytes),
        0x4001..=0x1_0000 => decode_within::<T, { 1 << 20 }>(what, bytes),
        0x1_0001..=0x4_0000 => decode_within::<T, { 4 << 20 }>(what, bytes),
        0x4_0001..=0x10_0000 => decode_within::<T, { 16 << 20 }>(what, bytes),
        0x10_0001..=0x40_0000 => decode_within::<T, { 64 << 20 }>(what, bytes),
        0x40_0001..=0x100_0000 => decode_within::<T, { 256 << 20 }>(what, bytes),
        0x100_0001..=0x400_0000 => decode_within::<T, { 1 << 30 }>(what, bytes),
        _ => decode_within::<T, { 4 << 30 }>(what, bytes),
    }
}

fn decode_within<T: DeserializeOwned, const LIMIT_BYTES: usize>(
    what: &'static str,
    bytes: &[u8],
) -> Result<T, CodecError> {
    let config = bincode::config::standard().with_limit::<LIMIT_BYTES>();
    let (value, read) = bincode::serde::decode_from_slice(bytes, config)
        .map_err(|error| CodecError::Malformed { what, reason: error.to_string() })?;
    if read == bytes.len() {
        Ok(value)
    } else {
        Err(malformed(what, format!("{} B follow the value", bytes.len() - read)))
    }
}

fn malformed(what: &'static str, reason: String) -> CodecError {
    CodecError::Malformed { what, reason }
}

fn too_large(what: &'static str, bytes: usize, cap: usize) -> CodecError {
    CodecError::TooLarge { what, bytes: bytes as u64, cap: cap as u64 }
}

#[cfg(test)]
mod tests {
    use farm_core::message::CostNs;
    use farm_core::program::{Content, JobProgram, Slicing};
    use proptest::prelude::*;

    use super::*;

    fn program(data: &[u8], launches: u32) -> JobProgram {
        let mut program = JobProgram::default();
        let mut data = data.to_vec();
        data.resize(data.len().next_multiple_of(4).max(4), 0);
        let size_bytes = data.len() as u64;
        let module = Content { hash: content_hash(&data), size_bytes };
        let buffer = program.malloc(size_bytes).unwrap();
        let input = program.task_allocation(module);
        let kernel = program.function_with_constants(module, "main", &[("tile", 8.5)]);
        program.memcpy_htod(kernel, "camera", &data[..4]).unwrap();
        program.memcpy_htod_buffer(buffer, 0, &data).unwrap();
        program.param_in(kernel, 0, input).unwrap();
        program.param_in_out(kernel, 1, buffer).unwrap();
        for launch in 1..=launches {
            let slicing = Slicing { global: "slice".to_owned(), max_groups_z: launch };
            program.launch_sliced(kernel, [launch, 1, 2], slicing, CostNs(u64::from(launch) << 40)).unwrap();
        }
        program.memcpy_dtoh(buffer, 0, size_bytes).unwrap();
        program
    }

    #[test]
    fn a_digest_names_its_bytes() {
        assert_eq!(
            content_hash(b"").to_string(),
            "af1349b9f5f9a1a6a0404dea36dcc9499bcb25c9adc112b7cc9a93cae41f3262",
            "blake3 of nothing, from the reference implementation"
        );
        assert_ne!(content_hash(b"a"), content_hash(b"b"));
    }

    #[test]
    fn a_large_program_keeps_its_bytes() {
        let large = program(&vec![7; 20 << 20], 3);
        let encoded = encode_program(&large).unwrap();
        assert!(encoded.len() < (20 << 20) + 1_000, "{} B: bytes are not encoded one by one", encoded.len());
        assert!(decode_program(&encoded).unwrap() == large, "20 MiB differ");
    }

    #[test]
    fn an_oversized_program_is_refused() {
        let bytes = vec![0; MAX_PROGRAM_BYTES];
        let error = encode_program(&program(&bytes, 1)).unwrap_err();
        assert!(matches!(error, CodecError::TooLarge { .. }), "got {error}");
        let error = decode_program(&vec![0; MAX_PROGRAM_BYTES + 1]).unwrap_err();
        assert!(matches!(error, CodecError::TooLarge { .. }), "got {error}");
    }

    #[test]
    fn hostile_lengths_are_refused() {
        // 253 announces a u64 in bincode's variable-length integers: 2^64-1 commands, or bytes, or characters.
        let all_ones = [&[253_u8][..], &[0xff; 8]].concat();
        let commands = all_ones.clone();
        // One command, the fifth (MemcpyHtoD): buffer 0, offset 0, so many bytes.
        let bytes = [&[1, 4, 0, 0][..], &all_ones].concat();
        // One command, the third (Function): kernel 0, module (digest, size), so long an entry.
        let text = [&[1, 2, 0][..], &[0; 32], &[0], &all_ones].concat();
        // A length that is over the limit for so short an input, but not over the type's cap.
        let amplified = [&[1, 4, 0, 0, 252][..], &(200_u32 << 20).to_le_bytes()].concat();
        for (case, input) in
            [("commands", commands), ("bytes", bytes), ("text", text), ("amplified", amplified)]
        {
            let error = decode_program(&input).unwrap_err();
            assert!(matches!(error, CodecError::Malformed { .. }), "{case}: got {error}");
        }
    }

    #[test]
    fn payloads_of_programs_are_split_where_they_were_joined() {
        let programs: Vec<Bytes> = [0, 1, 100, PACK_BELOW_BYTES, 5, 3 * PACK_BELOW_BYTES]
            .map(|length| Bytes::from(vec![u8::try_from(length % 251).unwrap(); length]))
            .to_vec();
        let chunks = pack_programs(&programs);
        assert_eq!(chunks.len(), 4, "the two large ones are not copied");
        let payload = Bytes::from(chunks.concat());
        assert_eq!(unpack_programs(payload.clone(), programs.len()).unwrap(), programs);
        assert_eq!(pack_programs(&[]), Vec::<Bytes>::new());
        assert_eq!(unpack_programs(Bytes::new(), 0).unwrap(), Vec::<Bytes>::new());
        for (case, payload, count) in [
            ("one too few", payload.clone(), programs.len() - 1),
            ("one too many", payload.clone(), programs.len() + 1),
            ("an absurd count", payload.clone(), usize::MAX),
            ("torn", payload.slice(..payload.len() - 1), programs.len()),
            ("an absurd length", Bytes::from_static(&[0xff; 8]), 1),
        ] {
            assert!(unpack_programs(payload, count).is_err(), "{case}");
        }
    }

    proptest! {
        #[test]
        fn programs_come_back(data in prop::collection::vec(any::<u8>(), 1..2_000), launches in 0_u32..50) {
            let data = &data[..];
            let sent = program(data, launches);
            let encoded = encode_program(&sent).unwrap();
            prop_assert_eq!(decode_program(&encoded).unwrap(), sent);
            prop_assert!(decode_program(&encoded[..encoded.len() - 1]).is_err(), "torn");
            let longer = [&encoded[..], &[0]].concat();
            prop_assert!(decode_program(&longer).is_err(), "a byte too many");
        }

        #[test]
        fn any_bytes_give_an_answer(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            // Whatever the answer is, there is one.
            let _ = decode_program(&bytes);
            let _ = decode_header::<farm_core::message::AppToNode>(&bytes);
            let _ = decode_header::<farm_core::message::NodeToApp>(&bytes);
            let _ = unpack_programs(Bytes::from(bytes), 3);
        }

        #[test]
        fn a_flipped_bit_never_panics(at in 0_usize..400, bit in 0_u8..8) {
            let mut encoded = encode_program(&program(b"some bytes", 3)).unwrap().to_vec();
            let at = at % encoded.len();
            encoded[at] ^= 1 << bit;
            let _ = decode_program(&encoded);
        }
    }
}
