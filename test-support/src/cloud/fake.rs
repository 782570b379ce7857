//! A person and a vehicle, as far as the cloud sees them.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use gleaner_fleet::{
    Body, Cursor, Desired, EnrolReply, EnrolRequest, Enrolment, Frame, Hello, Ping, Welcome,
};
use gleaner_trust::{Deployment, Grants, Revision, RevisionFile, SecretKey, seal, sha256};
use http_body_util::{BodyExt, Full};
use hyper::body::{Bytes, Incoming};
use hyper::client::conn::http1;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use rcgen::{CertificateParams, KeyPair};
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use serde_json::{Value, json};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::{self, Message};

const DEADLINE: Duration = Duration::from_secs(30);

/// Waits for something that must come.
pub async fn soon<T>(event: impl Future<Output = T>) -> T {
    timeout(DEADLINE, event).await.expect("nothing came within the deadline")
}

async fn send<S: AsyncRead + AsyncWrite + Unpin + Send + 'static>(
    stream: S,
    request: Request<Full<Bytes>>,
) -> hyper::Result<Response<Incoming>> {
    let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await?;
    tokio::spawn(connection);
    sender.send_request(request).await
}

async fn whole(reply: Response<Incoming>) -> (StatusCode, Vec<u8>) {
    let status = reply.status();
    (status, soon(reply.into_body().collect()).await.unwrap().to_bytes().to_vec())
}

pub struct Person {
    address: SocketAddr,
    token: String,
}

impl Person {
    pub async fn login(address: SocketAddr, code: &str) -> Self {
        let stranger = Self { address, token: String::new() };
        let session = stranger.call(Method::POST, "/v1/login", json!({ "code": code })).await;
        Self { address, token: session["token"].as_str().unwrap().to_owned() }
    }

    /// Returns the same person, for a cloud at this address.
    pub fn at(&self, address: SocketAddr) -> Self {
        Self { address, token: self.token.clone() }
    }

    /// Sends a request; returns the answer as it begins.
    pub async fn open(&self, method: Method, path: &str, body: &[u8]) -> Response<Incoming> {
        self.open_with(method, path, &[], body).await
    }

    /// Sends a request with further headers; returns the answer as it begins.
    pub async fn open_with(
        &self,
        method: Method,
        path: &str,
        headers: &[(&str, &str)],
        body: &[u8],
    ) -> Response<Incoming> {
        let request = Request::builder()
            .method(method)
            .uri(path)
            .header("host", "cloud")
            .header("authorization", format!("Bearer {}", self.token));
        let request = headers.iter().fold(request, |request, (key, it)| request.header(*key, *it));
        let request = request.body(Full::new(Bytes::copy_from_slice(body))).unwrap();
        let stream = TcpStream::connect(self.address).await.unwrap();
        soon(send(stream, request)).await.unwrap()
    }

    /// Sends a request that must succeed; returns its JSON.
    pub async fn call(&self, method: Method, path: &str, body: Value) -> Value {
        let (status, text) =
            whole(self.open(method, path, body.to_string().as_bytes()).await).await;
        assert!(status.is_success(), "{path}: {status} {}", String::from_utf8_lossy(&text));
        serde_json::from_slice(&text).unwrap_or(Value::Null)
    }

    /// Returns a stream as server-sent events, from the one after `last` on.
    pub async fn events(&self, path: &str, last: Option<&str>) -> String {
        let last = last.map(|last| ("last-event-id", last));
        let headers: Vec<_> = [("accept", "text/event-stream")].into_iter().chain(last).collect();
        let (status, text) = whole(self.open_with(Method::GET, path, &headers, b"").await).await;
        assert_eq!(status, StatusCode::OK);
        String::from_utf8(text).unwrap()
    }

    pub async fn lines(&self, path: &str) -> Vec<String> {
        let (status, text) = whole(self.open(Method::GET, path, b"").await).await;
        assert_eq!(status, StatusCode::OK);
        String::from_utf8(text).unwrap().lines().map(str::to_owned).collect()
    }

