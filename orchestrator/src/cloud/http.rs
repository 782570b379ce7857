//! HTTPS to the cloud: a connection for each request, or one for several that follow each other.

use std::future::Future;
use std::io;
use std::iter;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::body::Bytes;
use futures_util::{Stream, StreamExt, TryStreamExt};
use gleaner_base::{Exit, Failure};
use gleaner_fleet::{CAUSES_MAX, problem_text};
use gleaner_protocol::vehicle_api::Problem;
use http_body_util::{BodyDataStream, Full};
use hyper::body::Incoming;
use hyper::client::conn::http1::{self, SendRequest};
use hyper::http::request;
use hyper::{Method, Request, Response, StatusCode, header};
use hyper_util::rt::TokioIo;
use rustls::ClientConfig;
use rustls::pki_types::ServerName;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

/// Time to connect, and to wait for the head of an answer or for the next piece of its body.
pub(super) const PATIENCE: Duration = Duration::from_secs(30);

/// Time for which a busy cloud is asked for a file again, and the shortest pause: all vehicles may
/// fetch a release at once.
const BUSY: Duration = Duration::from_secs(1800);
const BUSY_PAUSE: Duration = Duration::from_secs(if cfg!(test) { 0 } else { 1 });

/// Slowest rate at which a part of a file is sent, in bytes/s.
const RATE_MIN: u64 = 14_000;

/// Longest answer without a file.
const ANSWER_MAX: u64 = 64 << 10;

#[derive(Clone)]
pub(super) struct CloudHttp {
    pub(super) address: String,
    tls: Arc<ClientConfig>,
    /// The connection of the last request, if it is kept for the next one.
    kept: Option<Arc<Mutex<Option<Requests>>>>,
    /// A file request that a busy cloud lets wait.
    pub(super) wait: Arc<Mutex<Option<BusyWait>>>,
}

/// A wait for a busy cloud, and the time at which it has ended at the latest.
pub(super) struct BusyWait {
    pub(super) address: String,
    pub(super) reason: String,
    pub(super) until: Instant,
}

type Requests = SendRequest<Full<Bytes>>;

impl CloudHttp {
    /// Creates a cloud, with a connection for each request.
    pub(super) fn new(address: String, tls: Arc<ClientConfig>) -> Self {
        Self { address, tls, kept: None, wait: Arc::default() }
    }

    /// Returns the same cloud with one connection for requests that follow each other. It ends with
    /// the returned value. One that is lost with a request is replaced, and the request is sent
    /// again: it must be one that may come twice.
    pub(super) fn keeping(&self) -> Self {
        Self { kept: Some(Arc::default()), ..self.clone() }
    }

    /// Connects, unless the cloud cannot be reached, or its certificate is not the expected one.
    /// `dialing` is the time to reach the cloud, without the handshake.
    pub(super) async fn connect(&self, dialing: Duration) -> Result<TlsStream<TcpStream>, Failure> {
        let host = self.address.rsplit_once(':').map_or(&*self.address, |(host, _)| host);
        let host = host.trim_start_matches('[').trim_end_matches(']').to_owned();
        let name = ServerName::try_from(host)
            .map_err(|error| self.unreachable("its name is invalid", &error))?;
        let connected = self.in_time("it did not accept a connection", async {
            let stream = timeout(dialing, TcpStream::connect(&self.address)).await??;
            stream.set_nodelay(true)?;
            TlsConnector::from(Arc::clone(&self.tls)).connect(name, stream).await
        });
        let failed = |error| self.unreachable("it cannot be connected to", &without_tls(error));
        connected.await?.map_err(failed)
    }

    /// Sends a request with a body of JSON, and returns the answer.
    pub(super) async fn post<T: DeserializeOwned>(
        &self,
        path: &str,
        body: &impl Serialize,
    ) -> Result<T, Failure> {
        let body = serde_json::to_vec(body).expect("a request is plain data");
        let whole = self.in_time("it did not answer in full", async {
            let answer = self.request(PATIENCE, Method::POST, path, body).await?;
            self.whole(answer, ANSWER_MAX).await
        });
        self.parsed(&whole.await??)
    }

    /// Sends bytes, and returns the answer, which may take so long after them.
    pub(super) async fn put<T: DeserializeOwned>(
        &self,
        path: &str,
        body: Vec<u8>,
        patience: Duration,
    ) -> Result<T, Failure> {
        let time = patience + Duration::from_secs(body.len() as u64 / RATE_MIN);
        let sent = timeout(time, async {
            let answer = self.request(time, Method::PUT, path, body).await?;
            self.whole(answer, ANSWER_MAX).await
        });
        let whole = sent.await.map_err(|late| self.unreachable("it did not answer", &late))??;
        self.parsed(&whole)
    }

