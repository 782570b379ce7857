//! Conditions of a change: the key by which it is made once, and the versions that it may replace.

use axum::http::StatusCode;

use super::{StoreChange, now};
use crate::error::{CloudError, CloudResult};

/// Time for which the key of a request is kept, in s.
const KEPT_S: i64 = 86_400;

/// A key that names a request, so that it has its effect once.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct RequestKey {
    pub(crate) name: String,
    /// SHA-256 of the request.
    pub(crate) request: String,
}

/// The user who makes a change, with the conditions of the request.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ChangeAuthor<'r> {
    /// Name in the audit trail.
    pub(crate) name: &'r str,
    /// Name of the user, of whom the key is.
    pub(crate) user: &'r str,
    pub(crate) key: Option<&'r RequestKey>,
    /// The versions of the deployment that the change may replace; any without a list.
    pub(crate) versions: Option<&'r [String]>,
}

impl<'r, N: AsRef<str> + ?Sized> From<&'r N> for ChangeAuthor<'r> {
    fn from(name: &'r N) -> Self {
        let name = name.as_ref();
        Self { name, user: name, key: None, versions: None }
    }
}

impl StoreChange<'_> {
    /// Begins a request with a key; returns the answer if it was carried out before.
    /// Fails if another request had the key, or if the answer had a secret, which is not kept.
    pub(super) async fn begin_request(
        &mut self,
        author: ChangeAuthor<'_>,
    ) -> CloudResult<Option<String>> {
        let Some(RequestKey { name, request }) = author.key else { return Ok(None) };
        run!(self; "DELETE FROM request_keys WHERE time <= $1"; now() - KEPT_S);
        // A request at the same time waits here, or for its turn, until this one has ended.
        let added = run!(self; "INSERT INTO request_keys (actor, name, request, time) VALUES ($1,
             $2, $3, $4) ON CONFLICT (actor, name) DO NOTHING"; author.user, name, request, now());
        if added.rows_affected() > 0 {
            return Ok(None);
        }
        let (stored, answer): (String, String) = one!(self; "SELECT request, answer
             FROM request_keys WHERE actor = $1 AND name = $2"; author.user, name);
        if stored != *request {
            let message = "another request had the same `Idempotency-Key`";
            let help = "use a new key for each request, and the same one to repeat it";
            return Err(CloudError::conflict(StatusCode::UNPROCESSABLE_ENTITY, message, help));
        }
        if answer.is_empty() {
            let message = "the request was carried out, and its secret is not kept";
            let help = "send it with another key: that makes a new secret, and ends the first one";
            return Err(CloudError::conflict(StatusCode::CONFLICT, message, help));
        }
        Ok(Some(answer))
    }
}

#[cfg(test)]
impl super::CloudStore {
    pub(crate) async fn kept_answers(&self) -> Vec<String> {
        let rows: CloudResult<_> =
            async { Ok(rows!(self; "SELECT answer FROM request_keys")) }.await;
        rows.unwrap()
    }
}
