//! Certificates: one authority signs the server's, another one those of vehicles. With one, a
//! vehicle could pass for the server.

use std::fs;
use std::io;
use std::net::IpAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use gleaner_base::{Exit, Failure, excerpt};
use gleaner_fleet::CERTIFICATE_NAME;
use rcgen::string::Ia5String;
use rcgen::{
    BasicConstraints, CertificateParams, CertificateSigningRequestParams, DistinguishedName,
    DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose, SanType,
};
use rustls::RootCertStore;
use rustls::ServerConfig;
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use rustls::server::WebPkiClientVerifier;

use crate::error::{CloudError, CloudResult};
use crate::folder::{DataFolder, write_private};
use crate::store::{Issued, now};

const DAY_S: u64 = 86_400;
/// Lifetime of the certificate of a vehicle, and its age from which the next one may be requested.
const VEHICLE_S: u64 = 30 * DAY_S;
const RENEW_S: u64 = 20 * DAY_S;
/// Lifetime of the server's certificate. A server makes one at its start, and then every 30 days.
/// Vehicles trust no time more than 366 days after their trust root or program, and a root may be
/// as much ahead itself: also after a clock that was wrong, it must not have expired for them.
const SERVER_S: u64 = 3 * 366 * DAY_S;
const AUTHORITY_S: u64 = 20 * 365 * DAY_S;
/// Begin of all certificates, in s since 1970: the year 2020. It depends on no clock, as one that
/// is ahead would make certificates that begin after it is right again.
const BEGIN_S: u64 = 1_577_836_800;

pub(crate) struct Authorities {
    server: Authority,
    vehicles: Authority,
}

struct Authority {
    pem: String,
    issuer: Issuer<'static, KeyPair>,
}

impl Authorities {
    /// Loads the authorities, or makes them at the first start.
    /// Fails if one of their files cannot be used.
    pub(crate) fn open(folder: &DataFolder) -> Result<Self, Failure> {
        let folder = folder.authorities();
        let open = |name: &str| {
            Authority::open(&folder, name).map_err(|error| {
                let action = format!("cannot open the authority `{}`", folder.join(name).display());
                Failure::caused_by(Exit::Internal, action, &error)
                    .with_help("restore the folder `ca` from a backup")
            })
        };
        Ok(Self { server: open("server")?, vehicles: open("vehicles")? })
    }

    /// Returns the certificate of the authority that signs the server's, as PEM.
    pub(crate) fn server_pem(&self) -> &str {
        &self.server.pem
    }

    /// Returns the SHA-256 of that certificate, to which the database belongs.
    pub(crate) fn digest(&self) -> String {
        gleaner_trust::sha256(self.server.pem.as_bytes()).to_string()
    }

    /// Makes the certificate of a vehicle from its request.
    /// Fails if the request cannot be used.
    pub(crate) fn issue(&self, vehicle: &str, csr: &str) -> CloudResult<Issued> {
        let refused = |error: rcgen::Error| {
            let help = "send a certificate request as PEM, with a key of ECDSA P-256";
            CloudError::usage("the request for a certificate is refused", help)
                .because(excerpt(&error.to_string()))
        };
        let mut request = CertificateSigningRequestParams::from_pem(csr).map_err(refused)?;
        // Nothing of the request counts but its key.
        request.params = params(vehicle, VEHICLE_S);
        let name = Ia5String::try_from(format!("{CERTIFICATE_NAME}{vehicle}")).map_err(refused)?;
        request.params.subject_alt_names = vec![SanType::URI(name)];
        request.params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        let certificate = request.signed_by(&self.vehicles.issuer).map_err(refused)?;
        let start = u64::try_from(now()).unwrap_or(0);
        Ok(Issued {
            certificate: certificate.pem(),
            sha256: gleaner_trust::sha256(certificate.der()).to_string(),
            renew: start + RENEW_S,
            expires: start + VEHICLE_S,
        })
    }

