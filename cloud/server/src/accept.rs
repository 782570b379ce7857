//! Accepts connections, with TLS or without, within bounds of their number and of time.

use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::Router;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use rustls::ServerConfig;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::time::{sleep, timeout};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

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
/// Time for open requests when the server stops.
const DRAIN: Duration = Duration::from_secs(10);

/// The other side of a connection; it counts as open as long as this lives.
#[derive(Debug)]
pub(crate) struct PeerConnection {
    pub(crate) address: IpAddr,
    /// SHA-256 of its certificate, which the authority of vehicles has signed.
    pub(crate) certificate: Option<String>,
    /// Its turn to begin, until its first answer.
    turn: Mutex<Option<OwnedSemaphorePermit>>,
    _slot: OwnedSemaphorePermit,
}

impl PeerConnection {
    /// Lets another connection begin.
    fn end_turn(&self) {
        drop(self.turn.lock().unwrap_or_else(PoisonError::into_inner).take());
    }

    #[cfg(test)]
    pub(crate) fn of_test(address: IpAddr, slot: OwnedSemaphorePermit) -> Self {
        Self { address, certificate: None, turn: Mutex::default(), _slot: slot }
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
    pub(crate) stop: watch::Receiver<bool>,
}

impl Entrance {
    /// Accepts connections until the server stops, and then waits for the open ones.
    pub(crate) async fn serve(self) {
        let Self { listener, router, tls, most, mut stop } = self;
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
            let Ok(slot) = Arc::clone(&slots).try_acquire_owned() else {
                tracing::warn!(most, "a connection is refused: too many are open");
                continue;
            };
            let tls = tls.as_ref().map(|tls| Handshake {
                acceptor: TlsAcceptor::from(Arc::clone(&tls.borrow())),
                turns: Arc::clone(&handshakes),
            });
            let (address, certificate, turn) = (address.ip(), None, Mutex::default());
            let peer = PeerConnection { address, certificate, turn, _slot: slot };
            tokio::spawn(connection(stream, tls, peer, router.clone(), stopping.clone()));
        }
        drop(listener);
        if timeout(DRAIN, slots.acquire_many(most)).await.is_err() {
            tracing::warn!("connections were cut that did not end in time");
        }
    }
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

async fn connection(
    stream: TcpStream,
    tls: Option<Handshake>,
    mut peer: PeerConnection,
    router: Router,
    stop: watch::Receiver<bool>,
) {
    let _ = stream.set_nodelay(true);
    let Some(tls) = tls else {
        return requests(stream, peer, router, stop).await;
    };
    // In a box, as a connection that waits or is upgraded does not need the room.
    let Some(stream) = Box::pin(tls.done(stream, &peer)).await else {
        tracing::debug!(address = %peer.address, "a TLS handshake failed");
        return;
    };
    let certificates = stream.get_ref().1.peer_certificates();
    let certificate = certificates.and_then(|all| all.first());
    peer.certificate = certificate.map(|it| gleaner_trust::sha256(it).to_string());
    requests(stream, peer, router, stop).await;
}

async fn requests(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    peer: PeerConnection,
    router: Router,
    mut stop: watch::Receiver<bool>,
) {
    let (peer, router) = (Arc::new(peer), TowerToHyperService::new(router));
    let beginning = Arc::clone(&peer);
    let service = service_fn(move |mut request: Request<Incoming>| {
        request.extensions_mut().insert(Arc::clone(&peer));
        let (answer, peer) = (router.call(request), Arc::clone(&peer));
        async move {
            let answer = answer.await;
            peer.end_turn();
            answer
        }
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADERS)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    tokio::pin!(connection);
    // Errors are the ends of connections by their other sides.
    if timeout(HANDSHAKE_COUNTS, connection.as_mut()).await.is_ok() {
        return;
    }
    beginning.end_turn();
    drop(beginning);
    tokio::select! {
        _ = connection.as_mut() => return,
        _ = stop.wait_for(|is_stopping| *is_stopping) => connection.as_mut().graceful_shutdown(),
    }
    let _ = connection.await;
}