    fn parsed<T: DeserializeOwned>(&self, text: &[u8]) -> Result<T, Failure> {
        serde_json::from_slice(text)
            .map_err(|error| self.unreachable("its answer cannot be parsed", &error))
    }

    /// Returns the content under a path, at most `most` bytes.
    pub(super) async fn get(&self, path: &str, most: u64) -> Result<Vec<u8>, Failure> {
        let answer = self.request(PATIENCE, Method::GET, path, Vec::new()).await?;
        self.whole(answer, most).await
    }

    /// Returns the pieces of the file of this length under a path, from its byte `from`, each of
    /// which comes in time, or is an error; and whether they are the whole file instead. It is a
    /// failure if there is none, or it is another part of a file.
    pub(super) async fn pieces(
        &self,
        path: &str,
        from: u64,
        length: u64,
    ) -> Result<(impl Stream<Item = io::Result<Bytes>> + Unpin + use<>, bool), Failure> {
        let request = Request::get(path).header(header::HOST, &self.address);
        let request = match from {
            0 => request,
            from => request.header(header::RANGE, format!("bytes={from}-")),
        };
        let answer = self.answered(PATIENCE, request, Vec::new()).await?;
        let is_whole = answer.status() != StatusCode::PARTIAL_CONTENT;
        let range = answer.headers().get(header::CONTENT_RANGE).map(|it| it.as_bytes());
        let expected = format!("bytes {from}-{}/{length}", length.saturating_sub(1));
        if !is_whole && range != Some(expected.as_bytes()) {
            let error = io::Error::other(format!("it is not `{expected}`"));
            return Err(self.unreachable("it sends another part of a file", &error));
        }
        Ok((Box::pin(in_time(answer)), is_whole))
    }

    async fn request(
        &self,
        patience: Duration,
        method: Method,
        path: &str,
        body: Vec<u8>,
    ) -> Result<Response<Incoming>, Failure> {
        let request = Request::builder()
            .method(method)
            .uri(path)
            .header(header::HOST, &self.address)
            .header(header::CONTENT_TYPE, "application/json");
        self.answered(patience, request, body).await
    }

    async fn answered(
        &self,
        patience: Duration,
        request: request::Builder,
        body: Vec<u8>,
    ) -> Result<Response<Incoming>, Failure> {
        let request = request
            .body(Full::new(Bytes::from(body)))
            .map_err(|error| self.unreachable("a request to it is invalid", &error))?;
        let until = Instant::now() + BUSY;
        loop {
            let answer = self.answer(patience, &request).await?;
            let (now, is_get) = (Instant::now(), request.method() == Method::GET);
            let Some(pause) = busy(&answer).filter(|_| is_get && now < until) else {
                // The others do not wait: a file may wait beside them.
                if is_get {
                    self.note_wait(None);
                }
                return self.accepted(answer).await;
            };
            let (status, left) = (answer.status(), (until - now).as_secs().div_ceil(60).max(1));
            let reason = format!("it is busy ({status}); files are requested for {left} more min");
            // It goes on while the next request is on its way.
            let (address, until) = (self.address.clone(), now + pause + PATIENCE);
            self.note_wait(Some(BusyWait { address, reason, until }));
            sleep(pause).await;
        }
    }

    fn note_wait(&self, wait: Option<BusyWait>) {
        *self.wait.lock().unwrap_or_else(PoisonError::into_inner) = wait;
    }

    async fn answer(
        &self,
        patience: Duration,
        request: &Request<Full<Bytes>>,
    ) -> Result<Response<Incoming>, Failure> {
        let failed = |error: hyper::Error| self.unreachable("the connection was lost", &error);
        if let Some(kept) = self.take_kept().await
            && let Ok(answer) = self.sent(kept, patience, request.clone()).await?
        {
            return Ok(answer);
        }
        let stream = TokioIo::new(self.connect(PATIENCE).await?);
        let (sender, connection) =
            self.in_time("it did not answer", http1::handshake(stream)).await?.map_err(failed)?;
        tokio::spawn(connection);
        self.sent(sender, patience, request.clone()).await?.map_err(failed)
    }

    /// Sends a request over a connection, and keeps that if it is to be kept.
    async fn sent(
        &self,
        mut sender: Requests,
        patience: Duration,
        request: Request<Full<Bytes>>,
    ) -> Result<hyper::Result<Response<Incoming>>, Failure> {
        let answer = timeout(patience, sender.send_request(request)).await;
        let answer = answer.map_err(|late| self.unreachable("it did not answer", &late))?;
        if let Some(kept) = &self.kept {
            *kept.lock().unwrap_or_else(PoisonError::into_inner) = Some(sender);
        }
        Ok(answer)
    }