    /// Returns the TLS settings of the vehicles' listener, with a new certificate for `host`.
    /// Fails if `host` cannot be in a certificate.
    pub(crate) fn server_config(&self, host: &str) -> Result<Arc<ServerConfig>, Failure> {
        let failed = |error: &dyn std::error::Error| {
            let action = format!("cannot make a certificate for `{}`", excerpt(host));
            let mut failure = Failure::new(Exit::Usage, action);
            failure.causes = vec![error.to_string()];
            failure.with_help("name a host and a port with --name, as in cloud.example.org:8443")
        };
        let key = KeyPair::generate().map_err(|error| failed(&error))?;
        let mut params = params(host, SERVER_S);
        for name in [host, "localhost", "127.0.0.1"] {
            params.subject_alt_names.push(match name.parse::<IpAddr>() {
                Ok(address) => SanType::IpAddress(address),
                Err(_) => SanType::DnsName(name.try_into().map_err(|error| failed(&error))?),
            });
        }
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
        let certificate = params.signed_by(&key, &self.server.issuer);
        let certificate = certificate.map_err(|error| failed(&error))?;
        let key = PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(key.serialize_der()));
        self.tls(certificate.der().clone(), key).map_err(|error| failed(&*error))
    }

    fn tls(
        &self,
        certificate: CertificateDer<'static>,
        key: PrivateKeyDer<'static>,
    ) -> Result<Arc<ServerConfig>, Box<dyn std::error::Error>> {
        // Named, as rustls panics if a program links two.
        let provider: Arc<CryptoProvider> = Arc::new(ring::default_provider());
        let mut roots = RootCertStore::empty();
        roots.add(CertificateDer::from_pem_slice(self.vehicles.pem.as_bytes())?)?;
        let verifier =
            WebPkiClientVerifier::builder_with_provider(Arc::new(roots), Arc::clone(&provider))
                .allow_unauthenticated()
                .build()?;
        let mut config = ServerConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&rustls::version::TLS13])?
            .with_client_cert_verifier(verifier)
            .with_single_cert(vec![certificate], key)?;
        // A vehicle with an open channel fetches files by shorter handshakes. Whether its
        // certificate still counts is looked up for each request.
        config.ticketer = ring::Ticketer::new()?;
        Ok(Arc::new(config))
    }
}

impl Authority {
    fn open(folder: &Path, name: &str) -> io::Result<Self> {
        let (key_path, path) =
            (folder.join(format!("{name}.key")), folder.join(format!("{name}.pem")));
        if !path.exists() {
            let key = KeyPair::generate().map_err(io::Error::other)?;
            let mut params = params(&format!("gleaner {name}"), AUTHORITY_S);
            params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
            params.key_usages = vec![KeyUsagePurpose::KeyCertSign];
            let certificate = params.self_signed(&key).map_err(io::Error::other)?;
            // The certificate is last: with it, the authority is complete.
            write_private(&key_path, key.serialize_pem().as_bytes())?;
            write_private(&path, certificate.pem().as_bytes())?;
        }
        let key = KeyPair::from_pem(&fs::read_to_string(key_path)?).map_err(io::Error::other)?;
        let pem = fs::read_to_string(path)?;
        let issuer = Issuer::from_ca_cert_pem(&pem, key).map_err(io::Error::other)?;
        Ok(Self { pem, issuer })
    }
}

fn params(name: &str, lifetime_s: u64) -> CertificateParams {
    let begin = UNIX_EPOCH + Duration::from_secs(BEGIN_S);
    // A machine without a battery for its clock begins in 1970, and the authorities stay.
    let now = SystemTime::now().max(begin);
    let mut params = CertificateParams::default();
    params.distinguished_name = DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, name);
    params.not_before = begin.into();
    params.not_after = (now + Duration::from_secs(lifetime_s)).into();
    params.use_authority_key_identifier_extension = true;
    params
}

#[cfg(test)]
mod tests {
    use gleaner_trust::Floors;

    use super::*;

    #[test]
    fn the_certificate_of_the_cloud_survives_a_clock_that_was_wrong() {
        let (params, mut floors) = (params("cloud", SERVER_S), Floors::default());
        assert_eq!(params.not_before.unix_timestamp(), 1_577_836_800);
        let built = u64::try_from(now()).unwrap();
        // The signer of the trust root was a year ahead, and then a clock by more.
        for _ in 0..2 {
            let anchor = floors.now(0, built);
            floors.observe(anchor + AUTHORITY_S, anchor);
        }
        let expires = u64::try_from(params.not_after.unix_timestamp()).unwrap();
        // Also just before the next one is made.
        assert!(expires > floors.now(0, built) + 30 * DAY_S);
        assert!(floors.now(0, built) >= built + 2 * 366 * DAY_S);
    }
}
