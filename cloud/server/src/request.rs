//! Parts of requests that both listeners parse.

use std::time::Duration;

use axum::body::Bytes;
use axum::extract::Request;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use gleaner_lambda::manifest::Sha256;
use serde::de::DeserializeOwned;
use tokio::time::timeout;

use crate::error::{CloudError, CloudResult};

/// Time for a request without a file, from its headers to those of the answer.
const IN_TIME: Duration = Duration::from_secs(30);

/// Ends a request that takes too long, for example as its body does not come.
pub(crate) async fn in_time(request: Request, next: Next) -> Response {
    timeout(IN_TIME, next.run(request)).await.unwrap_or_else(|_| {
        CloudError::busy("the request took longer than 30 s", "send it again").into_response()
    })
}

/// Parses the body of a request.
pub(crate) fn parsed<T: DeserializeOwned>(body: &Bytes, what: &str) -> CloudResult<T> {
    serde_json::from_slice(body).map_err(|error| {
        let help = "use a version of gleaner that fits the one of the cloud";
        CloudError::usage(format!("the request is no {what}"), help).because(error)
    })
}

/// Parses a SHA-256 in a path.
pub(crate) fn digest(text: &str) -> CloudResult<Sha256> {
    text.parse().map_err(|_| {
        CloudError::usage("the path has no SHA-256", "use 64 hexadecimal digits, in lower case")
    })
}
