//! Wire <-> domain, for every message of the control plane: `From` outwards, `TryFrom` inwards, so that a domain value
//! that came over a wire is as good as one made here. Nothing is decided here.

mod admin;
mod apps;
mod attempts;
mod model;
mod nodes;
mod project;
mod timeline;

pub(super) use self::project::set_project_request;
pub use self::{admin::eviction, project::quota_change};
use farm_core::id::DeviceIndex;
use prost::Message;
use thiserror::Error;

/// Most jobs named by one message (16 bytes each at worst: within the message cap).
pub const MAX_JOBS: usize = 1 << 20;
/// Most devices of one node, and nodes or applications in one message.
pub const MAX_ENTRIES: usize = 65_536;
/// Most contents of one plan request.
pub const MAX_CONTENTS: usize = 65_536;
/// Most addresses of one node.
pub const MAX_ADDRESSES: usize = 32;
/// Longest name or address, in bytes.
pub const MAX_NAME_BYTES: usize = 256;
/// Longest certificate, in bytes.
pub const MAX_CERTIFICATE_BYTES: usize = 64 << 10;
/// Longest text for people, in bytes; a longer one is cut when it is sent.
pub const MAX_TEXT_BYTES: usize = 16 << 10;

/// A message is not what the protocol allows. Not to be retried: the peer is of another build, or hostile.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum WireError {
    /// A part that must be there is not (or is a case this build does not know).
    #[error("{field} is missing")]
    Missing {
        /// Which, as in the `.proto` files.
        field: &'static str,
    },
    /// A value that the domain does not have.
    #[error("{field}: {value} is not allowed")]
    Invalid {
        /// Which, as in the `.proto` files.
        field: &'static str,
        /// What it was.
        value: String,
    },
    /// More entries or bytes than the field's cap.
    #[error("{field} has {count} entries, more than {cap}")]
    TooMany {
        /// Which, as in the `.proto` files.
        field: &'static str,
        /// How many.
        count: usize,
        /// The most allowed.
        cap: usize,
    },
}

/// Why bytes are not a message. Not to be retried.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum MessageError {
    /// They are no message of this shape.
    #[error("a message does not decode: {0}")]
    Malformed(#[from] prost::DecodeError),
    /// The message says what the protocol does not allow.
    #[error(transparent)]
    Refused(#[from] WireError),
}

/// A message's bytes, as a session carries them.
#[must_use]
pub fn encode<W: Message + From<D>, D>(message: D) -> Vec<u8> {
    W::from(message).encode_to_vec()
}

/// A message from its bytes, as a session hears it: what gRPC does to each, without a network.
///
/// # Errors
/// They are no message, or it says what the protocol does not allow.
pub fn decode<W: Message + Default, D: TryFrom<W, Error = WireError>>(
    bytes: &[u8],
) -> Result<D, MessageError> {
    Ok(D::try_from(W::decode(bytes)?)?)
}

fn required<T>(field: &'static str, value: Option<T>) -> Result<T, WireError> {
    value.ok_or(WireError::Missing { field })
}

fn invalid(field: &'static str, value: impl ToString) -> WireError {
    WireError::Invalid { field, value: value.to_string() }
}

fn within(field: &'static str, count: usize, cap: usize) -> Result<(), WireError> {
    if count > cap { Err(WireError::TooMany { field, count, cap }) } else { Ok(()) }
}

/// A repeated message field, converted entry by entry.
fn list<W, D: TryFrom<W, Error = WireError>>(
    field: &'static str,
    cap: usize,
    wire: Vec<W>,
) -> Result<Vec<D>, WireError> {
    within(field, wire.len(), cap)?;
    wire.into_iter().map(D::try_from).collect()
}

fn name(field: &'static str, text: String) -> Result<String, WireError> {
    within(field, text.len(), MAX_NAME_BYTES)?;
    Ok(text)
}

fn text(field: &'static str, text: String) -> Result<String, WireError> {
    within(field, text.len(), MAX_TEXT_BYTES)?;
    Ok(text)
}

/// Texts for people are cut on their way out: a long error message must not end the session.
fn cut(mut text: String) -> String {
    text.truncate(text.floor_char_boundary(MAX_TEXT_BYTES));
    text
}

fn device(field: &'static str, index: u32) -> Result<DeviceIndex, WireError> {
    u16::try_from(index).map(DeviceIndex).map_err(|_| invalid(field, index))
}

fn weight(field: &'static str, weight: f64) -> Result<f64, WireError> {
    if weight.is_finite() && weight > 0.0 { Ok(weight) } else { Err(invalid(field, weight)) }
}

fn score(field: &'static str, score: f64) -> Result<f64, WireError> {
    if score.is_finite() && score >= 0.0 { Ok(score) } else { Err(invalid(field, score)) }
}

fn enumeration<W: TryFrom<i32>>(field: &'static str, value: i32) -> Result<W, WireError> {
    W::try_from(value).map_err(|_| invalid(field, value))
}
