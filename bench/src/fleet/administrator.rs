//! The person of the bench: enrols vehicles, deploys, and reads what is stored.

use std::net::SocketAddr;

use gleaner_fleet::Enrolment;
use gleaner_fleet::people::{Login, NewVehicle, UserToken};
use http_body_util::{BodyExt, Full};
use hyper::body::Bytes;
use hyper::client::conn::http1::{self, SendRequest};
use hyper::{Method, Request, StatusCode};
use hyper_util::rt::TokioIo;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;

/// Sends one request over a connection; returns the status and the body of the answer.
pub async fn send(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    request: Request<Full<Bytes>>,
) -> Result<(StatusCode, Bytes), String> {
    answer(&mut requests(stream).await?, request).await
}

/// Begins to use a connection for requests.
pub async fn requests(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
) -> Result<SendRequest<Full<Bytes>>, String> {
    let handshake = http1::handshake(TokioIo::new(stream)).await;
    let (sender, connection) = handshake.map_err(|error| error.to_string())?;
    tokio::spawn(connection);
    Ok(sender)
}

/// Sends a request over a connection that may have served others.
pub async fn answer(
    sender: &mut SendRequest<Full<Bytes>>,
    request: Request<Full<Bytes>>,
) -> Result<(StatusCode, Bytes), String> {
    sender.ready().await.map_err(|error| error.to_string())?;
    let reply = sender.send_request(request).await.map_err(|error| error.to_string())?;
    let status = reply.status();
    let body = reply.into_body().collect().await.map_err(|error| error.to_string())?;
    Ok((status, body.to_bytes()))
}

/// An administrator with a token, and one connection.
pub struct Administrator {
    token: String,
    sender: SendRequest<Full<Bytes>>,
}

impl Administrator {
    /// Logs in with a one-time code; returns the token.
    pub async fn login(address: SocketAddr, code: &str) -> Result<String, String> {
        let mut stranger = Self::connect(address, "").await?;
        let login = Login { code: code.to_owned() };
        let session: UserToken = stranger.call(Method::POST, "/v1/login", &login).await?;
        Ok(session.token)
    }

    /// Connects with a token.
    pub async fn connect(address: SocketAddr, token: &str) -> Result<Self, String> {
        let stream = TcpStream::connect(address).await.map_err(|error| error.to_string())?;
        Ok(Self { token: token.to_owned(), sender: requests(stream).await? })
    }

    /// Sends a request that must succeed, with a further header; returns the body of the answer.
    pub async fn bytes(
        &mut self,
        method: Method,
        path: &str,
        header: Option<(&'static str, String)>,
        body: Vec<u8>,
    ) -> Result<Bytes, String> {
        let mut request = Request::builder()
            .method(method)
            .uri(path)
            .header("host", "cloud")
            .header("authorization", format!("Bearer {}", self.token));
        if let Some((name, value)) = header {
            request = request.header(name, value);
        }
        let request =
            request.body(Full::new(Bytes::from(body))).map_err(|error| error.to_string())?;
        let (status, body) = answer(&mut self.sender, request).await?;
        match status.is_success() {
            true => Ok(body),
            false => Err(format!("{path}: {status} {}", String::from_utf8_lossy(&body))),
        }
    }

    /// Sends a request of JSON that must succeed; returns the answer.
    pub async fn call<T: DeserializeOwned>(
        &mut self,
        method: Method,
        path: &str,
        body: &impl Serialize,
    ) -> Result<T, String> {
        let body = serde_json::to_vec(body).map_err(|error| error.to_string())?;
        let answer = self.bytes(method, path, None, body).await?;
        serde_json::from_slice(&answer).map_err(|error| format!("{path}: {error}"))
    }

    /// Reads an answer of JSON.
    pub async fn get<T: DeserializeOwned>(&mut self, path: &str) -> Result<T, String> {
        let answer = self.bytes(Method::GET, path, None, Vec::new()).await?;
        serde_json::from_slice(&answer).map_err(|error| format!("{path}: {error}"))
    }

    /// Adds a vehicle; returns its enrolment.
    pub async fn invite(&mut self, name: &str) -> Result<Enrolment, String> {
        self.call(Method::POST, "/v1/vehicles", &NewVehicle { name: name.to_owned() }).await
    }
}
