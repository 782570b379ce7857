//! A bucket of an object store with the interface of Amazon S3.
//!
//! Each request is signed for a minute by the credentials of the environment, and opens a
//! connection of its own. Addresses of requests are in no log: they have signatures.

use std::error::Error;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use gleaner_base::{Exit, Failure, excerpt};
use hyper::body::Incoming;
use hyper::client::conn::http1;
use hyper::{Method, Request, Response, StatusCode, Uri, header};
use hyper_util::rt::TokioIo;
use rustls::crypto::ring;
use rustls::pki_types::ServerName;
use rustls::{ClientConfig, RootCertStore};
use rusty_s3::actions::{DeleteObject, GetObject, HeadObject, PutObject, S3Action};
use rusty_s3::{Bucket, Credentials, UrlStyle};
use tokio::fs::File;
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};
use tokio_rustls::TlsConnector;

use crate::transfer::body_of;

/// Time for which a signed request is valid.
const SIGNED: Duration = Duration::from_secs(60);
/// Time for a connection, and for the headers of an answer.
const CONNECT: Duration = Duration::from_secs(10);
const ANSWER: Duration = Duration::from_secs(60);
/// Least rate at which a file is sent, in bytes a second.
const RATE_MIN: u64 = 100_000;
/// Number of attempts, and the pause after the first one; it doubles.
const ATTEMPTS: u32 = 4;
const PAUSE: Duration = Duration::from_millis(if cfg!(test) { 1 } else { 200 });
/// Longest answer that is read as a whole.
const TEXT_MAX: usize = 4 << 20;

type Failed = Box<dyn Error + Send + Sync>;

enum S3Call<'c> {
    Put { path: &'c Path, length: u64 },
    Head,
    Get { begin: u64 },
    Delete,
    List,
}

/// A bucket, and the beginning of all names in it.
#[derive(Clone)]
pub(crate) struct S3Bucket {
    bucket: Bucket,
    credentials: Arc<Credentials>,
    prefix: String,
    tls: Arc<ClientConfig>,
}

impl std::fmt::Debug for S3Bucket {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.url())
    }
}

impl S3Bucket {
    /// Parses `s3://BUCKET/PREFIX`, and reads the rest from the environment.
    ///
    /// # Errors
    ///
    /// A failure that names what is missing.
    pub(crate) fn parse(url: &str) -> Result<Self, Failure> {
        let failed =
            |message: String, help: &str| Failure::new(Exit::Usage, message).with_help(help);
        let place = url.strip_prefix("s3://").map(|it| it.trim_end_matches('/'));
        let (name, prefix) = place.map_or(("", ""), |it| it.split_once('/').unwrap_or((it, "")));
        let is_plain = |text: &str, more: &str| {
            text.chars().all(|it| it.is_ascii_alphanumeric() || more.contains(it))
        };
        if name.is_empty() || !is_plain(name, ".-") || !is_plain(prefix, ".-_/") {
            let message = format!("`{}` is not the address of an object store", excerpt(url));
            return Err(failed(message, "write s3://BUCKET or s3://BUCKET/PREFIX"));
        }
        let text = |name: &str| std::env::var(name).ok().filter(|it| !it.is_empty());
        let region = text("AWS_REGION").or_else(|| text("AWS_DEFAULT_REGION"));
        let region = region.unwrap_or_else(|| "us-east-1".to_owned());
        let own = text("AWS_ENDPOINT_URL_S3").or_else(|| text("AWS_ENDPOINT_URL"));
        // Names with dots are in no certificate, and other servers have no names for buckets.
        let style = match own.is_none() && !name.contains('.') {
            true => UrlStyle::VirtualHost,
            false => UrlStyle::Path,
        };
        let endpoint = own.unwrap_or_else(|| format!("https://s3.{region}.amazonaws.com"));
        let help = "set AWS_ENDPOINT_URL to http://HOST:PORT or https://HOST, or unset it";
        let wrong = || failed("the address of the object store cannot be used".to_owned(), help);
        let endpoint = endpoint.parse().map_err(|_| wrong())?;
        let bucket = Bucket::new(endpoint, style, name.to_owned(), region).map_err(|_| wrong())?;
        let credentials = Credentials::from_env().ok_or_else(|| {
            let message = "there are no credentials for the object store".to_owned();
            failed(message, "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY")
        })?;
        let prefix = if prefix.is_empty() { String::new() } else { format!("{prefix}/") };
        let tls = Arc::new(client_config()?);
        Ok(Self { bucket, credentials: Arc::new(credentials), prefix, tls })
    }

