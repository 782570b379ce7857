//! The connection to a vehicle or a cloud: requests to `gleaner-orchestrator` over its socket, or
//! to a cloud, whose API has that of each vehicle below `/v1/vehicles/NAME`.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::Bytes;
use gleaner_base::{ByteSize, Exit, Failure};
use gleaner_protocol::vehicle_api::{API_SOCKET, Problem, VehicleStatus};
use http_body_util::{BodyExt, Either, Full, LengthLimitError, Limited};
use hyper::body::Incoming;
use hyper::client::conn::http1;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpStream, UnixStream};
use tokio::time::timeout;

use super::file_body::FileBody;
use crate::account::{CloudAccount, LOGIN_HELP};
use crate::args::{StatusArgs, VehicleArgs};

/// Folder of the socket without another choice.
const RUN_DIR: &str = "/run/gleaner";

/// Longest wait for a connection to a cloud, and for an answer without effect, such as a status,
/// which takes some milliseconds.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

/// Longest answer, and longest line of one: that of a thousand lambdas takes some MiB.
const ANSWER_MAX: ByteSize = ByteSize::mib(64);

type Content = Either<Full<Bytes>, FileBody>;

enum Endpoint {
    /// The orchestrator of this machine, at its socket.
    Orchestrator(PathBuf),
    /// A cloud; without a token, only for a login.
    Cloud(CloudAccount),
}

/// A client of one vehicle or one cloud.
pub(crate) struct VehicleClient {
    endpoint: Endpoint,
    /// Start of the paths of all requests, in place of `/v1`.
    root: String,
    runtime: tokio::runtime::Runtime,
}

impl VehicleClient {
    /// Creates a client of the orchestrator of this machine. It connects with each request.
    pub(crate) fn new(args: &VehicleArgs) -> Result<Self, Failure> {
        Self::to(Endpoint::Orchestrator(Self::socket(args)), "/v1".to_owned())
    }

    /// Creates a client of the vehicle that was chosen: one of the cloud, or this machine.
    pub(crate) fn of(args: &StatusArgs) -> Result<Self, Failure> {
        match &args.on.vehicle {
            Some(name) => {
                Self::to(Endpoint::Cloud(CloudAccount::load()?), format!("/v1/vehicles/{name}"))
            }
            None => Self::new(&args.vehicle),
        }
    }

    pub(crate) fn of_cloud(account: CloudAccount) -> Result<Self, Failure> {
        Self::to(Endpoint::Cloud(account), "/v1".to_owned())
    }

