//! The farm's certificate authority: made once by `farmctl init`, used by the coordinator alone.

use std::{
    fmt,
    path::Path,
    time::{Duration, SystemTime},
};

use rcgen::{
    BasicConstraints, CertificateParams, CertificateSigningRequestParams, DnType, ExtendedKeyUsagePurpose,
    IsCa, Issuer, KeyPair, KeyUsagePurpose, PublicKeyData, SanType,
};
use rustls::pki_types::{CertificateDer, CertificateSigningRequestDer, pem::PemObject as _};
use time::OffsetDateTime;
use x509_parser::{certificate::X509Certificate, prelude::FromDer as _};

use super::{Identity, Membership, NewKey, Principal, Role, TrustError, check_name, read_text, write_secret};

/// How long an authority lives: ten years.
const LIFETIME: Duration = Duration::from_secs(3_650 * 86_400);
/// Certificates are valid from a little before they are made: clocks of a farm differ.
const CLOCK_SLACK: Duration = Duration::from_secs(3_600);

/// The key that a farm's identities are signed with, and its certificate.
pub struct Authority {
    farm: String,
    certificate: CertificateDer<'static>,
    key: KeyPair,
    issuer: Issuer<'static, KeyPair>,
}

impl fmt::Debug for Authority {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Authority").field(&self.farm).finish()
    }
}

impl Authority {
    /// A new authority for a farm of this name.
    ///
    /// # Errors
    /// The name is not one, or the system gives no randomness.
    pub fn create(farm: &str) -> Result<Self, TrustError> {
        check_name("farm", farm)?;
        let key = KeyPair::generate()?;
        let mut params = validity(CertificateParams::default(), LIFETIME);
        params.distinguished_name.push(DnType::CommonName, farm);
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign];
        let certificate = params.self_signed(&key)?.der().clone();
        Self::of(certificate, &key.serialize_pem())
    }

    fn of(certificate: CertificateDer<'static>, key: &str) -> Result<Self, TrustError> {
        let farm = common_name(&certificate)?;
        check_name("farm", &farm)?;
        let issuer = Issuer::from_ca_cert_der(&certificate, KeyPair::from_pem(key)?)?;
        Ok(Self { farm, certificate, key: KeyPair::from_pem(key)?, issuer })
    }

    /// Reads an authority's file.
    ///
    /// # Errors
    /// There is none, or it holds something else; the error names the file.
    pub fn read(path: &Path) -> Result<Self, TrustError> {
        let text = read_text(path)?;
        let certificate = CertificateDer::from_pem_slice(text.as_bytes())
            .map_err(|error| TrustError::garbled(path, format!("holds no certificate: {error}")))?;
        let key =
            private_key_block(&text).ok_or_else(|| TrustError::garbled(path, "holds no private key"))?;
        Self::of(certificate, key).map_err(|error| TrustError::garbled(path, error))
    }

    /// Writes it, readable by its owner alone.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), TrustError> {
        let note = format!("The authority of the farm {}. Whoever has this file owns the farm.\n", self.farm);
        write_secret(
            path,
            &format!("{note}{}{}", self.key.serialize_pem(), pem_certificate(&self.certificate)),
        )
    }

    /// The farm's name.
    #[must_use]
    pub fn farm(&self) -> &str {
        &self.farm
    }

    /// blake3 of the certificate: what join tokens carry.
    #[must_use]
    pub fn fingerprint(&self) -> [u8; 32] {
        *blake3::hash(&self.certificate).as_bytes()
    }

    /// A membership for the key of a signing request, which proves that who asks has the key. What else the request says is
    /// not believed.
    ///
    /// # Errors
    /// The request is not one, or the name is not one.
    pub fn admit(
        &self,
        role: Role,
        name: &str,
        request_der: &[u8],
        lifetime: Duration,
    ) -> Result<Membership, TrustError> {
        let request = CertificateSigningRequestDer::from(request_der.to_vec());
        let request = CertificateSigningRequestParams::from_der(&request)
            .map_err(|error| TrustError::Invalid(format!("not a certificate signing request: {error}")))?;
        self.issue(role, name, &request.public_key, lifetime)
    }

    /// An identity with a key of its own, made here: the coordinator's, and the first operator's.
    ///
    /// # Errors
    /// The name is not one, or the system gives no randomness.
    pub fn identity(&self, role: Role, name: &str, lifetime: Duration) -> Result<Identity, TrustError> {
        let key = NewKey::generate()?;
        let membership = self.admit(role, name, &key.request()?, lifetime)?;
        key.join(&membership)
    }

    fn issue(
        &self,
        role: Role,
        name: &str,
        public_key: &impl PublicKeyData,
        lifetime: Duration,
    ) -> Result<Membership, TrustError> {
        let principal = Principal::new(&self.farm, role, name)?;
        let uri = principal.to_string().try_into()?;
        let mut params = validity(CertificateParams::default(), lifetime);
        params.distinguished_name.push(DnType::CommonName, name);
        params.subject_alt_names = vec![SanType::URI(uri)];
        params.is_ca = IsCa::ExplicitNoCa;
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        params.use_authority_key_identifier_extension = true;
        let certificate = params.signed_by(public_key, &self.issuer)?;
        Ok(Membership {
            certificate_der: certificate.der().to_vec(),
            authority_der: self.certificate.to_vec(),
        })
    }
}

fn validity(mut params: CertificateParams, lifetime: Duration) -> CertificateParams {
    let now = SystemTime::now();
    params.not_before = OffsetDateTime::from(now - CLOCK_SLACK);
    params.not_after = OffsetDateTime::from(now + lifetime);
    params
}

fn common_name(certificate: &CertificateDer<'_>) -> Result<String, TrustError> {
    let wrong = |reason: String| TrustError::Invalid(format!("not a farm's authority: {reason}"));
    let (_, parsed) = X509Certificate::from_der(certificate).map_err(|error| wrong(error.to_string()))?;
    let name = parsed.subject().iter_common_name().next().and_then(|name| name.as_str().ok());
    name.map(str::to_owned).ok_or_else(|| wrong("it has no name".to_owned()))
}

/// The text of the private key in a PEM file.
pub(super) fn private_key_block(text: &str) -> Option<&str> {
    const END: &str = "-----END PRIVATE KEY-----";
    let from = text.find("-----BEGIN PRIVATE KEY-----")?;
    let to = from + text[from..].find(END)? + END.len();
    Some(&text[from..to])
}

pub(super) fn pem_certificate(der: &[u8]) -> String {
    pem::encode(&pem::Pem::new("CERTIFICATE", der))
}
