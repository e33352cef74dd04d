//! Capabilities: the coordinator's word, for nodes, that an application is who it says. An application carries its own to every
//! node it dials; a node needs nobody else to check it.

use std::time::{Duration, SystemTime};

use farm_core::id::{AppId, AppIncarnation, Epoch};
use prost::Message as _;
use ring::signature::{ECDSA_P256_SHA256_ASN1, UnparsedPublicKey};
use rustls::pki_types::CertificateDer;
use x509_parser::{certificate::X509Certificate, prelude::FromDer as _};

use super::{Identity, Member, Principal, Role, TrustError, unix_seconds, verify};
use crate::control::v1;

/// Most bytes of an encoded capability; about 700 are used.
pub const MAX_CAPABILITY_BYTES: usize = 4 << 10;

/// Before a signature, so that nothing signed for another purpose is one.
const CONTEXT: &[u8] = b"gleaner capability 1\0";

/// What a coordinator says of an application.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Capability {
    /// The application.
    pub app: AppId,
    /// Its life.
    pub incarnation: AppIncarnation,
    /// Whose it is: it counts on connections of this principal alone.
    pub holder: Principal,
    /// The project that it was of; its contents are this project's.
    pub project: String,
    /// The life of the coordinator that gave it.
    pub epoch: Epoch,
    /// Until when it counts.
    pub expires: SystemTime,
}

impl Capability {
    /// Signs it, as bytes for the wire.
    ///
    /// # Errors
    /// The key cannot sign.
    pub fn sign(&self, coordinator: &Identity) -> Result<Vec<u8>, TrustError> {
        let claims = v1::CapabilityClaims {
            app: self.app.0,
            incarnation: self.incarnation.0,
            holder: self.holder.to_string(),
            project: self.project.clone(),
            epoch: self.epoch.0,
            expires_s: unix_seconds(self.expires),
        };
        let claims = claims.encode_to_vec();
        let signature = coordinator.sign(&[CONTEXT, &claims].concat())?;
        let certified = coordinator.certified();
        let certificate_der =
            certified.cert.first().map_or_else(Vec::new, |certificate| certificate.to_vec());
        Ok(v1::Capability { claims, signature, certificate_der }.encode_to_vec())
    }

