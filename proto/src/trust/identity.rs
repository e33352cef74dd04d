//! An identity as its owner holds it: key, certificate, and the authority that everyone else is checked against. The
//! certificate can be renewed while connections use it.

use std::{
    env, fmt,
    path::{Path, PathBuf},
    sync::{Arc, PoisonError, RwLock},
    time::{Duration, SystemTime},
};

use rcgen::{CertificateParams, KeyPair, SigningKey as _};
use rustls::{
    SignatureScheme,
    client::ResolvesClientCert,
    crypto::ring::sign::any_ecdsa_type,
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject as _},
    server::{ClientHello, ResolvesServerCert},
    sign::CertifiedKey,
};
use x509_parser::{certificate::X509Certificate, prelude::FromDer as _};

use super::{
    Member, Principal, TrustError,
    authority::{pem_certificate, private_key_block},
    read_text, unix_now, verify, write_secret,
};

/// What an authority gives to who joins.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Membership {
    /// Its certificate, DER.
    pub certificate_der: Vec<u8>,
    /// The authority's certificate, DER.
    pub authority_der: Vec<u8>,
}

/// A key before its owner has joined. The key never leaves the machine.
pub struct NewKey(KeyPair);

impl fmt::Debug for NewKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("NewKey")
    }
}

impl NewKey {
    /// # Errors
    /// The system gives no randomness.
    pub fn generate() -> Result<Self, TrustError> {
        Ok(Self(KeyPair::generate()?))
    }

    /// A certificate signing request, DER.
    ///
    /// # Errors
    /// It cannot be signed.
    pub fn request(&self) -> Result<Vec<u8>, TrustError> {
        Ok(CertificateParams::default().serialize_request(&self.0)?.der().to_vec())
    }

    /// The identity of this key, once it was admitted.
    ///
    /// # Errors
    /// The membership is for another key, or not signed by its authority.
    pub fn join(self, membership: &Membership) -> Result<Identity, TrustError> {
        Identity::of(self.0, membership, None)
    }
}

/// Who this process is in a secured farm. Cloneable; a renewal reaches every clone and every later connection.
#[derive(Clone)]
pub struct Identity(Arc<Inner>);

struct Inner {
    principal: Principal,
    key: KeyPair,
    authority: CertificateDer<'static>,
    current: RwLock<Current>,
    /// Where it was read from, and where a renewal is written to.
    path: Option<PathBuf>,
}

struct Current {
    certified: Arc<CertifiedKey>,
    not_before: u64,
    not_after: u64,
}

impl fmt::Debug for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Identity").field(&self.0.principal).finish()
    }
}

/// Two handles of one identity, or nothing alike.
impl PartialEq for Identity {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

impl Identity {
    fn of(key: KeyPair, membership: &Membership, path: Option<PathBuf>) -> Result<Self, TrustError> {
        let authority = CertificateDer::from(membership.authority_der.clone());
        let current = Current::of(&key, &membership.certificate_der, &authority)?;
        let principal = Member::of_certificate(&membership.certificate_der)?.principal;
        Ok(Self(Arc::new(Inner { principal, key, authority, current: RwLock::new(current), path })))
    }

    /// Reads an identity's file.
    ///
    /// # Errors
    /// There is none, it holds something else, or its certificate is over; the error names the file.
    pub fn read(path: &Path) -> Result<Self, TrustError> {
        let text = read_text(path)?;
        let garbled = |reason: String| TrustError::garbled(path, reason);
        let key = private_key_block(&text).ok_or_else(|| garbled("holds no private key".to_owned()))?;
        let key = KeyPair::from_pem(key).map_err(|error| garbled(format!("the private key: {error}")))?;
        let certificates: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(text.as_bytes()).collect();
        let certificates = certificates.map_err(|error| garbled(format!("the certificates: {error}")))?;
        let [certificate, authority] = certificates.as_slice() else {
            return Err(garbled(format!(
                "holds {} certificates, not its own and its authority's",
                certificates.len()
            )));
        };
        let membership =
            Membership { certificate_der: certificate.to_vec(), authority_der: authority.to_vec() };
        Self::of(key, &membership, Some(path.to_owned())).map_err(|error| garbled(error.to_string()))
    }

    /// Writes it, readable by its owner alone.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), TrustError> {
        let Inner { principal, key, authority, .. } = &*self.0;
        let certified = self.certified();
        let certificate = certified.cert.first().map_or(&[][..], |certificate| certificate);
        let note = format!("The identity {principal}. Keep it secret.\n");
        let certificates = format!("{}{}", pem_certificate(certificate), pem_certificate(authority));
        write_secret(path, &format!("{note}{}{certificates}", key.serialize_pem()))
    }

    /// Whose it is.
    #[must_use]
    pub fn principal(&self) -> &Principal {
        &self.0.principal
    }