    fn to(endpoint: Endpoint, root: String) -> Result<Self, Failure> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|it| Failure::caused_by(Exit::Internal, "cannot prepare a connection", &it))?;
        Ok(Self { endpoint, root, runtime })
    }

    pub(crate) fn socket(args: &VehicleArgs) -> PathBuf {
        let variable = || std::env::var_os("GLEANER_RUN").filter(|it| !it.is_empty());
        let chosen = args.run_dir.clone().or_else(|| variable().map(PathBuf::from));
        chosen.unwrap_or_else(|| RUN_DIR.into()).join(API_SOCKET)
    }

    /// Returns the name of the receiver of requests, for messages.
    pub(crate) fn receiver(&self) -> &'static str {
        if self.is_cloud() { "the cloud" } else { "the vehicle" }
    }

    fn is_cloud(&self) -> bool {
        matches!(self.endpoint, Endpoint::Cloud(_))
    }

    pub(crate) fn status(&self) -> Result<VehicleStatus, Failure> {
        self.get("/v1/status")
    }

    pub(crate) fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T, Failure> {
        self.get_sized(path).map(|(answer, _)| answer)
    }

    /// Returns the answer to a request without effect, and its length in bytes.
    pub(crate) fn get_sized<T: DeserializeOwned>(&self, path: &str) -> Result<(T, usize), Failure> {
        self.runtime.block_on(async {
            let answer = self.json(Method::GET, path, Bytes::new(), &[]);
            timeout(ANSWER_TIMEOUT, answer).await.unwrap_or_else(|_| {
                let seconds = ANSWER_TIMEOUT.as_secs();
                let message = format!("{} has not answered for {seconds} s", self.program());
                Err(Failure::new(Exit::Unreachable, message))
            })
        })
    }

    /// Sends a request with a body of JSON, and returns the answer.
    pub(crate) fn post<T: DeserializeOwned>(
        &self,
        path: &str,
        body: &impl Serialize,
    ) -> Result<T, Failure> {
        let body = serde_json::to_vec(body).expect("a request is plain data");
        let answer = self.json(Method::POST, path, body.into(), &[]);
        self.runtime.block_on(answer).map(|(answer, _)| answer)
    }

    /// Sends a request of JSON that creates something, with a key: after a lost connection it is
    /// sent once more, and a cloud that has carried it out does not do so again.
    pub(crate) fn create<T: DeserializeOwned>(
        &self,
        path: &str,
        body: &impl Serialize,
    ) -> Result<T, Failure> {
        if !self.is_cloud() {
            return self.post(path, body);
        }
        let body: Bytes = serde_json::to_vec(body).expect("a request is plain data").into();
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes).map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot make a key for the request", &error)
        })?;
        let key = [("idempotency-key", gleaner_base::hex(&bytes))];
        let send = || {
            let answer = self.json(Method::POST, path, body.clone(), &key);
            self.runtime.block_on(answer).map(|(answer, _)| answer)
        };
        match send() {
            Err(failure) if failure.exit == Exit::Unreachable => send(),
            result => result,
        }
    }

    /// Sends a change without content, of the state with this version if there is one.
    pub(crate) fn change(
        &self,
        method: Method,
        path: &str,
        version: Option<&str>,
    ) -> Result<(), Failure> {
        let state = version.map(|it| ("if-match", format!("\"{it}\"")));
        self.send(method, path, nothing(), state.as_slice())
    }

    pub(crate) fn delete(&self, path: &str) -> Result<(), Failure> {
        self.change(Method::DELETE, path, None)
    }

    pub(crate) fn put(&self, path: &str, body: Vec<u8>) -> Result<(), Failure> {
        self.send(Method::PUT, path, Either::Left(Full::new(body.into())), &[])
    }

    pub(super) fn put_file(&self, path: &str, file: std::fs::File) -> Result<(), Failure> {
        self.send(Method::PUT, path, Either::Right(FileBody::new(file)), &[])
    }

    /// Sends a request whose answer has no content.
    fn send(
        &self,
        method: Method,
        path: &str,
        body: Content,
        headers: &[(&str, String)],
    ) -> Result<(), Failure> {
        self.runtime.block_on(self.request(method, path, body, headers)).map(drop)
    }

    /// Calls `take` with each line of an answer, until its end.
    pub(super) fn lines(
        &self,
        path: &str,
        mut take: impl FnMut(&str) -> Result<(), Failure>,
    ) -> Result<(), Failure> {
        self.runtime.block_on(async {
            let answer = self.request(Method::GET, path, nothing(), &[]).await?;
            let mut body = answer.into_body();
            let mut text: Vec<u8> = Vec::new();
            while let Some(frame) = body.frame().await {
                let frame = frame.map_err(|error| self.lost(&error))?;
                let data = frame.data_ref().map_or(&[][..], |data| data);
                for piece in data.split_inclusive(|byte| *byte == b'\n') {
                    text.extend_from_slice(piece);
                    if text.ends_with(b"\n") {
                        take(String::from_utf8_lossy(&text).trim_end())?;
                        text.clear();
                    } else if text.len() as u64 > ANSWER_MAX.bytes() {
                        return Err(self.too_long());
                    }
                }
            }
            Ok(())
        })
    }

    /// Calls `take` with each piece of a file, which begins after `from` bytes.
    pub(crate) fn download(
        &self,
        path: &str,
        from: u64,
        mut take: impl FnMut(&[u8]) -> Result<(), Failure>,
    ) -> Result<(), Failure> {
        self.runtime.block_on(async {
            let range = (from > 0).then(|| ("range", format!("bytes={from}-")));
            let answer = self.request(Method::GET, path, nothing(), range.as_slice()).await?;
            if from > 0 && answer.status() != StatusCode::PARTIAL_CONTENT {
                let message = format!("{} does not continue a file", self.program());
                return Err(Failure::new(Exit::Internal, message)
                    .with_help("remove the file that ends with `.part`, and run this again"));
            }
            let mut body = answer.into_body();
            while let Some(frame) =
                timeout(ANSWER_TIMEOUT, body.frame()).await.map_err(|late| self.lost(&late))?
            {
                let frame = frame.map_err(|error| self.lost(&error))?;
                take(frame.data_ref().map_or(&[][..], |data| data))?;
            }
            Ok(())
        })
    }

    /// Sends a request; returns the content of its answer, and the length of that in bytes.
    async fn json<T: DeserializeOwned>(
        &self,
        method: Method,
        path: &str,
        body: Bytes,
        headers: &[(&str, String)],
    ) -> Result<(T, usize), Failure> {
        let body = Either::Left(Full::new(body));
        let answer = self.request(method, path, body, headers).await?;
        let body = self.whole(answer.into_body()).await?;
        let parsed = serde_json::from_slice(&body).map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot parse the answer", &error)
                .with_help(format!("use the `gleaner` of the version of {}", self.program()))
        });
        Ok((parsed?, body.len()))
    }

    /// Sends a request with these headers; returns its answer if that is no error.
    async fn request(
        &self,
        method: Method,
        path: &str,
        body: Content,
        headers: &[(&str, String)],
    ) -> Result<Response<Incoming>, Failure> {
        let (mut sender, host, token) = match &self.endpoint {
            Endpoint::Orchestrator(socket) => {
                let stream = UnixStream::connect(socket).await;
                let stream = stream.map_err(|error| unreachable(socket, &error))?;
                (self.handshake(stream).await?, "vehicle".to_owned(), "")
            }
            Endpoint::Cloud(CloudAccount { url, token }) => {
                let stream = timeout(ANSWER_TIMEOUT, TcpStream::connect(url.address())).await;
                let stream = stream.unwrap_or_else(|_| Err(ErrorKind::TimedOut.into()));
                let stream = stream.map_err(|error| {
                    let action = format!("cannot reach the cloud at {url}");
                    Failure::caused_by(Exit::Unreachable, action, &error)
                        .with_help("check that it runs, and that this is its address for people")
                })?;
                (self.handshake(stream).await?, url.authority(), token.as_str())
            }
        };
        let path = match path.strip_prefix("/v1") {
            Some(rest) => format!("{}{rest}", self.root),
            None => path.to_owned(),
        };
        let mut request = Request::builder().method(&method).uri(&path).header("host", host);
        if method == Method::POST {
            request = request.header("content-type", "application/json");
        }
        if !token.is_empty() {
            request = request.header("authorization", format!("Bearer {token}"));
        }
        for (name, value) in headers {
            request = request.header(*name, value);
        }
        let request = request.body(body).map_err(|error| {
            Failure::caused_by(Exit::Usage, format!("`{path}` is not a request path"), &error)
        })?;
        let answer = sender.send_request(request).await.map_err(|error| self.lost(&error))?;
        let status = answer.status();
        if status.is_success() {
            return Ok(answer);
        }
        let failure = self.refusal(status, &self.whole(answer.into_body()).await?);
        // Without a token, it is the code of a login that was refused.
        Err(match status == StatusCode::UNAUTHORIZED && !token.is_empty() {
            true => failure.with_help(LOGIN_HELP),
            false => failure,
        })
    }

    /// Returns the failure of an answer with this status and body.
    fn refusal(&self, status: StatusCode, body: &[u8]) -> Failure {
        let exit = match status {
            StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN => Exit::Denied,
            _ => Exit::Internal,
        };
        let without = |_| Failure::new(exit, format!("{} answers {status}", self.program()));
        serde_json::from_slice::<Problem>(body).map_or_else(without, Failure::from)
    }

    async fn handshake<S>(&self, stream: S) -> Result<http1::SendRequest<Content>, Failure>
    where
        S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        let (sender, connection) =
            http1::handshake(TokioIo::new(stream)).await.map_err(|error| self.lost(&error))?;
        tokio::spawn(connection);
        Ok(sender)
    }

    /// Reads an answer up to its maximum length.
    async fn whole(&self, body: Incoming) -> Result<Bytes, Failure> {
        let most = ANSWER_MAX.bytes().try_into().unwrap_or(usize::MAX);
        let read = Limited::new(body, most).collect().await;
        let read = read.map_err(|error| match error.is::<LengthLimitError>() {
            true => self.too_long(),
            false => self.lost(&*error),
        });
        Ok(read?.to_bytes())
    }

    fn too_long(&self) -> Failure {
        let message = format!("an answer at `{}` has more than {ANSWER_MAX}", self.place());
        let program = self.program();
        Failure::new(Exit::Internal, message)
            .with_help(format!("check that {program} answers there, in the version of `gleaner`"))
    }

    fn lost(&self, error: &dyn std::error::Error) -> Failure {
        let action = format!("lost the connection to `{}`", self.place());
        Failure::caused_by(Exit::Unreachable, action, error)
    }

    fn place(&self) -> String {
        match &self.endpoint {
            Endpoint::Orchestrator(socket) => socket.display().to_string(),
            Endpoint::Cloud(account) => account.url.to_string(),
        }
    }

    fn program(&self) -> &'static str {
        if self.is_cloud() { "gleaner-cloud" } else { "gleaner-orchestrator" }
    }
}

/// The body of a request without content.
fn nothing() -> Content {
    Either::Left(Full::default())
}

fn unreachable(socket: &Path, error: &std::io::Error) -> Failure {
    let action = format!("cannot reach gleaner-orchestrator at `{}`", socket.display());
    let help = match error.kind() {
        ErrorKind::PermissionDenied => {
            "join the group of the service, `sudo usermod -aG gleaner $USER`, or use sudo"
        }
        _ => {
            "start it: `sudo systemctl start gleaner`, or `gleaner-orchestrator --state DIR --run \
             DIR` and GLEANER_RUN=DIR here"
        }
    };
    Failure::caused_by(Exit::Unreachable, action, error).with_help(help)
}

#[cfg(test)]
mod tests;
