//! Checking who is at the other end: certificates signed by the farm's authority, told apart by their one URI. Addresses and
//! host names play no part: a farm's members move.

use std::time::SystemTime;

use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error, RootCertStore, SignatureScheme,
    client::{
        danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier},
        verify_server_cert_signed_by_trust_anchor,
    },
    crypto::{WebPkiSupportedAlgorithms, ring, verify_tls13_signature},
    pki_types::{CertificateDer, ServerName, UnixTime},
    server::{
        ParsedCertificate,
        danger::{ClientCertVerified, ClientCertVerifier},
    },
};

use super::{Member, Role};

fn algorithms() -> WebPkiSupportedAlgorithms {
    ring::default_provider().signature_verification_algorithms
}

/// Whether a certificate was signed by an authority, and is of this time.
pub(crate) fn signed_by(
    certificate: &CertificateDer<'_>,
    authority: &CertificateDer<'static>,
    now: SystemTime,
) -> Result<(), Error> {
    let since_1970 = now.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    signed_at(certificate, authority, UnixTime::since_unix_epoch(since_1970))
}

fn signed_at(
    certificate: &CertificateDer<'_>,
    authority: &CertificateDer<'static>,
    now: UnixTime,
) -> Result<(), Error> {
    let mut roots = RootCertStore::empty();
    roots.add(authority.clone())?;
    let parsed = ParsedCertificate::try_from(certificate)?;
    verify_server_cert_signed_by_trust_anchor(&parsed, &roots, &[], now, algorithms().all)
}

fn refused() -> Error {
    Error::InvalidCertificate(CertificateError::ApplicationVerificationFailure)
}

/// How a client knows the server.
#[derive(Debug)]
pub(crate) enum ServerCheck {
    /// A node: by exactly this certificate, of which the coordinator's plan told. There is no name check and no expiry.
    Pinned(CertificateDer<'static>),
    /// The coordinator, by a member: by the authority in its own identity.
    Authority(CertificateDer<'static>),
    /// The coordinator, by who joins: by the blake3 of the authority, which the coordinator sends along.
    Fingerprint([u8; 32]),
}

impl ServerCertVerifier for ServerCheck {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let authority = match self {
            Self::Pinned(expected) if end_entity == expected => return Ok(ServerCertVerified::assertion()),
            Self::Pinned(_) => return Err(refused()),
            Self::Authority(authority) => authority.clone(),
            Self::Fingerprint(fingerprint) => intermediates
                .iter()
                .find(|sent| blake3::hash(sent) == *fingerprint)
                .ok_or_else(refused)?
                .clone()
                .into_owned(),
        };
        signed_at(end_entity, &authority, now)?;
        match Member::of_certificate(end_entity) {
            Ok(member) if member.principal.role == Role::Coordinator => Ok(ServerCertVerified::assertion()),
            Ok(_) | Err(_) => Err(refused()),
        }
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _certificate: &CertificateDer<'_>,
        _signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(old_tls())
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, certificate, signature, &algorithms())
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        algorithms().supported_schemes()
    }
}

/// How a server knows members. Who they are and what they may do is asked afterwards.
#[derive(Debug)]
pub(crate) struct MemberCheck {
    pub(crate) authority: CertificateDer<'static>,
    /// False where who joins comes without a certificate.
    pub(crate) mandatory: bool,
}

impl ClientCertVerifier for MemberCheck {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &[]
    }

    fn client_auth_mandatory(&self) -> bool {
        self.mandatory
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        signed_at(end_entity, &self.authority, now)?;
        Member::of_certificate(end_entity).map_err(|_| refused())?;
        Ok(ClientCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _certificate: &CertificateDer<'_>,
        _signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(old_tls())
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, certificate, signature, &algorithms())
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        algorithms().supported_schemes()
    }
}

fn old_tls() -> Error {
    Error::General("TLS 1.2 is not spoken here".to_owned())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a step that fails fails its test")]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::trust::{Authority, Capability, IDENTITY_LIFETIME};

    /// Scenario 32: the wall clocks of two machines are up to an hour apart, either way.
    #[test]
    fn s32_clocks_an_hour_apart_let_members_in_and_members_end_with_their_certificates() {
        let minutes = |minutes: u64| Duration::from_secs(60 * minutes);
        let authority = Authority::create("farm").unwrap();
        let identity = |role, name| authority.identity(role, name, IDENTITY_LIFETIME).unwrap();
        let (coordinator, node) = (identity(Role::Coordinator, "coordinator"), identity(Role::Node, "n"));
        let app = identity(Role::App, "a");
        let certified = app.certified();
        let signed = |now| signed_by(&certified.cert[0], node.authority(), now);
        let given = Capability {
            app: farm_core::id::AppId(1),
            incarnation: farm_core::id::AppIncarnation(1),
            holder: app.principal().clone(),
            project: "default".to_owned(),
            epoch: farm_core::id::Epoch(1),
            expires: SystemTime::now() + Duration::from_secs(86_400),
        };
        let capability = given.sign(&coordinator).unwrap();
        let holds = |now| Capability::check(&capability, &node, app.principal(), now);
        let now = SystemTime::now();
        for there in [now - minutes(59), now, now + minutes(59)] {
            signed(there).unwrap();
            holds(there).unwrap();
        }
        // And no further: who was not a member yet is not let in, nor who is none any more.
        assert!(signed(now - minutes(61)).is_err() && holds(now - minutes(61)).is_err());
        assert!(signed(now + IDENTITY_LIFETIME - minutes(1)).is_ok());
        assert!(signed(now + IDENTITY_LIFETIME + minutes(1)).is_err());
        assert!(holds(now + minutes(24 * 60 + 1)).is_err());
    }
}
