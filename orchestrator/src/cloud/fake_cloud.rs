//! A cloud for tests: TLS on this machine, with the answers that a test gives.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use gleaner_fleet::{Body, Frame, Reported};
use rcgen::{CertificateParams, KeyPair};
use rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};
use rustls::{ClientConfig, RootCertStore, ServerConfig};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::time::timeout;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;
use tokio_tungstenite::tungstenite::protocol::Role;

use super::http::CloudHttp;
use super::settings::{CloudSettings, FRAGMENT_MAX};

const DEADLINE: Duration = Duration::from_secs(60);

/// Waits for something that must come.
pub(super) async fn soon<T>(event: impl Future<Output = T>) -> T {
    timeout(DEADLINE, event).await.expect("it comes within the deadline")
}

pub(super) struct FakeCloud {
    pub(super) http: CloudHttp,
    /// Those of a vehicle that is enrolled there.
    pub(super) settings: CloudSettings,
    listener: TcpListener,
    acceptor: TlsAcceptor,
}

pub(super) struct FakeConnection(TlsStream<TcpStream>);

pub(super) struct ControlChannel(WebSocketStream<TlsStream<TcpStream>>);

/// Answers by path: each a head and a body.
pub(super) type FakeAnswers = Arc<Mutex<BTreeMap<String, (String, Vec<u8>)>>>;

impl FakeCloud {
    pub(super) async fn start() -> Self {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec!["127.0.0.1".to_owned()]).unwrap();
        let certificate = params.self_signed(&key).unwrap();
        let (pem, key_pem) = (certificate.pem(), key.serialize_pem());
        let certificate = certificate.der().clone();
        let key = PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(key.serialize_der()));
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let server = ServerConfig::builder_with_provider(Arc::clone(&provider))
            .with_protocol_versions(&[&rustls::version::TLS13])
            .unwrap()
            .with_no_client_auth()
            .with_single_cert(vec![certificate.clone()], key)
            .unwrap();
        let mut roots = RootCertStore::empty();
        roots.add(certificate).unwrap();
        let mut tls = ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&rustls::version::TLS13])
            .unwrap()
            .with_root_certificates(roots)
            .with_no_client_auth();
        tls.max_fragment_size = FRAGMENT_MAX;
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let http = CloudHttp::new(address.clone(), Arc::new(tls));
        let settings = CloudSettings {
            address,
            authority: pem.clone(),
            certificate: pem,
            key: key_pem,
            renew: u64::MAX,
            expires: u64::MAX,
        };
        Self { http, settings, listener, acceptor: TlsAcceptor::from(Arc::new(server)) }
    }

    /// Accepts the next connection that does not end before it is open.
    pub(super) async fn accept(&self) -> FakeConnection {
        loop {
            let (stream, _) = self.listener.accept().await.unwrap();
            if let Ok(stream) = self.acceptor.accept(stream).await {
                return FakeConnection(stream);
            }
        }
    }

    /// Serves answers, and 404 without one; returns the control channels as vehicles open them.
    pub(super) fn serve(self, answers: FakeAnswers) -> UnboundedReceiver<ControlChannel> {
        let (opened, channels) = unbounded_channel();
        tokio::spawn(async move {
            loop {
                let mut connection = self.accept().await;
                let (opened, answers) = (opened.clone(), Arc::clone(&answers));
                tokio::spawn(async move {
                    while let Some(request) = connection.request().await {
                        let path = request.split(' ').nth(1).unwrap().to_owned();
                        if path == "/v1/link" {
                            let _ = opened.send(connection.upgrade(&request).await);
                            return;
                        }
                        let found = answers.lock().unwrap().get(&path).cloned();
                        let missing = || ("404 Not Found\r\ncontent-length: 0".to_owned(), vec![]);
                        let (head, body) = found.unwrap_or_else(missing);
                        connection.answer(&head, &body).await;
                        if !head.contains("content-length") {
                            return connection.close().await;
                        }
                    }
                });
            }
        });
        channels
    }
}

impl FakeConnection {
    /// Receives a request, and returns its head and body; `None` at the end of the connection.
    pub(super) async fn request(&mut self) -> Option<String> {
        let (head, body, is_whole) = self.request_so_far().await?;
        is_whole.then(|| head + &String::from_utf8_lossy(&body))
    }

    /// Receives a request, as far as it comes: its head, its body, and whether that is whole.
    pub(super) async fn request_so_far(&mut self) -> Option<(String, Vec<u8>, bool)> {
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            head.push(self.0.read_u8().await.ok()?);
        }
        let head = String::from_utf8(head).unwrap();
        let length = head.lines().find_map(|line| line.strip_prefix("content-length: "));
        let (length, mut body) = (length.map_or(0, |it| it.parse().unwrap()), Vec::new());
        while body.len() < length && self.0.read_buf(&mut body).await.is_ok_and(|read| read > 0) {}
        let is_whole = body.len() == length;
        Some((head, body, is_whole))
    }

    pub(super) async fn answer(&mut self, head: &str, body: &[u8]) {
        let answer = [format!("HTTP/1.1 {head}\r\n\r\n").as_bytes(), body].concat();
        // A vehicle that refuses it closes the connection.
        let _ = self.0.write_all(&answer).await;
    }

    pub(super) async fn close(&mut self) {
        let _ = self.0.shutdown().await;
    }

    async fn upgrade(mut self, request: &str) -> ControlChannel {
        let key = request.lines().find_map(|line| line.strip_prefix("Sec-WebSocket-Key: "));
        let accepted = derive_accept_key(key.unwrap().as_bytes());
        let head = format!(
            "101 Switching Protocols\r\nconnection: Upgrade\r\nupgrade: websocket\r\n\
             sec-websocket-accept: {accepted}"
        );
        self.answer(&head, b"").await;
        ControlChannel(WebSocketStream::from_raw_socket(self.0, Role::Server, None).await)
    }
}

impl ControlChannel {
    pub(super) async fn send(&mut self, body: Body) {
        self.send_message(Message::Binary(Frame::encoded(body).into())).await;
    }

    pub(super) async fn send_message(&mut self, message: Message) {
        // A vehicle that refuses it closes the connection.
        let _ = soon(self.0.send(message)).await;
    }

    /// Waits for the first frame for which `found` returns something.
    pub(super) async fn until<T>(&mut self, found: impl Fn(Body) -> Option<T>) -> T {
        loop {
            let message = soon(self.0.next()).await.expect("the connection is open").unwrap();
            if let Message::Binary(bytes) = message
                && let Some(found) = Frame::decoded(&bytes).unwrap().body.and_then(&found)
            {
                return found;
            }
        }
    }

    pub(super) async fn reported(&mut self, generation: u64) -> Reported {
        let is_of = |body| match body {
            Body::Reported(reported) if reported.generation == generation => Some(reported),
            _ => None,
        };
        self.until(is_of).await
    }
}