    /// Returns a bucket at another server.
    #[cfg(test)]
    pub(crate) fn of_test(endpoint: &str, key: &str) -> Self {
        let endpoint = endpoint.parse().unwrap();
        Self {
            bucket: Bucket::new(endpoint, UrlStyle::Path, "b", "r").unwrap(),
            credentials: Arc::new(Credentials::new(key, "secret")),
            prefix: String::new(),
            tls: Arc::new(client_config().unwrap()),
        }
    }

    /// Returns its address, without credentials.
    pub(crate) fn url(&self) -> String {
        format!("s3://{}/{}", self.bucket.name(), self.prefix)
    }

    /// Stores a file under a name: whole or not at all.
    pub(crate) async fn put(&self, name: &str, path: &Path) -> io::Result<()> {
        let length = tokio::fs::metadata(path).await?.len();
        let answer = self.answer(name, &S3Call::Put { path, length }).await?;
        accepted(answer).await.map(drop)
    }

    pub(crate) async fn length(&self, name: &str) -> io::Result<Option<u64>> {
        let answer = self.answer(name, &S3Call::Head).await?;
        if answer.status() == StatusCode::NOT_FOUND {
            return Ok(None);
        }
        let answer = accepted(answer).await?;
        let length = answer.headers().get(header::CONTENT_LENGTH);
        let length = length.and_then(|it| it.to_str().ok()?.parse().ok());
        length.map(Some).ok_or_else(|| io::Error::other("the object store states no length"))
    }

    /// Returns the content of an object from the byte `begin` on.
    pub(crate) async fn content(&self, name: &str, begin: u64) -> io::Result<Option<Body>> {
        let answer = self.answer(name, &S3Call::Get { begin }).await?;
        if answer.status() == StatusCode::NOT_FOUND {
            return Ok(None);
        }
        let answer = accepted(answer).await?;
        let is_part = answer.status() == StatusCode::PARTIAL_CONTENT;
        match is_part == (begin > 0) {
            true => Ok(Some(Body::new(answer.into_body()))),
            false => Err(io::Error::other("the object store sends another part than requested")),
        }
    }

    /// Removes an object, if it exists.
    pub(crate) async fn remove(&self, name: &str) -> io::Result<()> {
        accepted(self.answer(name, &S3Call::Delete).await?).await.map(drop)
    }

    /// Returns the names of at most a thousand objects that begin with `start`, in order.
    pub(crate) async fn list(&self, start: &str) -> io::Result<Vec<String>> {
        let answer = accepted(self.answer(start, &S3Call::List).await?).await?;
        let read = axum::body::to_bytes(Body::new(answer.into_body()), TEXT_MAX);
        let text = timeout(ANSWER, read).await?.map_err(io::Error::other)?;
        let text = String::from_utf8_lossy(&text);
        // All names are plain: none has a character that XML escapes.
        let keys = text.split("<Key>").skip(1).filter_map(|it| it.split_once("</Key>"));
        Ok(keys.filter_map(|(key, _)| key.strip_prefix(&*self.prefix)).map(str::to_owned).collect())
    }

    /// Returns the answer to a request, which is repeated if the object store is overloaded, or
    /// cannot be reached. All requests here may be.
    async fn answer(&self, name: &str, call: &S3Call<'_>) -> io::Result<Response<Incoming>> {
        let mut pause = PAUSE;
        for _ in 1..ATTEMPTS {
            match self.attempt(name, call).await {
                Ok(answer) if !is_overloaded(answer.status()) => return Ok(answer),
                Ok(answer) => {
                    tracing::debug!(status = %answer.status(), "a request to the store failed; retrying")
                }
                Err(error) => tracing::debug!(%error, "a request to the store failed; retrying"),
            }
            sleep(pause).await;
            pause *= 2;
        }
        self.attempt(name, call).await.map_err(io::Error::other)
    }

