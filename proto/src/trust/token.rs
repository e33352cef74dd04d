//! One-time join tokens: what an operator hands to whoever may join, on a command line or in a batch script.

use std::{fmt, str::FromStr};

use super::TrustError;

/// What a token's text begins with.
const PREFIX: &str = "gleaner-join-";
/// Bytes of a secret: nobody guesses 128 bits.
pub const SECRET_BYTES: usize = 16;
/// Bytes of a fingerprint.
const FINGERPRINT_BYTES: usize = 32;

/// The secret that a coordinator knows the digest of, and the blake3 of the farm's authority, by which who joins knows the
/// coordinator.
#[derive(Clone, PartialEq, Eq)]
pub struct JoinToken {
    /// Known to who made the token and to who has it.
    pub secret: [u8; SECRET_BYTES],
    /// blake3 of the authority's certificate.
    pub authority: [u8; FINGERPRINT_BYTES],
}

/// The secret stays out of logs.
impl fmt::Debug for JoinToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("JoinToken")
    }
}

/// `gleaner-join-` and 96 hexadecimal digits.
impl fmt::Display for JoinToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(PREFIX)?;
        self.secret.iter().chain(&self.authority).try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl FromStr for JoinToken {
    type Err = TrustError;

    fn from_str(text: &str) -> Result<Self, TrustError> {
        // Not the text itself: it may be a secret with a slip.
        let wrong = || TrustError::Invalid(format!("the token is not {PREFIX} and 96 hexadecimal digits"));
        let digits = text.trim().strip_prefix(PREFIX).ok_or_else(wrong)?;
        let mut bytes = [0; SECRET_BYTES + FINGERPRINT_BYTES];
        if digits.len() != 2 * bytes.len() || !digits.bytes().all(|digit| digit.is_ascii_hexdigit()) {
            return Err(wrong());
        }
        for (byte, at) in bytes.iter_mut().zip((0..).step_by(2)) {
            *byte = u8::from_str_radix(&digits[at..at + 2], 16).map_err(|_| wrong())?;
        }
        let (mut secret, mut authority) = ([0; SECRET_BYTES], [0; FINGERPRINT_BYTES]);
        secret.copy_from_slice(&bytes[..SECRET_BYTES]);
        authority.copy_from_slice(&bytes[SECRET_BYTES..]);
        Ok(Self { secret, authority })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a step that fails fails its test")]
mod tests {
    use super::*;

    #[test]
    fn tokens_round_trip_and_slips_are_refused_without_their_text() {
        let token = JoinToken { secret: [0xa5; SECRET_BYTES], authority: [7; FINGERPRINT_BYTES] };
        let text = token.to_string();
        assert_eq!(text.parse::<JoinToken>().unwrap(), token);
        assert_eq!(
            format!(" {text}\n").parse::<JoinToken>().unwrap(),
            token,
            "a copied line end does no harm"
        );
        let other_digit = text.replace('5', "g");
        for bad in [
            "",
            PREFIX,
            &text[1..],
            &text[..text.len() - 1],
            &format!("{text}0"),
            &other_digit,
            "gleaner-join-é",
        ] {
            let error = bad.parse::<JoinToken>().unwrap_err().to_string();
            assert!(!error.contains("a5a5"), "{error}");
        }
        assert_eq!(format!("{token:?}"), "JoinToken");
    }
}
