//! Accepts connections, with TLS or without, within bounds of their number and of time.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::serve::Listener;
use http_body_util::BodyExt;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper::{Request, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use rustls::ServerConfig;
use rustls::server::Acceptor;
use sha2::{Digest, Sha256};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{OwnedSemaphorePermit, mpsc, watch};
use tokio::time::{sleep, timeout};
use tokio_rustls::LazyConfigAcceptor;
use tokio_rustls::server::TlsStream;

use super::clients::{OpenClient, OpenClients};
use super::network::ClientNetwork;
use super::turns::FairTurns;

/// Maximum number of connections that begin at a time, up to the answer to the first request. After
/// a restart all vehicles come at once: with all of them in progress, each would take longer than
/// its time, and none would end. Their buffers, between what lives as long as a connection, would
/// also keep the heap at several times of what is in use.
const HANDSHAKES: usize = if cfg!(test) { 2 } else { 256 };
/// Time for the first record of TLS. Without it, a connection takes no turn.
const HELLO: Duration = seconds(10);
/// Time to wait for a handshake, which is as long as vehicles wait.
const HANDSHAKE_TURN: Duration = seconds(30);
/// Time after which a handshake, and then the wait for the first answer, does not count any more:
/// those that stall keep no others out.
const HANDSHAKE_COUNTS: Duration = seconds(1);
/// Time for the rest of a TLS handshake.
const HANDSHAKE: Duration = seconds(10);
/// Time for the headers of a request, and between requests.
const HEADERS: Duration = seconds(30);
/// Time for open requests when the server stops.
const DRAIN: Duration = Duration::from_secs(10);

/// Maximum length of the headers of a request; longer ones are answered by 431.
/// It is also the length of the buffers of a connection: bodies stream through them, in pieces that
/// are no shorter than the records of TLS.
const HEADERS_MAX: usize = 16 << 10;

/// Returns a time that no test waits for.
const fn seconds(seconds: u64) -> Duration {
    Duration::from_secs(if cfg!(test) { 3600 } else { seconds })
}

/// The other side of a connection; it counts as open as long as this lives.
#[derive(Debug)]
pub struct PeerConnection {
    /// SHA-256 of its certificate, which the authority of vehicles has signed.
    pub certificate: Option<String>,
    /// Its turn to begin, until its first answer.
    turn: Mutex<Option<OwnedSemaphorePermit>>,
    client: OpenClient,
    /// The entrance waits until all of these are dropped.
    _open: mpsc::Sender<()>,
}

impl PeerConnection {
    /// Lets another connection begin.
    fn end_turn(&self) {
        drop(self.turn.lock().unwrap_or_else(PoisonError::into_inner).take());
    }
}

/// A listener and what serves its connections.
pub struct BoundedListener<L> {
    /// The socket.
    pub listener: L,
    /// Name of its connections in the log.
    pub things: &'static str,
    /// The requests, each with its [`PeerConnection`] and [`ClientNetwork`] as extensions.
    pub router: Router,
    /// The TLS settings; they change with the server's certificate.
    pub tls: Option<watch::Receiver<Arc<ServerConfig>>>,
    /// Maximum number of open connections that have shown a certificate.
    pub known: usize,
    /// Maximum number of all others, which are untrusted peers; without TLS, of all.
    pub untrusted: usize,
    /// Time for the headers of a request, and between requests.
    pub headers: Duration,
    /// True if a proxy on this machine states the addresses of clients.
    pub is_behind_proxy: bool,
    /// True once the entrance has to end.
    pub stop: watch::Receiver<bool>,
}

impl<L: Listener<Addr: Into<ClientNetwork>>> BoundedListener<L> {
    /// Returns an entrance without TLS.
    pub fn plain(
        listener: L,
        (things, most): (&'static str, usize),
        router: Router,
        stop: watch::Receiver<bool>,
    ) -> Self {
        Self {
            listener,
            things,
            router,
            tls: None,
            known: 0,
            untrusted: most,
            headers: HEADERS,
            is_behind_proxy: false,
            stop,
        }
    }

    /// Accepts connections until the server stops, and then waits for the open ones.
    pub async fn serve(self) {
        let Self { mut listener, things, router, tls, known, untrusted, headers, .. } = self;
        let Self { is_behind_proxy, mut stop, .. } = self;
        let clients = OpenClients::new(things, known, untrusted);
        let turns = Arc::new(FairTurns::new(HANDSHAKES, untrusted));
        let (open, mut ended) = mpsc::channel::<()>(1);
        let stopping = stop.clone();
        let stopped = async move {
            let _ = stop.wait_for(|is_stopping| *is_stopping).await;
        };
        tokio::pin!(stopped);
        loop {
            let (stream, address) = tokio::select! {
                accepted = listener.accept() => accepted,
                () = &mut stopped => break,
            };
            let Some(client) = clients.open(address.into()) else { continue };
            let tls = tls.as_ref().map(|tls| Handshake {
                config: Arc::clone(&tls.borrow()),
                turns: Arc::clone(&turns),
            });
            let (certificate, turn) = (None, Mutex::default());
            let peer = PeerConnection { certificate, turn, client, _open: open.clone() };
            let router = router.clone();
            let handler = RequestHandler { router, headers, is_behind_proxy };
            tokio::spawn(connection(stream, tls, peer, handler, stopping.clone()));
        }
        drop((listener, open));
        if timeout(DRAIN, ended.recv()).await.is_err() {
            tracing::warn!("closed connections that did not end in time");
        }
    }
}

/// A TLS handshake that is due.
struct Handshake {
    config: Arc<ServerConfig>,
    turns: Arc<FairTurns>,
}

impl Handshake {
    /// Returns the stream, and gives its turn to `peer`, whose work goes on; `None` if the other
    /// side is too slow, or wrong. One that sends nothing takes no turn.
    async fn done<S>(self, stream: S, peer: &PeerConnection) -> Option<TlsStream<S>>
    where
        S: AsyncRead + AsyncWrite + Unpin,
    {
        let hello = LazyConfigAcceptor::new(Acceptor::default(), stream);
        let begun = timeout(HELLO, hello).await.ok()?.ok()?;
        peer.client.begin_work();
        let turn = timeout(HANDSHAKE_TURN, self.turns.take(peer.client.network)).await.ok()??;
        *peer.turn.lock().unwrap_or_else(PoisonError::into_inner) = Some(turn);
        let handshake = timeout(HANDSHAKE, begun.into_stream(self.config));
        tokio::pin!(handshake);
        let mut accepted = timeout(HANDSHAKE_COUNTS, handshake.as_mut()).await;
        if accepted.is_err() {
            peer.client.end_work();
            peer.end_turn();
            accepted = Ok(handshake.await);
            peer.client.begin_work();
        }
        accepted.ok()?.ok()?.ok()
    }
}

struct RequestHandler {
    router: Router,
    headers: Duration,
    is_behind_proxy: bool,
}

async fn connection(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    tls: Option<Handshake>,
    mut peer: PeerConnection,
    handler: RequestHandler,
    stop: watch::Receiver<bool>,
) {
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
    let certificate = certificates.and_then(|all| all.first()).map(Sha256::digest);
    peer.certificate = certificate.map(|it| gleaner_base::hex(&it));
    match certificate {
        None => peer.client.stay_untrusted(),
        Some(certificate) if peer.client.become_known(certificate.into()) => {}
        Some(_) => return,
    }
    peer.client.end_work();
    requests(stream, peer, handler, stop).await;
}

async fn requests(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    peer: PeerConnection,
    RequestHandler { router, headers, is_behind_proxy }: RequestHandler,
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
            open.0.end_turn();
            if answer.status() == StatusCode::SWITCHING_PROTOCOLS {
                // It is in use until it ends.
                open.0.client.keep();
            }
            // The body has its request until it is sent.
            let body = |body: Body| body.map_err(move |error| (error, &open).0);
            Ok::<_, std::convert::Infallible>(answer.map(body))
        }
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(headers)
        .max_buf_size(HEADERS_MAX)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    tokio::pin!(connection);
    let begun = async {
        sleep(HANDSHAKE_COUNTS).await;
        open.end_turn();
        std::future::pending::<()>().await;
    };
    // Errors are the ends of connections by their other sides. One that has to end when a request
    // has just begun ends after that.
    tokio::select! {
        _ = connection.as_mut() => return,
        () = begun => {}
        () = open.client.ended() => if open.client.can_end() { return },
        _ = stop.wait_for(|is_stopping| *is_stopping) => {}
    }
    open.end_turn();
    drop(open);
    connection.as_mut().graceful_shutdown();
    let _ = connection.await;
}

/// A request whose answer is not sent yet.
struct OpenRequest(Arc<PeerConnection>);

impl OpenRequest {
    fn begin(peer: &Arc<PeerConnection>) -> Self {
        peer.client.begin_work();
        Self(Arc::clone(peer))
    }
}

impl Drop for OpenRequest {
    fn drop(&mut self) {
        self.0.client.end_work();
    }
}

#[cfg(test)]
mod tests;
