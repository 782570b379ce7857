//! Parts of requests that both listeners parse.

use std::time::Duration;

use axum::body::Bytes;
use axum::extract::Request;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use gleaner_lambda::manifest::Sha256;
use schemars::JsonSchema;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use tokio::time::timeout;

use crate::error::{CloudError, CloudResult};

/// Time for a request without a file, from its headers to those of the answer.
const IN_TIME: Duration = Duration::from_secs(30);

/// Number of entries in a part of a list, and its maximum.
const ENTRIES_MAX: u16 = 500;

/// Choice of a part of a list.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct ListQuery<Cursor> {
    /// `next` of the part before.
    pub(crate) after: Option<Cursor>,
    /// Maximum number of entries.
    #[serde(default)]
    #[schemars(with = "Option<u16>", range(min = 1, max = 500))]
    pub(crate) limit: PageLimit,
}

impl ListQuery<String> {
    pub(crate) fn after(&self) -> &str {
        self.after.as_deref().unwrap_or_default()
    }
}

/// Maximum number of entries in a part of a list.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(try_from = "u16")]
pub(crate) struct PageLimit(u16);

impl PageLimit {
    pub(crate) const fn of(limit: u16) -> Self {
        Self(limit)
    }
}

impl Default for PageLimit {
    fn default() -> Self {
        Self(ENTRIES_MAX)
    }
}

impl TryFrom<u16> for PageLimit {
    type Error = String;

    fn try_from(limit: u16) -> Result<Self, String> {
        match limit {
            1..=ENTRIES_MAX => Ok(Self(limit)),
            _ => Err(format!("a part of a list has 1 to {ENTRIES_MAX} entries, not {limit}")),
        }
    }
}

impl From<PageLimit> for u64 {
    fn from(limit: PageLimit) -> Self {
        limit.0.into()
    }
}

/// Ends a request that takes too long, for example as its body does not come.
pub(crate) async fn in_time(request: Request, next: Next) -> Response {
    timeout(IN_TIME, next.run(request)).await.unwrap_or_else(|_| {
        CloudError::busy("the request took longer than 30 s", "send it again").into_response()
    })
}

pub(crate) fn parsed<T: DeserializeOwned>(body: &Bytes, what: &str) -> CloudResult<T> {
    serde_json::from_slice(body).map_err(|error| {
        let help = "use a version of gleaner that fits the one of the cloud";
        CloudError::usage(format!("cannot parse the {what} in the request"), help).because(error)
    })
}

/// Parses a SHA-256 in a path.
pub(crate) fn digest(text: &str) -> CloudResult<Sha256> {
    text.parse().map_err(|_| {
        CloudError::usage("the path has no SHA-256", "use 64 hexadecimal digits, in lower case")
    })
}