    pub async fn enrol(&self, name: &str) -> (FakeVehicle, Enrolment) {
        let enrolment = self.call(Method::POST, "/v1/vehicles", json!({ "name": name })).await;
        let enrolment = Enrolment::parse(enrolment.to_string().as_bytes()).unwrap();
        let (status, vehicle) = FakeVehicle::enrol(&enrolment).await;
        assert_eq!(status, StatusCode::OK);
        (vehicle.unwrap(), enrolment)
    }

    /// Deploys, with the file if it is missing; returns the digest of the envelope.
    pub async fn deploy(&self, signed: &Signed) -> String {
        let reply = self.call(Method::POST, "/v1/deployments", signed.request()).await;
        if reply["result"] == "missing" {
            let object = format!("/v1/objects/{}", reply["objects"][0]["sha256"].as_str().unwrap());
            let refused = self.open(Method::PUT, &object, b"another").await.status();
            assert_eq!(refused, StatusCode::FORBIDDEN);
            let sent = self.open(Method::PUT, &object, &signed.file).await.status();
            assert_eq!(sent, StatusCode::NO_CONTENT);
            let reply = self.call(Method::POST, "/v1/deployments", signed.request()).await;
            assert_eq!(reply["result"], "accepted", "{reply}");
        }
        sha256(signed.deployment.as_bytes()).to_string()
    }

    pub async fn vehicle(&self, name: &str) -> Value {
        let all = self.call(Method::GET, "/v1/vehicles", Value::Null).await;
        all["items"].as_array().unwrap().iter().find(|it| it["name"] == name).unwrap().clone()
    }
}

/// A signed deployment of a lambda with one file.
pub struct Signed {
    pub deployment: String,
    pub revision: String,
    pub digest: String,
    pub file: Vec<u8>,
    fallback: Option<String>,
}

impl Signed {
    /// Signs one whose file has at least so many bytes.
    pub fn new(id: &str, release: u64, fallback: Option<&Self>, bytes: usize) -> Self {
        let key = SecretKey::generate().unwrap();
        let file = format!("[lambda]\nname = \"{id}\"\n{}", " ".repeat(bytes)).into_bytes();
        let revision = Revision {
            name: id.parse().unwrap(),
            version: format!("1.{release}.0").parse().unwrap(),
            kind: serde_json::from_value(json!("wasm")).unwrap(),
            release,
            created: 1_790_000_000,
            files: vec![RevisionFile {
                path: "lambda.toml".parse().unwrap(),
                bytes: file.len() as u64,
                sha256: sha256(&file),
            }],
        };
        let digest = sha256(&serde_json::to_vec(&revision).unwrap());
        let deployment = Deployment {
            id: id.parse().unwrap(),
            release,
            selector: [("fleet".parse().unwrap(), "test".to_owned())].into(),
            revision: digest.clone(),
            fallback: fallback.map(|it| it.digest.parse().unwrap()),
            config: [].into(),
            grants: Grants { topics: vec!["/imu".parse().unwrap()], ..Grants::default() },
            created: 1,
            expires: 2,
        };
        let text = |envelope: Vec<u8>| String::from_utf8(envelope).unwrap();
        Self {
            deployment: text(seal(&deployment, &[&key]).unwrap()),
            revision: text(seal(&revision, &[&key]).unwrap()),
            digest: digest.to_string(),
            file,
            fallback: fallback.map(|it| it.revision.clone()),
        }
    }

    pub fn request(&self) -> Value {
        let revisions: Vec<_> = std::iter::once(&self.revision).chain(&self.fallback).collect();
        json!({ "deployment": self.deployment, "revisions": revisions })
    }
}

pub struct FakeVehicle {
    pub address: String,
    config: Arc<ClientConfig>,
}

