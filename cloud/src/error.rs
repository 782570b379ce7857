//! Errors, as people and vehicles get them.

use axum::Json;
use axum::body::to_bytes;
use axum::extract::Request;
use axum::http::{StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use gleaner_base::{Exit, Failure};
use gleaner_protocol::vehicle_api::Problem;

use crate::sqlx;

const PROBLEM: &str = "application/problem+json";

/// Time after which a request may be sent again that a limit has refused, in s.
const RETRY_S: &str = "10";

/// Longest text of an error of the framework that is used as a cause.
pub(crate) const TEXT_MAX: usize = 4 << 10;

#[derive(Debug, Clone)]
pub(crate) struct CloudError {
    status: StatusCode,
    failure: Failure,
}

pub(crate) type CloudResult<T> = Result<T, CloudError>;
pub(crate) type JsonResult<T> = CloudResult<Json<T>>;

impl CloudError {
    /// Creates an error: a wrong request.
    pub(crate) fn usage(message: impl Into<String>, help: &str) -> Self {
        Self::with(StatusCode::BAD_REQUEST, Exit::Usage, message, help)
    }

    /// Creates an error: a thing that does not exist.
    pub(crate) fn missing(message: impl Into<String>, help: &str) -> Self {
        Self::with(StatusCode::NOT_FOUND, Exit::Usage, message, help)
    }

    /// Creates an error: a request without a valid token, code or certificate.
    pub(crate) fn unknown(message: impl Into<String>, help: &str) -> Self {
        Self::with(StatusCode::UNAUTHORIZED, Exit::Denied, message, help)
    }

    /// Creates an error: something that is not permitted.
    pub(crate) fn denied(message: impl Into<String>, help: &str) -> Self {
        Self::with(StatusCode::FORBIDDEN, Exit::Denied, message, help)
    }

    /// Creates an error: a limit is reached for now.
    pub(crate) fn busy(message: impl Into<String>, help: &str) -> Self {
        Self::with(StatusCode::TOO_MANY_REQUESTS, Exit::Unreachable, message, help)
    }

    /// Creates an error: a request that contradicts the state, with this status.
    pub(crate) fn conflict(status: StatusCode, message: impl Into<String>, help: &str) -> Self {
        Self::with(status, Exit::Usage, message, help)
    }

    /// Creates an error: a request that comes too slowly.
    pub(crate) fn late(message: impl Into<String>, help: &str) -> Self {
        Self::with(StatusCode::REQUEST_TIMEOUT, Exit::Unreachable, message, help)
    }

    fn with(status: StatusCode, exit: Exit, message: impl Into<String>, help: &str) -> Self {
        Self { status, failure: Failure::new(exit, message).with_help(help) }
    }

    pub(crate) fn status(&self) -> StatusCode {
        self.status
    }

    pub(crate) fn because(mut self, cause: impl ToString) -> Self {
        self.failure.causes.push(cause.to_string());
        self
    }

    /// Returns whether it is an error of the cloud, not of the request.
    pub(crate) fn is_internal(&self) -> bool {
        self.status.is_server_error()
    }

    /// Returns the message with its causes, for a frame that ends a connection.
    pub(crate) fn reason(&self) -> String {
        let parts = std::iter::once(&self.failure.message).chain(&self.failure.causes);
        parts.cloned().collect::<Vec<_>>().join(": ")
    }
}

impl From<Failure> for CloudError {
    fn from(failure: Failure) -> Self {
        let status = match failure.exit {
            Exit::Usage => StatusCode::BAD_REQUEST,
            Exit::Denied => StatusCode::FORBIDDEN,
            Exit::Unreachable => StatusCode::SERVICE_UNAVAILABLE,
            _ => StatusCode::INTERNAL_SERVER_ERROR,
        };
        Self { status, failure }
    }
}

impl From<sqlx::Error> for CloudError {
    fn from(error: sqlx::Error) -> Self {
        // PostgreSQL stores no NUL in a text, and SQLite does.
        if error.as_database_error().and_then(|it| it.code()).as_deref() == Some("22021") {
            let help = "send texts without the character NUL";
            return Self::usage("a text cannot be stored", help);
        }
        database_failure(&error).into()
    }
}

/// Returns the failure for an error of the database, with the way out.
pub(crate) fn database_failure(error: &sqlx::Error) -> Failure {
    let code = error.as_database_error().and_then(|it| it.code()).unwrap_or_default();
    // Codes of PostgreSQL have five characters. The low byte of those of SQLite is the kind.
    let (sqlite, postgres) = match code.len() {
        5 => (None, &*code),
        _ => (code.parse::<u32>().ok().map(|code| code & 0xff), ""),
    };
    let is_away = match error {
        sqlx::Error::Io(_) | sqlx::Error::PoolTimedOut | sqlx::Error::PoolClosed => true,
        // A connection that was lost, a server that stops or starts.
        _ => postgres.starts_with("08") || postgres.starts_with("57P"),
    };
    let (exit, action, help) = match sqlite {
        // It is damaged, or is no database.
        Some(11 | 26) => (
            Exit::Internal,
            "the database, `cloud.db` in the data folder, is damaged",
            "stop the cloud, move `cloud.db`, `cloud.db-wal` and `cloud.db-shm` away, and copy the \
             file of the last `gleaner-cloud backup` to `cloud.db`; `sqlite3 cloud.db .recover` \
             may save what came since",
        ),
        _ if is_away => (
            Exit::Unreachable,
            "the database cannot be reached",
            "check that its server runs, and try again; vehicles and records wait meanwhile",
        ),
        _ => (
            Exit::Internal,
            "the database cannot be used",
            "check that the disk of the database has room, and the log of the cloud",
        ),
    };
    Failure::caused_by(exit, action, error).with_help(help)
}

impl From<CloudError> for Failure {
    fn from(error: CloudError) -> Self {
        error.failure
    }
}

impl IntoResponse for CloudError {
    fn into_response(self) -> Response {
        if self.status.is_server_error() {
            tracing::error!("{}", self.reason());
        }
        let problem = Problem::new(self.failure, self.status.as_u16());
        let text = serde_json::to_string(&problem).unwrap_or_default();
        let retry = [StatusCode::TOO_MANY_REQUESTS, StatusCode::SERVICE_UNAVAILABLE];
        let retry = retry.contains(&self.status).then_some([(header::RETRY_AFTER, RETRY_S)]);
        (self.status, retry, [(header::CONTENT_TYPE, PROBLEM)], text).into_response()
    }
}

pub(crate) fn is_api(path: &str) -> bool {
    path == "/v1" || path.starts_with("/v1/")
}

/// Gives the errors that the framework itself answers below `/v1` the form of all others.
pub(crate) async fn as_problem(request: Request, next: Next) -> Response {
    let is_api = is_api(request.uri().path());
    let answer = next.run(request).await;
    let status = answer.status();
    let is_error = status.is_client_error() || status.is_server_error();
    let has_problem = answer.headers().get(header::CONTENT_TYPE).is_some_and(|it| it == PROBLEM);
    if !is_api || !is_error || has_problem {
        return answer;
    }
    let (message, help) = match status {
        StatusCode::METHOD_NOT_ALLOWED => {
            ("the path has no such method", "use one that the header `Allow` names")
        }
        StatusCode::PAYLOAD_TOO_LARGE => {
            ("the body of the request is too long", "send a shorter one")
        }
        StatusCode::RANGE_NOT_SATISFIABLE => {
            ("the file ends before the range", "begin within the length of `Content-Range`")
        }
        _ => ("the request cannot be used", "`GET /v1/openapi.json` describes all requests"),
    };
    let exit = if status.is_server_error() { Exit::Internal } else { Exit::Usage };
    let mut error = CloudError::with(status, exit, message, help);
    let (mut parts, body) = answer.into_parts();
    let text = to_bytes(body, TEXT_MAX).await.unwrap_or_default();
    if !text.is_empty() {
        error = error.because(String::from_utf8_lossy(&text));
    }
    for name in [header::CONTENT_TYPE, header::CONTENT_LENGTH] {
        parts.headers.remove(name);
    }
    let mut problem = error.into_response();
    problem.headers_mut().extend(parts.headers);
    problem
}
