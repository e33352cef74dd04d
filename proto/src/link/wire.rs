//! The layout of a frame: `u32` header length, `u64` payload length (both little-endian), header, payload.
//! Each one-way stream begins with one byte that says what follows on it.

use bytes::{Buf as _, BufMut, Bytes, BytesMut};

use super::{Frame, Header, LinkError};
use crate::codec::{self, CodecError, MAX_HEADER_BYTES};

/// First byte of the one stream of small frames.
pub(super) const ORDERED_STREAM: u8 = 0;
/// First byte of a stream of one large frame.
pub(super) const BULK_STREAM: u8 = 1;
/// Bytes of the two lengths.
pub(super) const PREFIX_BYTES: usize = 12;

/// A frame as it travels.
///
/// # Errors
/// The header is over its cap.
pub fn encode_frame<S: Header>(header: &S, payload: &[Bytes]) -> Result<Bytes, CodecError> {
    let mut buffer = BytesMut::new();
    append_header(&mut buffer, header, payload)?;
    payload.iter().for_each(|chunk| buffer.extend_from_slice(chunk));
    Ok(buffer.freeze())
}

/// The frames in the bytes of a stream, as a link reads them, without a network; a frame that is not all there is left out.
///
/// # Errors
/// A length is over its cap, or a header is not one.
pub fn decode_frames<R: Header>(bytes: Bytes) -> Result<Vec<Frame<R>>, LinkError> {
    let mut buffer = BytesMut::from(bytes);
    let mut frames = Vec::new();
    while let Some(lengths) = Lengths::parse(&buffer, R::MAX_PAYLOAD_BYTES)? {
        if buffer.len() < lengths.frame_bytes() {
            break;
        }
        frames.push(split_frame(&mut buffer, lengths)?);
    }
    Ok(frames)
}

/// The checked lengths of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Lengths {
    /// Of the header, in bytes.
    pub(super) header: usize,
    /// Of the payload, in bytes.
    pub(super) payload: usize,
}

impl Lengths {
    /// Reads and checks the lengths at the start of `bytes`; `None` if they are not all there yet.
    pub(super) fn parse(bytes: &[u8], payload_cap: u64) -> Result<Option<Self>, LinkError> {
        let Some((prefix, _)) = bytes.split_first_chunk::<PREFIX_BYTES>() else { return Ok(None) };
        let [h0, h1, h2, h3, payload @ ..] = *prefix;
        let (header, payload) = (u32::from_le_bytes([h0, h1, h2, h3]), u64::from_le_bytes(payload));
        if header as usize > MAX_HEADER_BYTES {
            return Err(protocol(format!("header of {header} B is over {MAX_HEADER_BYTES} B")));
        }
        if payload > payload_cap {
            return Err(protocol(format!("payload of {payload} B is over {payload_cap} B")));
        }
        let payload = usize::try_from(payload).map_err(|_| protocol(format!("payload of {payload} B")))?;
        Ok(Some(Self { header: header as usize, payload }))
    }

    /// Of the whole frame.
    pub(super) const fn frame_bytes(self) -> usize {
        PREFIX_BYTES + self.header + self.payload
    }
}

/// Appends the lengths and the header of a frame.
pub(super) fn append_header<S: Header>(
    buffer: &mut BytesMut,
    header: &S,
    payload: &[Bytes],
) -> Result<(), CodecError> {
    let start = buffer.len();
    buffer.put_u32_le(0);
    buffer.put_u64_le(payload.iter().map(|chunk| chunk.len() as u64).sum());
    let header_bytes = codec::encode_header(buffer, header)?;
    let header_bytes = u32::try_from(header_bytes).expect("the codec caps headers at 16 MiB");
    buffer[start..start + 4].copy_from_slice(&header_bytes.to_le_bytes());
    Ok(())
}

/// Takes a complete frame from the front of `buffer`; its payload shares the buffer's memory.
pub(super) fn split_frame<R: Header>(buffer: &mut BytesMut, lengths: Lengths) -> Result<Frame<R>, LinkError> {
    buffer.advance(PREFIX_BYTES);
    let header =
        codec::decode_header(&buffer[..lengths.header]).map_err(|error| protocol(error.to_string()))?;
    buffer.advance(lengths.header);
    let payload = match lengths.payload {
        0 => Bytes::new(),
        payload => buffer.split_to(payload).freeze(),
    };
    Ok(Frame { header, payload })
}

pub(super) fn protocol(reason: String) -> LinkError {
    LinkError::Protocol { reason }
}
