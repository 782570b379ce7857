//! The enrolment that a vehicle keeps: where the cloud is, and who the vehicle is there.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use gleaner_base::{Exit, Failure};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use rustls::time_provider::TimeProvider;
use rustls::{ClientConfig, RootCertStore};
use serde::{Deserialize, Serialize};

use crate::orchestrator::Orchestrator;

/// Longest record of TLS: a connection that breaks loses the one that is on its way.
pub(super) const FRAGMENT_MAX: Option<usize> = Some(4 << 10);

/// The enrolment. It has the key of the vehicle at the cloud, which signs nothing else.
#[derive(Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CloudSettings {
    /// Address of the cloud for vehicles: `HOST:PORT`.
    pub(super) address: String,
    /// The certificate of the authority that signs the cloud's, as PEM.
    pub(super) authority: String,
    /// The certificate of the vehicle, as PEM.
    pub(super) certificate: String,
    /// Its private key, as PEM.
    pub(super) key: String,
    /// Time from which the next certificate is requested, in s since 1970.
    pub(super) renew: u64,
    /// End of the certificate, in s since 1970.
    pub(super) expires: u64,
}

/// Without the key.
impl fmt::Debug for CloudSettings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("CloudSettings").field("address", &self.address).finish_non_exhaustive()
    }
}

/// The trusted time of the vehicle: that of its clock may be wrong after a start.
struct TrustedClock(Arc<Orchestrator>);

impl fmt::Debug for TrustedClock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("TrustedClock")
    }
}

impl TimeProvider for TrustedClock {
    fn current_time(&self) -> Option<UnixTime> {
        let now = self.0.trust(|trust| trust.now());
        Some(UnixTime::since_unix_epoch(Duration::from_secs(now)))
    }
}

/// Returns the settings of TLS: version 1.3, only the authority of the cloud, and the certificate
/// of the vehicle once it has one.
pub(super) fn tls(
    core: &Arc<Orchestrator>,
    authority: &str,
    identity: Option<(&str, &str)>,
) -> Result<Arc<ClientConfig>, Failure> {
    let unusable = |what: &'static str| {
        move |error: &dyn std::fmt::Display| {
            let mut failure = Failure::new(Exit::Usage, format!("cannot use the {what}"));
            failure.causes = vec![error.to_string()];
            failure.with_help("enrol the vehicle again: `gleaner enrol FILE`")
        }
    };
    let mut roots = RootCertStore::empty();
    for certificate in CertificateDer::pem_slice_iter(authority.as_bytes()) {
        let bad = unusable("certificate of the cloud's authority");
        let certificate = certificate.map_err(|error| bad(&error))?;
        roots.add(certificate).map_err(|error| bad(&error))?;
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let clock = Arc::new(TrustedClock(Arc::clone(core)));
    let builder = ClientConfig::builder_with_details(provider, clock)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(|error| unusable("settings of TLS")(&error))?
        .with_root_certificates(roots);
    let mut config = match identity {
        None => builder.with_no_client_auth(),
        Some((certificate, key)) => {
            let bad = unusable("certificate of this vehicle");
            let chain = CertificateDer::pem_slice_iter(certificate.as_bytes());
            let chain = chain.collect::<Result<Vec<_>, _>>().map_err(|error| bad(&error))?;
            let key = PrivateKeyDer::from_pem_slice(key.as_bytes()).map_err(|error| bad(&error))?;
            builder.with_client_auth_cert(chain, key).map_err(|error| bad(&error))?
        }
    };
    config.max_fragment_size = FRAGMENT_MAX;
    Ok(Arc::new(config))
}
