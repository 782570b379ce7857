//! Certificates of simulated vehicles, by the requests that real ones send.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use gleaner_fleet::{EnrolReply, EnrolRequest, Enrolment};
use http_body_util::Full;
use hyper::Request;
use hyper::body::Bytes;
use hyper::client::conn::http1::SendRequest;
use rcgen::{CertificateParams, KeyPair};
use rustls::client::Resumption;
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use tokio::net::{TcpSocket, TcpStream};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

use crate::administrator::{answer, requests, send};

/// The key of all vehicles, with a request for a certificate: the cloud takes the names of vehicles
/// from their enrolments.
pub struct FleetKey {
    key: KeyPair,
    csr: String,
    provider: Arc<CryptoProvider>,
}

/// The means of a vehicle to connect.
#[derive(Clone)]
pub struct SimulatedIdentity {
    pub name: String,
    tls: Arc<ClientConfig>,
    /// The own address: a range of ports for each four thousandth of the fleet.
    source: Ipv4Addr,
}

impl FleetKey {
    /// Makes a key.
    pub fn generate() -> Result<Self, String> {
        let failed = |error: rcgen::Error| error.to_string();
        let key = KeyPair::generate().map_err(failed)?;
        let params = CertificateParams::new(Vec::new()).map_err(failed)?;
        let csr = params.serialize_request(&key).and_then(|csr| csr.pem()).map_err(failed)?;
        Ok(Self { key, csr, provider: Arc::new(ring::default_provider()) })
    }

    /// Enrols a vehicle, the `index`th of the fleet.
    pub async fn enrol(
        &self,
        index: usize,
        enrolment: Enrolment,
    ) -> Result<SimulatedIdentity, String> {
        let Enrolment { address, vehicle, authority, token, .. } = enrolment;
        let last = u8::try_from(index / 4000 % 250).unwrap_or(0) + 1;
        let source = Ipv4Addr::new(127, 0, 0, last);
        let stranger =
            SimulatedIdentity { name: vehicle.clone(), tls: self.tls(&authority, None)?, source };
        let request = EnrolRequest { vehicle, token, csr: self.csr.clone() };
        let body = serde_json::to_vec(&request).map_err(|error| error.to_string())?;
        let request = Request::post("/v1/enrol").header("host", "cloud");
        let request =
            request.body(Full::new(Bytes::from(body))).map_err(|error| error.to_string())?;
        let address = address.parse().map_err(|_| format!("`{address}` is no address"))?;
        let (status, answer) = send(stranger.connect(address).await?, request).await?;
        if !status.is_success() {
            return Err(format!("an enrolment: {status} {}", String::from_utf8_lossy(&answer)));
        }
        let reply: EnrolReply =
            serde_json::from_slice(&answer).map_err(|error| error.to_string())?;
        let tls = self.tls(&authority, Some(&reply.certificate))?;
        Ok(SimulatedIdentity { tls, ..stranger })
    }

    fn tls(&self, authority: &str, own: Option<&str>) -> Result<Arc<ClientConfig>, String> {
        let failed = |error: rustls::Error| error.to_string();
        let parsed = |pem: &str| {
            CertificateDer::from_pem_slice(pem.as_bytes()).map_err(|error| error.to_string())
        };
        let mut roots = RootCertStore::empty();
        roots.add(parsed(authority)?).map_err(failed)?;
        let builder = ClientConfig::builder_with_provider(Arc::clone(&self.provider))
            .with_protocol_versions(&[&rustls::version::TLS13])
            .map_err(failed)?
            .with_root_certificates(roots);
        let mut config = match own {
            None => builder.with_no_client_auth(),
            Some(own) => {
                let key = PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(self.key.serialize_der()));
                builder.with_client_auth_cert(vec![parsed(own)?], key).map_err(failed)?
            }
        };
        // Real vehicles begin with a full handshake, too, and fetch files after a shorter one.
        config.resumption = Resumption::in_memory_sessions(1);
        Ok(Arc::new(config))
    }
}

impl SimulatedIdentity {
    /// Connects to the cloud.
    pub async fn connect(&self, address: SocketAddr) -> Result<TlsStream<TcpStream>, String> {
        let failed = |error: std::io::Error| error.to_string();
        let socket = TcpSocket::new_v4().map_err(failed)?;
        socket.set_reuseaddr(true).map_err(failed)?;
        socket.bind((self.source, 0).into()).map_err(failed)?;
        let stream = socket.connect(address).await.map_err(failed)?;
        stream.set_nodelay(true).map_err(failed)?;
        let name = ServerName::from(std::net::IpAddr::from(Ipv4Addr::LOCALHOST));
        let connector = TlsConnector::from(Arc::clone(&self.tls));
        connector.connect(name, stream).await.map_err(failed)
    }

    /// Fetches what is under a path, over a connection that lasts for all files of a desired state.
    pub async fn get(
        &self,
        files: &mut Option<SendRequest<Full<Bytes>>>,
        address: SocketAddr,
        path: &str,
    ) -> Result<Bytes, String> {
        let request = Request::get(path).header("host", "cloud").body(Full::default());
        let request = request.map_err(|error| error.to_string())?;
        if files.is_none() {
            *files = Some(requests(self.connect(address).await?).await?);
        }
        let files = files.as_mut().ok_or("there is no connection")?;
        let (status, body) = answer(files, request).await?;
        match status.is_success() {
            true => Ok(body),
            false => Err(format!("{path}: {status} {}", String::from_utf8_lossy(&body))),
        }
    }
}
