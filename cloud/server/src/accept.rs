//! Accepts connections, with TLS or without, within bounds of their number and of time.

use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes, HttpBody};
use hyper::body::{Frame, Incoming, SizeHint};
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper::{Request, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use rustls::ServerConfig;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::time::{sleep, timeout};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

use crate::clients::{OpenClient, OpenClients};
use crate::counts::COUNTS;

/// Maximum number of connections that begin at a time, up to the answer to the first request. After
/// a restart all vehicles come at once: with all of them in progress, each would take longer than
/// its time, and none would end. Their buffers, between what lives as long as a connection, would
/// also keep the heap at several times of what is in use.
const HANDSHAKES: usize = 256;
/// Time to wait for a handshake, which is as long as vehicles wait.
const HANDSHAKE_TURN: Duration = Duration::from_secs(30);
/// Time after which a handshake, and then the wait for the first answer, does not count any more:
/// those that stall keep no others out.
const HANDSHAKE_COUNTS: Duration = Duration::from_secs(1);
/// Time for a TLS handshake, and for the headers of a request.
const HANDSHAKE: Duration = Duration::from_secs(10);
const HEADERS: Duration = Duration::from_secs(30);
/// Time for an idle connection to end whose place another one needs.
const EVICTION: Duration = Duration::from_millis(100);
/// Time for open requests when the server stops.
const DRAIN: Duration = Duration::from_secs(10);

/// The other side of a connection; it counts as open as long as this lives.
#[derive(Debug)]
pub(crate) struct PeerConnection {
    /// SHA-256 of its certificate, which the authority of vehicles has signed.
    pub(crate) certificate: Option<String>,
    /// Its turn to begin, until its first answer.
    turn: Mutex<Option<OwnedSemaphorePermit>>,
    client: OpenClient,
    _slot: OwnedSemaphorePermit,
}

impl PeerConnection {
    /// Lets another connection begin.
    fn end_turn(&self) {
        drop(self.turn.lock().unwrap_or_else(PoisonError::into_inner).take());
    }
}

/// A listener and what serves its connections.
pub(crate) struct Entrance {
    pub(crate) listener: TcpListener,
    pub(crate) router: Router,
    /// The TLS settings; they change with the server's certificate.
    pub(crate) tls: Option<watch::Receiver<Arc<ServerConfig>>>,
    /// Maximum number of open connections.
    pub(crate) most: u32,
    /// Maximum number of those of one network other than this machine.
    pub(crate) most_of_one: u32,
    /// True if a proxy on this machine states the addresses of clients.
    pub(crate) is_behind_proxy: bool,
    pub(crate) stop: watch::Receiver<bool>,
}

impl Entrance {
    /// Accepts connections until the server stops, and then waits for the open ones.
    pub(crate) async fn serve(self) {
        let Self { listener, router, tls, most, most_of_one, is_behind_proxy, mut stop } = self;
        let things = if tls.is_some() { "vehicle connections" } else { "people connections" };
        let clients = OpenClients::new(things, most_of_one);
        let mut number = 0;
        let slots = Arc::new(Semaphore::new(most as usize));
        let handshakes = Arc::new(Semaphore::new(HANDSHAKES));
        let stopping = stop.clone();
        let stopped = async move {
            let _ = stop.wait_for(|is_stopping| *is_stopping).await;
        };
        tokio::pin!(stopped);
        loop {
            let accepted = tokio::select! {
                accepted = listener.accept() => accepted,
                () = &mut stopped => break,
            };
            let (stream, address) = match accepted {
                Ok(accepted) => accepted,
                Err(error) => {
                    // Without file descriptors, this would be repeated without a pause.
                    tracing::warn!(%error, "a connection cannot be accepted");
                    sleep(Duration::from_millis(100)).await;
                    continue;
                }
            };
            number += 1;
            let Some(client) = clients.open(address.ip(), number) else { continue };
            let Some(slot) = free_slot(&slots, &clients).await else {
                clients.refused();
                continue;
            };
            let tls = tls.as_ref().map(|tls| Handshake {
                acceptor: TlsAcceptor::from(Arc::clone(&tls.borrow())),
                turns: Arc::clone(&handshakes),
            });
            let (certificate, turn) = (None, Mutex::default());
            let peer = PeerConnection { certificate, turn, client, _slot: slot };
            let handler = RequestHandler { router: router.clone(), is_behind_proxy };
            tokio::spawn(connection(stream, tls, peer, handler, stopping.clone()));
        }
        drop(listener);
        if timeout(DRAIN, slots.acquire_many(most)).await.is_err() {
            tracing::warn!("connections were cut that did not end in time");
        }
    }
}

/// Returns a free slot: if there is none, that of an idle connection, which ends for it.
async fn free_slot(slots: &Arc<Semaphore>, clients: &OpenClients) -> Option<OwnedSemaphorePermit> {
    if let Ok(slot) = Arc::clone(slots).try_acquire_owned() {
        return Some(slot);
    }
    if !clients.end_one() {
        return None;
    }
    timeout(EVICTION, Arc::clone(slots).acquire_owned()).await.ok()?.ok()
}

/// A TLS handshake that is due.
struct Handshake {
    acceptor: TlsAcceptor,
    turns: Arc<Semaphore>,
}

impl Handshake {
    /// Returns the stream, and gives its turn to `peer`; `None` if the other side is too slow, or
    /// wrong.
    async fn done(self, stream: TcpStream, peer: &PeerConnection) -> Option<TlsStream<TcpStream>> {
        let turn = timeout(HANDSHAKE_TURN, self.turns.acquire_owned()).await.ok()?.ok()?;
        *peer.turn.lock().unwrap_or_else(PoisonError::into_inner) = Some(turn);
        let handshake = timeout(HANDSHAKE, self.acceptor.accept(stream));
        tokio::pin!(handshake);
        let accepted = match timeout(HANDSHAKE_COUNTS, handshake.as_mut()).await {
            Ok(accepted) => accepted,
            Err(_) => {
                peer.end_turn();
                handshake.await
            }
        };
        accepted.ok()?.ok()
    }
}

struct RequestHandler {
    router: Router,
    is_behind_proxy: bool,
}

async fn connection(
    stream: TcpStream,
    tls: Option<Handshake>,
    mut peer: PeerConnection,
    handler: RequestHandler,
    stop: watch::Receiver<bool>,
) {
    let _ = stream.set_nodelay(true);
    let Some(tls) = tls else {
        return requests(stream, peer, handler, stop).await;
    };
    // In a box, as a connection that waits or is upgraded does not need the room.
    let handshake = Box::pin(async {
        tokio::select! {
            stream = tls.done(stream, &peer) => stream,
            () = peer.client.ended() => None,
        }
    });
    let Some(stream) = handshake.await else {
        tracing::debug!(network = ?peer.client.network, "a TLS handshake failed");
        return;
    };
    let certificates = stream.get_ref().1.peer_certificates();
    let certificate = certificates.and_then(|all| all.first());
    peer.certificate = certificate.map(|it| gleaner_trust::sha256(it).to_string());
    requests(stream, peer, handler, stop).await;
}

async fn requests(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    peer: PeerConnection,
    RequestHandler { router, is_behind_proxy }: RequestHandler,
    mut stop: watch::Receiver<bool>,
) {
    let (peer, router) = (Arc::new(peer), TowerToHyperService::new(router));
    let open = Arc::clone(&peer);
    let service = service_fn(move |mut request: Request<Incoming>| {
        let network = match is_behind_proxy {
            true => peer.client.network.behind_proxy(request.headers()),
            false => peer.client.network,
        };
        request.extensions_mut().insert(network);
        request.extensions_mut().insert(Arc::clone(&peer));
        let (answer, open) = (router.call(request), OpenRequest::begin(&peer));
        async move {
            let answer = answer.await?;
            COUNTS.answered(answer.status().as_u16());
            open.0.end_turn();
            if answer.status() == StatusCode::SWITCHING_PROTOCOLS {
                // It is in use until it ends.
                open.0.client.begin_request();
            }
            Ok::<_, std::convert::Infallible>(answer.map(|body| OpenAnswer { body, _open: open }))
        }
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADERS)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    tokio::pin!(connection);
    // Errors are the ends of connections by their other sides.
    tokio::select! {
        _ = connection.as_mut() => return,
        () = sleep(HANDSHAKE_COUNTS) => {}
        () = open.client.ended() => if open.client.is_idle() { return },
    }
    open.end_turn();
    tokio::select! {
        _ = connection.as_mut() => return,
        () = open.client.ended() => if open.client.is_idle() { return },
        _ = stop.wait_for(|is_stopping| *is_stopping) => {}
    }
    drop(open);
    connection.as_mut().graceful_shutdown();
    let _ = connection.await;
}

/// A request whose answer is not sent yet.
struct OpenRequest(Arc<PeerConnection>);

impl OpenRequest {
    fn begin(peer: &Arc<PeerConnection>) -> Self {
        peer.client.begin_request();
        Self(Arc::clone(peer))
    }
}

impl Drop for OpenRequest {
    fn drop(&mut self) {
        self.0.client.end_request();
    }
}

/// The body of an answer, with its request.
struct OpenAnswer {
    body: Body,
    _open: OpenRequest,
}

impl HttpBody for OpenAnswer {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use axum::routing::get;
    use futures_util::stream;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;

    async fn begin(stream: &mut TcpStream, path: &str) -> String {
        let request = format!("GET {path} HTTP/1.1\r\nhost: cloud\r\n\r\n");
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = [0; 15];
        stream.read_exact(&mut answer).await.unwrap();
        String::from_utf8_lossy(&answer).into_owned()
    }

    #[tokio::test]
    async fn idle_connections_end_for_new_ones_and_requests_go_on() {
        let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
        let address = listener.local_addr().unwrap();
        let follow = async || {
            let first = stream::iter([Ok::<_, std::io::Error>("first")]);
            Body::from_stream(futures_util::StreamExt::chain(first, stream::pending()))
        };
        let router = Router::new().route("/", get(async || "ok")).route("/follow", get(follow));
        let (stop, stopped) = watch::channel(false);
        let entrance = Entrance {
            listener,
            router,
            tls: None,
            most: 3,
            most_of_one: 1,
            is_behind_proxy: false,
            stop: stopped,
        };
        let serving = tokio::spawn(entrance.serve());
        let open = || TcpStream::connect(address);
        let mut follower = open().await.unwrap();
        assert_eq!(begin(&mut follower, "/follow").await, "HTTP/1.1 200 OK");
        // One that sends nothing, one with half a request, and one after its request.
        let (mut silent, mut slow) = (open().await.unwrap(), open().await.unwrap());
        slow.write_all(b"GET / HTTP/1.1\r\n").await.unwrap();
        let mut kept = open().await.unwrap();
        assert_eq!(begin(&mut kept, "/").await, "HTTP/1.1 200 OK");
        assert_eq!(silent.read(&mut [0]).await.unwrap_or(0), 0, "the oldest idle one has ended");
        let mut other = open().await.unwrap();
        assert_eq!(begin(&mut other, "/").await, "HTTP/1.1 200 OK");
        assert_eq!(slow.read(&mut [0]).await.unwrap_or(0), 0, "the next one has ended");
        // With requests in progress only, further ones are refused.
        for stream in [&mut kept, &mut other] {
            let mut rest = [0; 4096];
            assert!(stream.read(&mut rest).await.unwrap() > 0);
            assert_eq!(begin(stream, "/follow").await, "HTTP/1.1 200 OK");
        }
        assert_eq!(open().await.unwrap().read(&mut [0]).await.unwrap_or(0), 0);
        drop((kept, other, follower));
        stop.send_replace(true);
        serving.await.unwrap();
    }
}
