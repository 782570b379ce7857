//! Parts of requests that both listeners parse.

use axum::body::Bytes;
use gleaner_lambda::manifest::Sha256;
use serde::de::DeserializeOwned;

use crate::error::{CloudError, CloudResult};

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
