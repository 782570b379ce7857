//! The connection to `gleaner-orchestrator`: requests over its socket.

use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::Bytes;
use gleaner_base::{ByteSize, Exit, Failure};
use gleaner_protocol::vehicle_api::{API_SOCKET, Problem, VehicleStatus};
use http_body_util::{BodyExt, Either, Full, LengthLimitError, Limited};
use hyper::body::Incoming;
use hyper::client::conn::http1;
use hyper::{Method, Request, Response};
use hyper_util::rt::TokioIo;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::net::UnixStream;

use super::file_body::FileBody;
use crate::args::VehicleArgs;

/// Folder of the socket without another choice.
const RUN_DIR: &str = "/run/gleaner";

/// Longest wait for a status, which takes some milliseconds.
const STATUS_TIMEOUT: Duration = Duration::from_secs(10);

/// Longest answer, and longest line of one: that of a thousand lambdas takes some MiB.
const ANSWER_MAX: ByteSize = ByteSize::mib(64);

/// A client of one orchestrator.
pub(crate) struct VehicleClient {
    socket: PathBuf,
    runtime: tokio::runtime::Runtime,
}

impl VehicleClient {
    /// Creates a client. It connects with each request.
    pub(crate) fn new(args: &VehicleArgs) -> Result<Self, Failure> {
        let variable = || std::env::var_os("GLEANER_RUN").filter(|it| !it.is_empty());
        let chosen = args.run_dir.clone().or_else(|| variable().map(PathBuf::from));
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|it| Failure::caused_by(Exit::Internal, "cannot prepare a connection", &it))?;
        Ok(Self { socket: chosen.unwrap_or_else(|| RUN_DIR.into()).join(API_SOCKET), runtime })
    }

    /// The path of the socket.
    pub(crate) fn socket(&self) -> &Path {
        &self.socket
    }

    /// Returns the status of the vehicle.
    pub(crate) fn status(&self) -> Result<VehicleStatus, Failure> {
        self.runtime.block_on(async {
            let answer = self.json(Method::GET, "/v1/status", Bytes::new());
            tokio::time::timeout(STATUS_TIMEOUT, answer).await.unwrap_or_else(|_| {
                let seconds = STATUS_TIMEOUT.as_secs();
                let message = format!("gleaner-orchestrator has not answered for {seconds} s");
                Err(Failure::new(Exit::Unreachable, message))
            })
        })
    }

    /// Sends a request with a body of JSON, and returns the answer.
    pub(super) fn post<T: DeserializeOwned>(
        &self,
        path: &str,
        body: &impl Serialize,
    ) -> Result<T, Failure> {
        let body = serde_json::to_vec(body).expect("a request is plain data");
        self.runtime.block_on(self.json(Method::POST, path, body.into()))
    }

    /// Sends a request to remove something.
    pub(super) fn delete(&self, path: &str) -> Result<(), Failure> {
        self.runtime.block_on(async {
            let body = Either::Left(Full::default());
            self.request(Method::DELETE, path, body).await.map(drop)
        })
    }

    /// Sends bytes.
    pub(super) fn put(&self, path: &str, body: Vec<u8>) -> Result<(), Failure> {
        self.runtime.block_on(async {
            let body = Either::Left(Full::new(body.into()));
            self.request(Method::PUT, path, body).await.map(drop)
        })
    }

    /// Sends a file.
    pub(super) fn put_file(&self, path: &str, file: std::fs::File) -> Result<(), Failure> {
        self.runtime.block_on(async {
            let body = Either::Right(FileBody::new(file));
            self.request(Method::PUT, path, body).await.map(drop)
        })
    }

    /// Calls `take` with each line of an answer, until its end.
    pub(super) fn lines(
        &self,
        path: &str,
        mut take: impl FnMut(&str) -> Result<(), Failure>,
    ) -> Result<(), Failure> {
        self.runtime.block_on(async {
            let body = Either::Left(Full::default());
            let mut body = self.request(Method::GET, path, body).await?.into_body();
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

    async fn json<T: DeserializeOwned>(
        &self,
        method: Method,
        path: &str,
        body: Bytes,
    ) -> Result<T, Failure> {
        let answer = self.request(method, path, Either::Left(Full::new(body))).await?;
        let body = self.whole(answer.into_body()).await?;
        serde_json::from_slice(&body).map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot parse the answer", &error)
                .with_help("use the `gleaner` of the version of gleaner-orchestrator")
        })
    }

    /// Sends a request; returns its answer if that is no error.
    async fn request(
        &self,
        method: Method,
        path: &str,
        body: Either<Full<Bytes>, FileBody>,
    ) -> Result<Response<Incoming>, Failure> {
        let stream = UnixStream::connect(&self.socket)
            .await
            .map_err(|error| unreachable(&self.socket, &error))?;
        let (mut sender, connection) =
            http1::handshake(TokioIo::new(stream)).await.map_err(|error| self.lost(&error))?;
        tokio::spawn(connection);
        let request = Request::builder().method(method).uri(path).header("host", "vehicle");
        let request = request.body(body).map_err(|error| {
            Failure::caused_by(Exit::Usage, format!("`{path}` is no request"), &error)
        })?;
        let answer = sender.send_request(request).await.map_err(|error| self.lost(&error))?;
        if answer.status().is_success() {
            return Ok(answer);
        }
        let status = answer.status();
        let problem = serde_json::from_slice::<Problem>(&self.whole(answer.into_body()).await?);
        Err(problem.map_or_else(
            |_| Failure::new(Exit::Internal, format!("gleaner-orchestrator answers {status}")),
            Failure::from,
        ))
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
        let socket = self.socket.display();
        let message = format!("an answer at `{socket}` has more than {ANSWER_MAX}");
        Failure::new(Exit::Internal, message).with_help(
            "check that gleaner-orchestrator serves this socket, in the version of `gleaner`",
        )
    }

    fn lost(&self, error: &dyn std::error::Error) -> Failure {
        let action = format!("lost the connection to `{}`", self.socket.display());
        Failure::caused_by(Exit::Unreachable, action, error)
    }
}