    async fn attempt(&self, name: &str, call: &S3Call<'_>) -> Result<Response<Incoming>, Failed> {
        let (key, user) = (format!("{}{name}", self.prefix), Some(&*self.credentials));
        let bucket = &self.bucket;
        let (method, url) = match call {
            S3Call::Put { .. } => (Method::PUT, PutObject::new(bucket, user, &key).sign(SIGNED)),
            S3Call::Head => (Method::HEAD, HeadObject::new(bucket, user, &key).sign(SIGNED)),
            S3Call::Get { .. } => (Method::GET, GetObject::new(bucket, user, &key).sign(SIGNED)),
            S3Call::Delete => (Method::DELETE, DeleteObject::new(bucket, user, &key).sign(SIGNED)),
            S3Call::List => {
                // A list is the content of the bucket itself.
                let mut list = GetObject::new(bucket, user, "");
                list.query_mut().insert("list-type", "2");
                list.query_mut().insert("prefix", key.as_str());
                (Method::GET, list.sign(SIGNED))
            }
        };
        let url = url.as_str().parse()?;
        let (mut request, mut body, mut time) = (request(method, &url), Body::empty(), ANSWER);
        match call {
            S3Call::Put { path, length } => {
                request = request.header(header::CONTENT_LENGTH, *length);
                body = body_of(File::open(path).await?);
                time += Duration::from_secs(length / RATE_MIN);
            }
            S3Call::Get { begin } if *begin > 0 => {
                request = request.header(header::RANGE, format!("bytes={begin}-"));
            }
            _ => {}
        }
        self.send(&url, request.body(body)?, time).await
    }

    /// Sends a request, over a connection of its own.
    async fn send(
        &self,
        url: &Uri,
        request: Request<Body>,
        time: Duration,
    ) -> Result<Response<Incoming>, Failed> {
        let (host, port, is_tls) = parts(url)?;
        let stream = timeout(CONNECT, TcpStream::connect((host, port))).await??;
        stream.set_nodelay(true)?;
        let sent = async {
            if !is_tls {
                return exchange(TokioIo::new(stream), request).await;
            }
            let name = ServerName::try_from(host.to_owned())?;
            let connector = TlsConnector::from(Arc::clone(&self.tls));
            let stream = timeout(CONNECT, connector.connect(name, stream)).await??;
            exchange(TokioIo::new(stream), request).await
        };
        timeout(time, sent).await?
    }
}

async fn exchange<S>(stream: S, request: Request<Body>) -> Result<Response<Incoming>, Failed>
where
    S: hyper::rt::Read + hyper::rt::Write + Unpin + Send + 'static,
{
    let (mut sender, connection) = http1::handshake(stream).await?;
    // It ends with the answer.
    tokio::spawn(connection);
    Ok(sender.send_request(request).await?)
}

/// Begins a request, with the part of the address that the server gets.
fn request(method: Method, url: &Uri) -> hyper::http::request::Builder {
    let path = url.path_and_query().map_or("/", |path| path.as_str());
    let host = url.authority().map_or("", |authority| authority.as_str());
    Request::builder().method(method).uri(path).header(header::HOST, host)
}

/// Returns the host and the port of an address, and whether it has TLS.
fn parts(url: &Uri) -> Result<(&str, u16, bool), Failed> {
    let is_tls = url.scheme_str() == Some("https");
    let host = url.host().ok_or("an address has no host")?;
    let port = url.port_u16().unwrap_or(if is_tls { 443 } else { 80 });
    Ok((host.trim_start_matches('[').trim_end_matches(']'), port, is_tls))
}

/// Returns an answer that is no error; reads the code of one that is.
async fn accepted(answer: Response<Incoming>) -> io::Result<Response<Incoming>> {
    let status = answer.status();
    if status.is_success() {
        return Ok(answer);
    }
    let read = axum::body::to_bytes(Body::new(answer.into_body()), TEXT_MAX);
    let text = timeout(ANSWER, read).await.ok().and_then(Result::ok).unwrap_or_default();
    let text = String::from_utf8_lossy(&text);
    // Only the code: other parts of the answer may have the address of the request.
    let code = text.split_once("<Code>").and_then(|(_, rest)| rest.split_once("</Code>"));
    let code = code.map_or("no reason", |(code, _)| code);
    Err(io::Error::other(format!("the object store answers {status}: {}", excerpt(code))))
}

fn is_overloaded(status: StatusCode) -> bool {
    status.is_server_error() || status == StatusCode::TOO_MANY_REQUESTS
}