    /// Takes the connection that was kept, unless it has ended.
    async fn take_kept(&self) -> Option<Requests> {
        let kept = self.kept.as_ref()?.lock().unwrap_or_else(PoisonError::into_inner).take();
        let mut sender = kept?;
        timeout(PATIENCE, sender.ready()).await.ok()?.ok()?;
        Some(sender)
    }

    async fn accepted(&self, answer: Response<Incoming>) -> Result<Response<Incoming>, Failure> {
        let kind = answer.headers().get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok());
        // The cloud has pages at its other address only.
        if kind.is_some_and(|kind| kind.starts_with("text/html")) {
            let text = "text/html, not with the cloud's JSON: a portal or proxy is in between";
            let error = io::Error::other(format!("{} and {text}", answer.status()));
            return Err(self.unreachable("it answers with", &error));
        }
        match answer.status().is_success() {
            true => Ok(answer),
            false => Err(self.refused(answer).await),
        }
    }

    async fn refused(&self, answer: Response<Incoming>) -> Failure {
        let status = answer.status();
        let exit = match status {
            StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN => Exit::Denied,
            _ => Exit::Unreachable,
        };
        let mut failure =
            Failure::new(exit, format!("the cloud at {} refuses a request", self.address));
        let answer = self.whole(answer, ANSWER_MAX).await.unwrap_or_default();
        match serde_json::from_slice::<Problem>(&answer) {
            Ok(Problem { title, causes, help, .. }) => {
                let causes = iter::once(title).chain(causes).take(CAUSES_MAX);
                failure.causes = causes.map(|cause| problem_text(&cause)).collect();
                failure.help = help.map(|help| problem_text(&help));
            }
            Err(_) => failure.causes = vec![format!("it answers {status}")],
        }
        failure
    }

    async fn whole(&self, answer: Response<Incoming>, most: u64) -> Result<Vec<u8>, Failure> {
        let mut pieces = Box::pin(in_time(answer));
        let mut whole = Vec::new();
        while let Some(piece) = pieces.next().await {
            let piece = piece.map_err(|it| self.unreachable("the connection was lost", &it))?;
            whole.extend_from_slice(&piece);
            if whole.len() as u64 > most {
                let long = io::Error::other(format!("it has more than {most} bytes"));
                return Err(self.unreachable("its answer is too long", &long));
            }
        }
        Ok(whole)
    }

    async fn in_time<T>(&self, what: &str, work: impl Future<Output = T>) -> Result<T, Failure> {
        timeout(PATIENCE, work).await.map_err(|error| self.unreachable(what, &error))
    }

    pub(super) fn unreachable(
        &self,
        what: &str,
        error: &(dyn std::error::Error + 'static),
    ) -> Failure {
        let mut failure =
            Failure::new(Exit::Unreachable, format!("cannot use the cloud at {}", self.address));
        let error = gleaner_base::visible(&gleaner_base::chain(error));
        failure.causes = vec![format!("{what}: {error}")];
        failure
    }
}

/// Returns the pause after which a busy cloud wants to be asked again.
fn busy(answer: &Response<Incoming>) -> Option<Duration> {
    let seconds = answer.headers().get(header::RETRY_AFTER)?.to_str().ok()?.parse().ok()?;
    let is_busy = matches!(answer.status().as_u16(), 429 | 503);
    is_busy.then(|| Duration::from_secs(seconds).clamp(BUSY_PAUSE, PATIENCE))
}

/// Returns the pieces of a body; one that does not come in time is an error.
fn in_time(answer: Response<Incoming>) -> impl Stream<Item = Result<Bytes, io::Error>> {
    let pieces = BodyDataStream::new(answer.into_body()).map_err(io::Error::other);
    futures_util::stream::unfold(Box::pin(pieces), async |mut pieces| {
        let next = timeout(PATIENCE, pieces.next()).await;
        let piece = next.unwrap_or_else(|late| Some(Err(io::Error::other(late))))?;
        Some((piece, pieces))
    })
}

/// Names a portal, which answers without TLS until its user logs in.
fn without_tls(error: io::Error) -> io::Error {
    let inner = error.get_ref().and_then(|inner| inner.downcast_ref());
    match inner {
        Some(rustls::Error::InvalidMessage(_)) => {
            io::Error::other("the answer is not TLS: a portal or proxy is in between")
        }
        _ => error,
    }
}
