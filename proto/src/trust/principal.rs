//! Farm, role and name, as the URI of a certificate says them.

use std::{fmt, str::FromStr};

use x509_parser::{
    certificate::X509Certificate,
    extensions::{GeneralName, ParsedExtension},
    prelude::FromDer as _,
};

use super::TrustError;

/// What a URI of ours begins with.
const SCHEME: &str = "gleaner://";
/// Longest farm or name, in bytes.
const MAX_NAME_BYTES: usize = 64;

/// What somebody is to a farm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// Plans; others trust its words.
    Coordinator,
    /// Computes.
    Node,
    /// Brings jobs.
    App,
    /// Brings jobs, drains nodes, makes tokens.
    Operator,
}

impl Role {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Coordinator, Self::Node, Self::App, Self::Operator];

    /// Its word in URIs and on command lines.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Coordinator => "coordinator",
            Self::Node => "node",
            Self::App => "app",
            Self::Operator => "operator",
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

impl FromStr for Role {
    type Err = TrustError;

    fn from_str(text: &str) -> Result<Self, TrustError> {
        Self::ALL
            .into_iter()
            .find(|role| role.word() == text)
            .ok_or_else(|| TrustError::Invalid("a role is coordinator, node, app or operator".to_owned()))
    }
}

/// Whose certificate it is: `gleaner://FARM/ROLE/NAME`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Principal {
    /// The farm; two farms of one name are told apart by their authorities' keys.
    pub farm: String,
    /// What it is.
    pub role: Role,
    /// A node's name, an application's project, an operator's name.
    pub name: String,
}

impl fmt::Display for Principal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{SCHEME}{}/{}/{}", self.farm, self.role, self.name)
    }
}

impl FromStr for Principal {
    type Err = TrustError;

    fn from_str(uri: &str) -> Result<Self, TrustError> {
        let shown = || uri.chars().take(4 * MAX_NAME_BYTES).collect::<String>();
        let wrong = || TrustError::Invalid(format!("{:?} is not {SCHEME}FARM/ROLE/NAME", shown()));
        let mut parts = uri.strip_prefix(SCHEME).ok_or_else(wrong)?.split('/');
        let (Some(farm), Some(role), Some(name), None) =
            (parts.next(), parts.next(), parts.next(), parts.next())
        else {
            return Err(wrong());
        };
        Self::new(farm, role.parse()?, name)
    }
}

impl Principal {
    /// # Errors
    /// Farm or name is empty, too long, or has characters besides letters, digits, `.`, `_`, `-`.
    pub fn new(farm: &str, role: Role, name: &str) -> Result<Self, TrustError> {
        check_name("farm", farm)?;
        check_name("name", name)?;
        Ok(Self { farm: farm.to_owned(), role, name: name.to_owned() })
    }

    /// Whether a node of this identity may call itself so: its own name, or `NAME/anything` where one machine runs several.
    #[must_use]
    pub fn may_be_called(&self, node_name: &str) -> bool {
        let rest = node_name.strip_prefix(self.name.as_str());
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
    }
}

/// A member as its certificate shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Member {
    /// Who it is.
    pub principal: Principal,
    /// blake3 of its public key (SubjectPublicKeyInfo, DER): two owners of one name are told apart.
    pub key: [u8; 32],
}

impl Member {
    /// Whose a certificate is, by the one URI that it must hold. Says nothing about who signed it.
    ///
    /// # Errors
    /// It is no certificate of a farm.
    pub fn of_certificate(der: &[u8]) -> Result<Self, TrustError> {
        let wrong = |reason: String| TrustError::Invalid(format!("not a farm's certificate: {reason}"));
        let (_, certificate) = X509Certificate::from_der(der).map_err(|error| wrong(error.to_string()))?;
        let mut names =
            certificate.extensions().iter().flat_map(|extension| match extension.parsed_extension() {
                ParsedExtension::SubjectAlternativeName(names) => names.general_names.as_slice(),
                _ => &[],
            });
        let (Some(GeneralName::URI(uri)), None) = (names.next(), names.next()) else {
            return Err(wrong("it does not have one URI and no other name".to_owned()));
        };
        Ok(Self { principal: uri.parse()?, key: *blake3::hash(certificate.public_key().raw).as_bytes() })
    }
}

/// # Errors
/// It is empty, over 64 bytes, or has characters besides letters, digits, `.`, `_`, `-`.
pub fn check_name(what: &str, name: &str) -> Result<(), TrustError> {
    let allowed = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'_' | b'-');
    if name.is_empty() || name.len() > MAX_NAME_BYTES || !name.bytes().all(allowed) {
        let name = name.chars().take(MAX_NAME_BYTES).collect::<String>();
        return Err(TrustError::Invalid(format!(
            "{what} {name:?} is not 1 to {MAX_NAME_BYTES} letters, digits, '.', '_' or '-'"
        )));
    }
    Ok(())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a step that fails fails its test")]
mod tests {
    use super::*;

    #[test]
    fn uris_round_trip_and_nonsense_is_refused() {
        for role in Role::ALL {
            let principal = Principal::new("studio-1", role, "gpu.07_b").unwrap();
            assert_eq!(principal.to_string().parse::<Principal>().unwrap(), principal);
        }
        let long = format!("gleaner://farm/node/{}", "x".repeat(65));
        for bad in [
            "",
            "gleaner://",
            "gleaner://farm/node",
            "gleaner://farm/node/",
            "gleaner:///node/x",
            "gleaner://farm/king/x",
            "gleaner://farm/node/x/y",
            "gleaner://farm/node/x y",
            "gleaner://farm/node/é",
            "https://farm/node/x",
            &long,
        ] {
            assert!(bad.parse::<Principal>().is_err(), "{bad}");
        }
    }

    #[test]
    fn a_node_has_its_own_name_or_one_below_it() {
        let node = Principal::new("farm", Role::Node, "gpu-1").unwrap();
        for good in ["gpu-1", "gpu-1/0", "gpu-1/slurm 4711"] {
            assert!(node.may_be_called(good), "{good}");
        }
        for bad in ["", "gpu-10", "gpu", "gpu-2", "gpu-1x/0", "/gpu-1"] {
            assert!(!node.may_be_called(bad), "{bad}");
        }
    }
}