/// Returns TLS settings with the authorities of this machine.
fn client_config() -> Result<ClientConfig, Failure> {
    let mut roots = RootCertStore::empty();
    // An object store without TLS needs none.
    roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
    let builder = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|error| Failure::caused_by(Exit::Internal, "TLS cannot be used", &error))?;
    Ok(builder.with_root_certificates(roots).with_no_client_auth())
}

#[cfg(test)]
mod tests {
    use axum::Router;
    use axum::body::Bytes;
    use axum::http::HeaderMap;
    use axum::response::IntoResponse;
    use futures_util::stream;
    use tokio::net::TcpListener;

    use super::*;
    use crate::transfer::{OCTETS, OutgoingFile};

    /// Answers as no store should, by the name of the object; all of them claim to have 7 bytes.
    async fn hostile(request: Request<Body>) -> axum::response::Response {
        let name = request.uri().path().rsplit('/').next().unwrap_or_default();
        let endless = || {
            let piece = Bytes::from_static(&[b'x'; 4096]);
            Body::from_stream(stream::repeat_with(move || Ok::<_, io::Error>(piece.clone())))
        };
        match (request.method(), name) {
            (&Method::HEAD, _) => "content".into_response(),
            (_, "right") => "content".into_response(),
            (_, "other") => "contend".into_response(),
            (_, "short") => "cont".into_response(),
            (_, "endless" | "") => endless().into_response(),
            (_, "moved") => {
                let place = [(header::LOCATION, "/b/right".to_owned())];
                (StatusCode::TEMPORARY_REDIRECT, place).into_response()
            }
            _ => (StatusCode::INTERNAL_SERVER_ERROR, "<Code>Broken</Code>").into_response(),
        }
    }

    #[tokio::test]
    async fn a_store_that_answers_wrongly_is_an_error_and_never_another_file() {
        let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        tokio::spawn(async { axum::serve(listener, Router::new().fallback(hostile)).await });
        let bucket = S3Bucket::of_test(&endpoint, "key");
        let sha256 = gleaner_trust::sha256(b"content");
        let sent = async |name: &str| {
            let sha256 = Some(sha256.as_str());
            let file = OutgoingFile { name: "a file", kind: OCTETS, help: "", sha256 };
            let length = bucket.length(name).await;
            let content = async |begin| bucket.content(name, begin).await;
            let answer = file.send((), &HeaderMap::new(), length, content).await;
            let answer = answer.map_err(|error| error.reason())?;
            let body = axum::body::to_bytes(answer.into_body(), 100).await;
            body.map_err(|error| error.to_string())
        };
        assert_eq!(sent("right").await.unwrap(), "content");
        for (name, reason) in [
            ("other", "it has another SHA-256"),
            ("short", "it has 4 of 7 bytes"),
            ("endless", "it is too long"),
            ("moved", "the object store answers 307"),
            ("broken", "the object store answers 500 Internal Server Error: Broken"),
        ] {
            let failed = sent(name).await.unwrap_err();
            assert!(failed.contains(reason), "{name}: {failed}");
        }
        let endless = bucket.list("x").await.unwrap_err().to_string();
        assert!(endless.contains("length limit"), "{endless}");
    }

    #[test]
    fn addresses_have_their_parts() {
        for (url, expected) in [
            ("http://127.0.0.1:5000/b/k?x=1", ("127.0.0.1", 5000, false)),
            ("https://b.s3.amazonaws.com/k", ("b.s3.amazonaws.com", 443, true)),
            ("http://[::1]:80/b/", ("::1", 80, false)),
            ("http://[::1]/b/", ("::1", 80, false)),
        ] {
            assert_eq!(parts(&Uri::from_static(url)).unwrap(), expected);
        }
        let url = Uri::from_static("http://127.0.0.1:5000/b/k?x=1");
        let begun = request(Method::GET, &url).body(()).unwrap();
        assert_eq!(begun.uri(), "/b/k?x=1");
        assert_eq!(begun.headers()["host"], "127.0.0.1:5000");
    }

    #[test]
    fn only_plain_places_are_accepted() {
        for wrong in ["", "b", "s3://", "s3:///x", "s3://b/a b", "s3://ann:key@b", "file:///x"] {
            let refused = S3Bucket::parse(wrong).unwrap_err();
            assert!(refused.message.contains("is not the address of an object store"), "{refused}");
        }
    }
}
