//! The connection to `gleaner-orchestrator`: requests over its socket.

use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::Bytes;
use gleaner_base::{Exit, Failure};
use gleaner_protocol::vehicle_api::{API_SOCKET, Problem, VehicleStatus};
use http_body_util::{BodyExt, Either, Full, Limited};
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

/// Longest answer, in bytes: that of a thousand lambdas takes some MiB.
const ANSWER_MAX: usize = 64 << 20;

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
                text.extend_from_slice(frame.data_ref().map_or(&[], |data| data));
                while let Some(end) = text.iter().position(|byte| *byte == b'\n') {
                    let line: Vec<u8> = text.drain(..=end).collect();
                    take(String::from_utf8_lossy(&line).trim_end())?;
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
        let body = Limited::new(answer.into_body(), ANSWER_MAX).collect().await;
        let body = body.map_err(|error| self.lost(&*error))?;
        serde_json::from_slice(&body.to_bytes()).map_err(|error| {
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
        let bytes = answer.into_body().collect().await.map_err(|error| self.lost(&error))?;
        let problem = serde_json::from_slice::<Problem>(&bytes.to_bytes());
        Err(problem.map_or_else(
            |_| Failure::new(Exit::Internal, format!("gleaner-orchestrator answers {status}")),
            Failure::from,
        ))
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