    /// Reads and checks a capability: signed by a coordinator of `own`'s farm, for `holder`, and not over.
    ///
    /// # Errors
    /// It is malformed, forged, over, or somebody else's; the text says which.
    pub fn check(
        bytes: &[u8],
        own: &Identity,
        holder: &Principal,
        now: SystemTime,
    ) -> Result<Self, TrustError> {
        let wrong = |reason: String| TrustError::Invalid(format!("the capability {reason}"));
        if bytes.len() > MAX_CAPABILITY_BYTES {
            return Err(wrong(format!("is over {MAX_CAPABILITY_BYTES} B")));
        }
        let signed =
            v1::Capability::decode(bytes).map_err(|error| wrong(format!("is malformed: {error}")))?;
        let certificate = CertificateDer::from(signed.certificate_der);
        verify::signed_by(&certificate, own.authority(), now)
            .map_err(|error| wrong(format!("is not of this farm: {error}")))?;
        if Member::of_certificate(&certificate)?.principal.role != Role::Coordinator {
            return Err(wrong("is not signed by a coordinator".to_owned()));
        }
        let (_, parsed) = X509Certificate::from_der(&certificate)
            .map_err(|error| wrong(format!("has a malformed certificate: {error}")))?;
        let key =
            UnparsedPublicKey::new(&ECDSA_P256_SHA256_ASN1, &parsed.public_key().subject_public_key.data);
        key.verify(&[CONTEXT, &signed.claims].concat(), &signed.signature)
            .map_err(|_| wrong("has a wrong signature".to_owned()))?;
        let claims = v1::CapabilityClaims::decode(signed.claims.as_slice())
            .map_err(|error| wrong(format!("is malformed: {error}")))?;
        let capability = Self {
            app: AppId(claims.app),
            incarnation: AppIncarnation(claims.incarnation),
            holder: claims.holder.parse()?,
            project: claims.project,
            epoch: Epoch(claims.epoch),
            // A year that no clock reaches is not a reason to panic.
            expires: SystemTime::UNIX_EPOCH + Duration::from_secs(claims.expires_s.min(u64::from(u32::MAX))),
        };
        if capability.project.is_empty() {
            return Err(wrong("names no project: it is of an earlier version".to_owned()));
        }
        if capability.expires <= now {
            return Err(wrong("is over".to_owned()));
        }
        if capability.holder != *holder {
            return Err(wrong(format!("is of {}, not of {holder}", capability.holder)));
        }
        Ok(capability)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a step that fails fails its test")]
mod tests {
    use super::*;
    use crate::trust::{Authority, IDENTITY_LIFETIME};

    fn capability(holder: &Identity) -> Capability {
        Capability {
            app: AppId(7),
            incarnation: AppIncarnation(2),
            holder: holder.principal().clone(),
            project: "studio".to_owned(),
            epoch: Epoch(3),
            expires: SystemTime::UNIX_EPOCH + Duration::from_secs(crate::trust::unix_now() + 60),
        }
    }

    #[test]
    fn only_what_this_farms_coordinator_signed_for_the_holder_counts_and_not_for_ever() {
        let authority = Authority::create("farm").unwrap();
        let identity = |role, name| authority.identity(role, name, IDENTITY_LIFETIME).unwrap();
        let coordinator = identity(Role::Coordinator, "coordinator");
        let (node, app, other) =
            (identity(Role::Node, "n"), identity(Role::App, "a"), identity(Role::App, "b"));
        let given = capability(&app);
        let bytes = given.sign(&coordinator).unwrap();
        assert!(bytes.len() < 1_024, "about 700 B, not {}", bytes.len());
        let now = SystemTime::now();
        let check = |bytes: &[u8], holder: &Identity, now| {
            Capability::check(bytes, &node, holder.principal(), now).map_err(|error| error.to_string())
        };
        assert_eq!(check(&bytes, &app, now), Ok(given.clone()));

        let refused = |outcome: Result<Capability, String>, why: &str| {
            let reason = outcome.unwrap_err();
            assert!(reason.contains(why), "{why:?} is not said: {reason}");
        };
        refused(check(&bytes, &other, now), "not of gleaner://farm/app/b");
        refused(check(&bytes, &app, now + Duration::from_secs(61)), "is over");
        refused(check(&given.sign(&node).unwrap(), &app, now), "not signed by a coordinator");
        refused(check(&given.sign(&app).unwrap(), &app, now), "not signed by a coordinator");
        let stranger = Authority::create("farm").unwrap();
        let impostor = stranger.identity(Role::Coordinator, "coordinator", IDENTITY_LIFETIME).unwrap();
        refused(check(&given.sign(&impostor).unwrap(), &app, now), "not of this farm");
        refused(check(&vec![0; MAX_CAPABILITY_BYTES + 1], &app, now), "over");
        refused(check(b"", &app, now), "not of this farm");
    }

    #[test]
    fn no_changed_byte_makes_another_capability() {
        let authority = Authority::create("farm").unwrap();
        let coordinator = authority.identity(Role::Coordinator, "coordinator", IDENTITY_LIFETIME).unwrap();
        let app = authority.identity(Role::App, "a", IDENTITY_LIFETIME).unwrap();
        let given = capability(&app);
        let bytes = given.sign(&coordinator).unwrap();
        for at in 0..bytes.len() {
            for bit in [1, 0x80] {
                let mut changed = bytes.clone();
                changed[at] ^= bit;
                let outcome = Capability::check(&changed, &app, app.principal(), SystemTime::now());
                // What the encoding does not say (an unknown field's number, say) may change; what it says may not.
                assert!(outcome.as_ref().map_or(true, |read| *read == given), "byte {at}: {outcome:?}");
            }
            let cut = Capability::check(&bytes[..at], &app, app.principal(), SystemTime::now());
            assert!(cut.is_err(), "cut at {at}");
        }
    }
}
