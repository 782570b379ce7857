//! Errors, as people and vehicles get them.

use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use gleaner_base::{Exit, Failure};
use gleaner_protocol::vehicle_api::Problem;

/// A failure with its HTTP status.
#[derive(Debug)]
pub(crate) struct CloudError {
    status: StatusCode,
    failure: Failure,
}

/// A result of this crate.
pub(crate) type CloudResult<T> = Result<T, CloudError>;

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

    /// Creates an error: a request that comes too slowly.
    pub(crate) fn late(message: impl Into<String>, help: &str) -> Self {
        Self::with(StatusCode::REQUEST_TIMEOUT, Exit::Unreachable, message, help)
    }

    fn with(status: StatusCode, exit: Exit, message: impl Into<String>, help: &str) -> Self {
        Self { status, failure: Failure::new(exit, message).with_help(help) }
    }

    /// Returns its HTTP status.
    pub(crate) fn status(&self) -> StatusCode {
        self.status
    }

    /// Adds the cause.
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
        let text = serde_json::to_string(&Problem::from(self.failure)).unwrap_or_default();
        (self.status, [(header::CONTENT_TYPE, "application/problem+json")], text).into_response()
    }
}
