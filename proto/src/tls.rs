//! TLS of both planes (TLS 1.3 only, no 0-RTT).
//!
//! Data plane: an application trusts exactly the node certificate that the coordinator's plan names; there is no name check
//! and no expiry. In a secured farm the node asks for the application's identity in turn. Control plane of a secured farm:
//! both ends show identities of the farm's authority (`trust`). Who may do what is not decided here.

use std::sync::Arc;

use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use rustls::{
    Error,
    crypto::{CryptoProvider, ring},
    pki_types::{CertificateDer, PrivateKeyDer},
};
use thiserror::Error;

use crate::trust::{
    Identity, Member,
    verify::{MemberCheck, ServerCheck},
};

/// What both ends of the data plane must speak; a peer of another protocol is refused in the handshake.
const ALPN: &[u8] = b"gleaner-data/1";
/// What both ends of the control plane speak.
const HTTP_2: &[u8] = b"h2";
/// The name in every node certificate. Nobody compares it: the pinned bytes say who it is.
pub(crate) const NODE_NAME: &str = "gleaner-node";

/// A TLS configuration could not be made.
#[derive(Debug, Error)]
pub enum TlsError {
    /// The certificate could not be generated.
    #[error("cannot make a node certificate: {0}")]
    Certificate(#[from] rcgen::Error),
    /// The TLS library refused the configuration.
    #[error("cannot configure TLS: {0}")]
    Configuration(String),
}

/// A node's identity on the data plane; lives as long as the process.
#[derive(Debug)]
pub struct NodeCertificate {
    certificate: CertificateDer<'static>,
    key: PrivateKeyDer<'static>,
}

impl NodeCertificate {
    /// A fresh self-signed certificate (ECDSA P-256).
    ///
    /// # Errors
    /// The system gives no randomness.
    pub fn generate() -> Result<Self, TlsError> {
        let made = rcgen::generate_simple_self_signed([NODE_NAME.to_owned()])?;
        let key = PrivateKeyDer::try_from(made.signing_key.serialize_der())
            .map_err(|reason| TlsError::Configuration(reason.to_owned()))?;
        Ok(Self { certificate: made.cert.der().clone(), key })
    }

    /// The certificate in DER: what a plan's contact carries.
    #[must_use]
    pub fn der(&self) -> &[u8] {
        &self.certificate
    }

    /// The server's side; with an identity, for members of its farm alone.
    pub(crate) fn server_config(&self, identity: Option<&Identity>) -> Result<QuicServerConfig, TlsError> {
        let builder = rustls::ServerConfig::builder_with_provider(provider())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .map_err(configuration)?;
        let builder = match identity {
            Some(identity) => builder.with_client_cert_verifier(members(identity, true)),
            None => builder.with_no_client_auth(),
        };
        let mut config = builder
            .with_single_cert(vec![self.certificate.clone()], self.key.clone_key())
            .map_err(configuration)?;
        config.alpn_protocols = vec![ALPN.to_vec()];
        config.max_early_data_size = 0;
        // A link lives as long as its application: session tickets would only cost packets.
        config.send_tls13_tickets = 0;
        QuicServerConfig::try_from(config).map_err(|error| TlsError::Configuration(error.to_string()))
    }
}

/// The client's side: accepts the one certificate given, nothing else, and shows its identity if it has one.
pub(crate) fn pinned_client_config(
    certificate_der: &[u8],
    identity: Option<&Identity>,
) -> Result<QuicClientConfig, TlsError> {
    let check = ServerCheck::Pinned(CertificateDer::from(certificate_der.to_vec()));
    let mut config = client_config(check, identity)?;
    config.alpn_protocols = vec![ALPN.to_vec()];
    QuicClientConfig::try_from(config).map_err(|error| TlsError::Configuration(error.to_string()))
}

/// The coordinator's side of the control plane. Who joins has no certificate yet: what it may say is asked afterwards.
pub(crate) fn control_server_config(identity: &Identity) -> Result<rustls::ServerConfig, TlsError> {
    let mut config = rustls::ServerConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(configuration)?
        .with_client_cert_verifier(members(identity, false))
        .with_cert_resolver(Arc::new(identity.clone()));
    config.alpn_protocols = vec![HTTP_2.to_vec()];
    config.max_early_data_size = 0;
    config.send_tls13_tickets = 0;
    Ok(config)
}

/// A member's side of the control plane.
pub(crate) fn control_client_config(identity: &Identity) -> Result<rustls::ClientConfig, TlsError> {
    let check = ServerCheck::Authority(identity.authority().clone());
    control_client(check, Some(identity))
}

/// The side of who joins: it knows the coordinator by the blake3 of the farm's authority.
pub(crate) fn join_client_config(authority: [u8; 32]) -> Result<rustls::ClientConfig, TlsError> {
    control_client(ServerCheck::Fingerprint(authority), None)
}

fn control_client(check: ServerCheck, identity: Option<&Identity>) -> Result<rustls::ClientConfig, TlsError> {
    let mut config = client_config(check, identity)?;
    config.alpn_protocols = vec![HTTP_2.to_vec()];
    Ok(config)
}

fn client_config(check: ServerCheck, identity: Option<&Identity>) -> Result<rustls::ClientConfig, TlsError> {
    let builder = rustls::ClientConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(configuration)?
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(check));
    let mut config = match identity {
        Some(identity) => builder.with_client_cert_resolver(Arc::new(identity.clone())),
        None => builder.with_no_client_auth(),
    };
    config.enable_early_data = false;
    config.resumption = rustls::client::Resumption::disabled();
    Ok(config)
}

fn members(identity: &Identity, mandatory: bool) -> Arc<MemberCheck> {
    Arc::new(MemberCheck { authority: identity.authority().clone(), mandatory })
}

/// Whose certificate a peer has shown; the handshake has checked that it is a member's.
pub(crate) fn member(shown: Option<&[CertificateDer<'_>]>) -> Option<Member> {
    Member::of_certificate(shown?.first()?).ok()
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

fn configuration(error: Error) -> TlsError {
    TlsError::Configuration(error.to_string())
}