/// Returns the TLS settings of a vehicle, with a certificate or without.
fn config(authority: &str, certificate: Option<(&str, &KeyPair)>) -> Arc<ClientConfig> {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(authority.as_bytes()).unwrap()).unwrap();
    let builder = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_root_certificates(roots);
    Arc::new(match certificate {
        None => builder.with_no_client_auth(),
        Some((pem, key)) => {
            let chain = vec![CertificateDer::from_pem_slice(pem.as_bytes()).unwrap()];
            let key = PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(key.serialize_der()));
            builder.with_client_auth_cert(chain, key).unwrap()
        }
    })
}

async fn tls(address: &str, config: &Arc<ClientConfig>) -> TlsStream<TcpStream> {
    let stream = TcpStream::connect(address).await.unwrap();
    let name = ServerName::try_from("127.0.0.1").unwrap();
    soon(TlsConnector::from(Arc::clone(config)).connect(name, stream)).await.unwrap()
}

/// Returns a request for a certificate that asks for more than it gets.
pub fn csr(key: &KeyPair) -> String {
    let params = CertificateParams::new(vec!["another-vehicle".to_owned()]).unwrap();
    params.serialize_request(key).unwrap().pem().unwrap()
}

impl FakeVehicle {
    /// Enrols; returns the status of the answer.
    pub async fn enrol(enrolment: &Enrolment) -> (StatusCode, Option<Self>) {
        let Enrolment { address, vehicle, authority, token, .. } = enrolment.clone();
        let key = KeyPair::generate().unwrap();
        let request = EnrolRequest { vehicle, token, csr: csr(&key) };
        let request = serde_json::to_vec(&request).unwrap();
        let stranger = Self { address, config: config(&authority, None) };
        let (status, reply) = stranger.request(Method::POST, "/v1/enrol", &request).await;
        let reply = serde_json::from_slice::<EnrolReply>(&reply).ok();
        let config = reply.map(|it| config(&authority, Some((&it.certificate, &key))));
        (status, config.map(|config| Self { config, ..stranger }))
    }

    /// Sends a request with the certificate.
    pub async fn post(&self, path: &str, body: &impl serde::Serialize) -> StatusCode {
        self.request(Method::POST, path, &serde_json::to_vec(body).unwrap()).await.0
    }

    /// Fetches something with the certificate.
    pub async fn get(&self, path: &str) -> (StatusCode, Vec<u8>) {
        self.request(Method::GET, path, b"").await
    }

    /// Requests the control channel with these headers; returns the answer.
    pub async fn handshake(&self, headers: &[(&str, &str)]) -> Response<Incoming> {
        let request = Request::get("/v1/link").header("host", "cloud");
        let request =
            headers.iter().fold(request, |request, (name, value)| request.header(*name, *value));
        let request = request.body(Full::default()).unwrap();
        soon(send(self.stream().await, request)).await.unwrap()
    }

    pub async fn request(&self, method: Method, path: &str, body: &[u8]) -> (StatusCode, Vec<u8>) {
        whole(self.open(method, path, body).await).await
    }

    /// Sends a request with the certificate; returns the answer as it begins.
    pub async fn open(&self, method: Method, path: &str, body: &[u8]) -> Response<Incoming> {
        let body = Full::new(Bytes::copy_from_slice(body));
        let request = Request::builder().method(method).uri(path).header("host", "cloud");
        soon(send(self.stream().await, request.body(body).unwrap())).await.unwrap()
    }

    /// Opens a connection.
    pub async fn stream(&self) -> TlsStream<TcpStream> {
        tls(&self.address, &self.config).await
    }

    /// Returns the same vehicle, for a cloud at this address.
    pub fn at(&self, address: SocketAddr) -> Self {
        Self { address: address.to_string(), config: Arc::clone(&self.config) }
    }