fn unreachable(socket: &Path, error: &std::io::Error) -> Failure {
    let action = format!("cannot reach gleaner-orchestrator at `{}`", socket.display());
    let help = match error.kind() {
        std::io::ErrorKind::PermissionDenied => {
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
mod tests {
    use std::io::{Read, Write};
    use std::os::unix::net::UnixListener;
    use std::thread;

    use super::*;

    /// Serves an answer that never ends, to one request.
    fn serve_without_end(listener: &UnixListener, status: &str) {
        let (mut stream, _) = listener.accept().unwrap();
        let (mut request, mut byte) = (Vec::new(), [0]);
        while !request.ends_with(b"\r\n\r\n") {
            stream.read_exact(&mut byte).unwrap();
            request.push(byte[0]);
        }
        let head = format!("HTTP/1.1 {status}\r\ncontent-type: application/json\r\n\r\n");
        stream.write_all(head.as_bytes()).unwrap();
        let piece = vec![b' '; 1 << 20];
        while stream.write_all(&piece).is_ok() {}
    }

    #[test]
    fn an_answer_without_end_is_refused_with_its_socket_and_the_maximum() {
        let folder = tempfile::tempdir().unwrap();
        let listener = UnixListener::bind(folder.path().join(API_SOCKET)).unwrap();
        let args = VehicleArgs { run_dir: Some(folder.path().to_owned()), json: true };
        type Request = fn(&VehicleClient) -> Result<(), Failure>;
        let requests: [(&str, Request); 3] = [
            ("200 OK", |client| client.status().map(drop)),
            ("500 Internal Server Error", |client| client.delete("/v1/deployments/id")),
            ("200 OK", |client| client.lines("/v1/events", |_| Ok(()))),
        ];
        for (status, request) in requests {
            let failure = thread::scope(|scope| {
                let served = scope.spawn(|| serve_without_end(&listener, status));
                let client = VehicleClient::new(&args).unwrap();
                let failure = request(&client).unwrap_err().to_string();
                // It closes the connection.
                drop(client);
                served.join().unwrap();
                failure
            });
            for part in ["control.sock` has more than 64 MiB", "help:"] {
                assert!(failure.contains(part), "{failure}");
            }
        }
    }
}
