//! Connections of untrusted peers, and of clients among them.

use axum::routing::get;
use futures_util::stream;
use rcgen::{CertificateParams, KeyPair};
use rustls::crypto::ring;
use rustls::pki_types::{PrivateKeyDer, ServerName};
use rustls::version::TLS13;
use rustls::{ClientConfig, RootCertStore};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, UnixListener, UnixStream};
use tokio_rustls::TlsConnector;

use super::*;

/// Returns an entrance for `/` and, without an end, `/follow`; and what stops it.
fn entrance<L: Listener<Addr: Into<ClientNetwork>>>(
    listener: L,
    most: usize,
) -> (BoundedListener<L>, watch::Sender<bool>) {
    let follow = async || {
        let first = stream::iter([Ok::<_, std::io::Error>("first")]);
        Body::from_stream(futures_util::StreamExt::chain(first, stream::pending()))
    };
    let router = Router::new().route("/", get(async || "ok")).route("/follow", get(follow));
    let (stop, stopped) = watch::channel(false);
    (BoundedListener::plain(listener, ("connections", most), router, stopped), stop)
}

async fn tcp() -> (TcpListener, std::net::SocketAddr) {
    let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
    let address = listener.local_addr().unwrap();
    (listener, address)
}

async fn begin(stream: &mut (impl AsyncRead + AsyncWrite + Unpin), path: &str) -> String {
    let request = format!("GET {path} HTTP/1.1\r\nhost: cloud\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = [0; 15];
    stream.read_exact(&mut answer).await.unwrap();
    String::from_utf8_lossy(&answer).into_owned()
}

#[tokio::test]
async fn idle_connections_end_for_new_ones_and_requests_go_on() {
    let (listener, address) = tcp().await;
    let (entrance, stop) = entrance(listener, 3);
    let serving = tokio::spawn(entrance.serve());
    let open = || TcpStream::connect(address);
    let mut follower = open().await.unwrap();
    assert_eq!(begin(&mut follower, "/follow").await, "HTTP/1.1 200 OK");
    let mut kept = open().await.unwrap();
    assert_eq!(begin(&mut kept, "/").await, "HTTP/1.1 200 OK");
    // One with half a request has no request yet, and ends before one that has had an answer.
    let mut slow = open().await.unwrap();
    slow.write_all(b"GET / HTTP/1.1\r\n").await.unwrap();
    let mut other = open().await.unwrap();
    assert_eq!(begin(&mut other, "/").await, "HTTP/1.1 200 OK");
    assert_eq!(slow.read(&mut [0]).await.unwrap_or(0), 0, "the silent one has ended");
    let mut next = open().await.unwrap();
    assert_eq!(begin(&mut next, "/").await, "HTTP/1.1 200 OK");
    let mut rest = Vec::new();
    assert!(kept.read_to_end(&mut rest).await.is_ok(), "the oldest idle one has ended");
    // With requests in progress only, further ones are refused.
    for stream in [&mut other, &mut next] {
        let mut rest = [0; 4096];
        assert!(stream.read(&mut rest).await.unwrap() > 0);
        assert_eq!(begin(stream, "/follow").await, "HTTP/1.1 200 OK");
    }
    assert_eq!(open().await.unwrap().read(&mut [0]).await.unwrap_or(0), 0);
    drop((other, next, follower));
    stop.send_replace(true);
    serving.await.unwrap();
}

/// Returns the TLS settings of a server, and those of a client that trusts it.
fn tls() -> (watch::Receiver<Arc<ServerConfig>>, TlsConnector) {
    let provider = Arc::new(ring::default_provider());
    let key = KeyPair::generate().unwrap();
    let params = CertificateParams::new(["localhost".to_owned()]).unwrap();
    let certificate = params.self_signed(&key).unwrap().der().clone();
    let mut roots = RootCertStore::empty();
    roots.add(certificate.clone()).unwrap();
    let key = PrivateKeyDer::Pkcs8(key.serialize_der().into());
    let server = ServerConfig::builder_with_provider(Arc::clone(&provider));
    let server = server.with_protocol_versions(&[&TLS13]).unwrap().with_no_client_auth();
    let server = server.with_single_cert(vec![certificate], key).unwrap();
    let client = ClientConfig::builder_with_provider(provider);
    let client = client.with_protocol_versions(&[&TLS13]).unwrap();
    let client = client.with_root_certificates(roots).with_no_client_auth();
    (watch::channel(Arc::new(server)).1, TlsConnector::from(Arc::new(client)))
}

#[tokio::test]
async fn connections_without_a_first_record_hold_no_turn() {
    let (listener, address) = tcp().await;
    let (tls, connector) = tls();
    let (entrance, _stop) = entrance(listener, 100);
    tokio::spawn(BoundedListener { tls: Some(tls), known: 1, ..entrance }.serve());
    let mut strangers = Vec::new();
    for number in 0..4 * HANDSHAKES {
        let mut stranger = TcpStream::connect(address).await.unwrap();
        // Half of them send the begin of a record of 512 bytes.
        let begin: &[u8] = if number % 2 == 0 { &[] } else { &[22, 3, 1, 2, 0, 1, 0] };
        stranger.write_all(begin).await.unwrap();
        strangers.push(stranger);
    }
    let stream = TcpStream::connect(address).await.unwrap();
    let name = ServerName::try_from("localhost").unwrap();
    // Without an end of its own: if they held turns, it would come after an hour.
    let vehicle = timeout(Duration::from_secs(60), connector.connect(name, stream)).await;
    let mut vehicle = vehicle.expect("the handshake had no turn").unwrap();
    assert_eq!(begin(&mut vehicle, "/").await, "HTTP/1.1 200 OK");
    drop(strangers);
}

/// Sends the begin of headers; returns the answer and waits for the end of the connection.
async fn stuffed(stream: &mut (impl AsyncRead + AsyncWrite + Unpin), bytes: usize) -> String {
    let begin = format!("GET / HTTP/1.1\r\nhost: cloud\r\nx: {}", "x".repeat(bytes));
    // It may end before it has taken all of them.
    let _ = stream.write_all(begin.as_bytes()).await;
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer).await;
    String::from_utf8_lossy(&answer).into_owned()
}

#[tokio::test]
async fn long_headers_are_refused_and_slow_ones_end_on_each_socket() {
    let folder = tempfile::tempdir().unwrap();
    let brief = Duration::from_millis(50);
    for (headers, bytes, expected) in [(HEADERS, 20 << 10, "HTTP/1.1 431 "), (brief, 1000, "")] {
        let (listener, address) = tcp().await;
        let (over_tcp, _stop) = entrance(listener, 8);
        tokio::spawn(BoundedListener { headers, ..over_tcp }.serve());
        let path = folder.path().join(bytes.to_string());
        let (local, _stop) = entrance(UnixListener::bind(&path).unwrap(), 8);
        tokio::spawn(BoundedListener { headers, ..local }.serve());
        let over_tcp = stuffed(&mut TcpStream::connect(address).await.unwrap(), bytes).await;
        let local = stuffed(&mut UnixStream::connect(&path).await.unwrap(), bytes).await;
        for answer in [over_tcp, local] {
            assert!(answer.starts_with(expected), "{answer}");
            assert_eq!(answer.is_empty(), expected.is_empty(), "{answer}");
        }
    }
}