    /// Opens the control channel up to the welcome and the first desired state.
    pub async fn connect(&self) -> (FakeLink, Welcome, Desired) {
        let mut link = self.link().await.expect("the control channel opens");
        let hello = Hello {
            protocol: gleaner_fleet::PROTOCOL,
            version: "1.2".to_owned(),
            key: "key".to_owned(),
            ..Hello::default()
        };
        link.send(Body::Hello(hello)).await;
        let Some(Body::Welcome(welcome)) = link.next().await else { panic!("no welcome") };
        let Some(Body::Desired(desired)) = link.next().await else { panic!("no desired state") };
        (link, welcome, desired)
    }

    pub async fn link(&self) -> Result<FakeLink, tungstenite::Error> {
        let stream = tls(&self.address, &self.config).await;
        let opened = tokio_tungstenite::client_async("ws://cloud/v1/link", stream);
        Ok(FakeLink(soon(opened).await?.0))
    }
}

/// The vehicle's side of the control channel.
pub struct FakeLink(WebSocketStream<TlsStream<TcpStream>>);

impl FakeLink {
    pub async fn send(&mut self, body: Body) {
        self.send_bytes(Frame::encoded(body)).await;
    }

    /// Sends bytes in the place of a frame. The other side may have ended the connection.
    pub async fn send_bytes(&mut self, bytes: Vec<u8>) {
        let _ = soon(self.0.send(Message::Binary(bytes.into()))).await;
    }

    /// Returns the next frame but signs of life and leases; `None` at the end.
    pub async fn next(&mut self) -> Option<Body> {
        loop {
            match self.next_of_all().await {
                Some(Body::Tail(_)) => {}
                body => return body,
            }
        }
    }

    /// Returns the streams of the next lease.
    pub async fn tail(&mut self) -> Vec<String> {
        loop {
            match self.next_of_all().await {
                Some(Body::Tail(tail)) => {
                    assert!((1..=gleaner_fleet::TAIL_S).contains(&tail.seconds), "{tail:?}");
                    return tail.streams;
                }
                Some(_) => {}
                None => panic!("the connection has ended"),
            }
        }
    }

    async fn next_of_all(&mut self) -> Option<Body> {
        loop {
            match soon(self.0.next()).await {
                Some(Ok(Message::Binary(bytes))) => match Frame::decoded(&bytes).unwrap().body {
                    Some(Body::Ping(_)) => {}
                    body => return body,
                },
                Some(Ok(Message::Close(_)) | Err(_)) | None => return None,
                Some(Ok(_)) => {}
            }
        }
    }

    /// Waits until the cloud has handled every frame so far.
    pub async fn settle(&mut self) {
        self.send(Body::Ping(Ping { number: 77 })).await;
        let pong = self.next().await;
        assert!(matches!(&pong, Some(Body::Pong(pong)) if pong.number == 77), "{pong:?}");
    }

    /// Waits for the end; returns its reason, if one was sent.
    pub async fn end(&mut self) -> Option<String> {
        let mut reason = None;
        while let Some(body) = self.next().await {
            if let Body::GoAway(away) = body {
                reason = Some(away.reason);
            }
        }
        reason
    }

    /// Sends records of events with these numbers, and waits until they are durable.
    pub async fn record(&mut self, seqs: std::ops::Range<u64>) {
        let line = |seq| {
            let line = json!({ "stream": "events", "seq": seq, "time_ns": 1, "boot_ns": seq,
                               "boot": "b", "kind": "event", "record": {} });
            format!("{line}\n")
        };
        let text: String = seqs.clone().map(line).collect();
        let lines = gleaner_fleet::compress(text.as_bytes());
        let stream = "events".to_owned();
        let records = gleaner_fleet::Records { stream, life: 1, next: seqs.end, lines };
        self.send(Body::Records(records)).await;
        let ack = self.next().await;
        assert!(matches!(&ack, Some(Body::Ack(ack)) if ack.next == seqs.end), "{ack:?}");
    }
}

/// Returns the position after such records.
pub fn cursor_after(next: u64) -> Cursor {
    let (stream, boot) = ("events".to_owned(), "b".to_owned());
    Cursor { stream, life: 1, next, seq: next - 1, boot, boot_ns: next - 1 }
}