    /// Whose it is, with its key.
    ///
    /// # Errors
    /// None: its certificate was read before.
    pub fn member(&self) -> Result<Member, TrustError> {
        let certified = self.certified();
        Member::of_certificate(certified.cert.first().map_or(&[][..], |certificate| certificate))
    }

    /// The authority's certificate, DER.
    pub(crate) fn authority(&self) -> &CertificateDer<'static> {
        &self.0.authority
    }

    /// When to renew it: two thirds of its life are over.
    #[must_use]
    pub fn renew_at(&self) -> SystemTime {
        let current = self.0.current.read().unwrap_or_else(PoisonError::into_inner);
        let life = current.not_after.saturating_sub(current.not_before);
        SystemTime::UNIX_EPOCH + Duration::from_secs(current.not_after - life / 3)
    }

    /// Whether its certificate is over.
    #[must_use]
    pub fn is_over(&self) -> bool {
        let current = self.0.current.read().unwrap_or_else(PoisonError::into_inner);
        current.not_after <= unix_now()
    }

    /// A signing request for a renewal, DER.
    ///
    /// # Errors
    /// It cannot be signed.
    pub fn request(&self) -> Result<Vec<u8>, TrustError> {
        Ok(CertificateParams::default().serialize_request(&self.0.key)?.der().to_vec())
    }

    /// Takes a renewed certificate into use, and writes it where the identity was read from.
    ///
    /// # Errors
    /// It is for another key or principal, or not of this authority; the old one stays. Or the file cannot be written; the
    /// new one is used.
    pub fn renew(&self, membership: &Membership) -> Result<(), TrustError> {
        if Member::of_certificate(&membership.certificate_der)?.principal != self.0.principal {
            return Err(TrustError::Invalid("the renewed certificate is somebody else's".to_owned()));
        }
        let renewed = Current::of(&self.0.key, &membership.certificate_der, &self.0.authority)?;
        *self.0.current.write().unwrap_or_else(PoisonError::into_inner) = renewed;
        self.0.path.as_deref().map_or(Ok(()), |path| self.write(path))
    }

    pub(crate) fn certified(&self) -> Arc<CertifiedKey> {
        let current = self.0.current.read().unwrap_or_else(PoisonError::into_inner);
        Arc::clone(&current.certified)
    }

    pub(crate) fn sign(&self, message: &[u8]) -> Result<Vec<u8>, TrustError> {
        Ok(self.0.key.sign(message)?)
    }
}

impl Current {
    fn of(
        key: &KeyPair,
        certificate: &[u8],
        authority: &CertificateDer<'static>,
    ) -> Result<Self, TrustError> {
        let wrong = |reason: &dyn fmt::Display| TrustError::Invalid(format!("the certificate: {reason}"));
        let certificate = CertificateDer::from(certificate.to_vec());
        let (not_before, not_after) = {
            let (_, parsed) = X509Certificate::from_der(&certificate).map_err(|error| wrong(&error))?;
            if parsed.public_key().subject_public_key.data.as_ref() != key.public_key_raw() {
                return Err(wrong(&"it is for another key"));
            }
            let seconds = |at: i64| u64::try_from(at).unwrap_or(0);
            let validity = parsed.validity();
            (seconds(validity.not_before.timestamp()), seconds(validity.not_after.timestamp()))
        };
        // Of its own time: one that is over says so when it is used, and is told from one that never was.
        let at = unix_now().clamp(not_before, not_after.max(not_before));
        verify::signed_by(&certificate, authority, SystemTime::UNIX_EPOCH + Duration::from_secs(at))
            .map_err(|error| wrong(&error))?;
        let private = PrivateKeyDer::try_from(key.serialize_der()).map_err(|error| wrong(&error))?;
        let signer = any_ecdsa_type(&private).map_err(|error| wrong(&error))?;
        let certified = Arc::new(CertifiedKey::new(vec![certificate, authority.clone()], signer));
        Ok(Self { certified, not_before, not_after: not_after.max(not_before) })
    }
}

impl ResolvesClientCert for Identity {
    fn resolve(&self, _hints: &[&[u8]], _schemes: &[SignatureScheme]) -> Option<Arc<CertifiedKey>> {
        Some(self.certified())
    }

    fn has_certs(&self) -> bool {
        true
    }
}

impl ResolvesServerCert for Identity {
    fn resolve(&self, _hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(self.certified())
    }
}

/// Where identities lie unless told otherwise: `gleaner/KIND.pem` in the user's configuration folder (XDG), with `KIND` `user` or
/// `node`. `None` for a process without a home.
#[must_use]
pub fn default_identity(kind: &str) -> Option<PathBuf> {
    let absolute = |variable| env::var_os(variable).map(PathBuf::from).filter(|path| path.is_absolute());
    let configuration =
        absolute("XDG_CONFIG_HOME").or_else(|| absolute("HOME").map(|home| home.join(".config")))?;
    Some(configuration.join("gleaner").join(format!("{kind}.pem")))
}
