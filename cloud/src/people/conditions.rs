//! Headers that make a request conditional: `Idempotency-Key`, `If-Match` and `If-None-Match`.
//!
//! The `ETag` of a deployment has two parts: its version, which is a digest of what people and
//! waves want of it, and a digest of the whole answer. `If-Match` compares the version only: a
//! change is not refused because vehicles have made progress meanwhile.

use axum::body::Bytes;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use gleaner_trust::sha256;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::error::{CloudError, CloudResult};
use crate::request::parsed;
use crate::store::{ChangeAuthor, RequestKey, TokenUser};

/// The header with the key of a request.
pub(super) const KEY: &str = "idempotency-key";

/// Longest key and longest list of tags, in bytes.
const KEY_MAX: usize = 128;
const TAGS_MAX: usize = 4 << 10;

#[derive(Debug, Default)]
pub(super) struct ChangeConditions {
    key: Option<RequestKey>,
    versions: Option<Vec<String>>,
}

impl ChangeConditions {
    /// Parses the key of a request that creates something.
    fn of_new(headers: &HeaderMap, path: &str, body: &[u8]) -> CloudResult<Self> {
        let Some(name) = headers.get(KEY) else { return Ok(Self::default()) };
        let is_key = |it: &&str| {
            (1..=KEY_MAX).contains(&it.len()) && it.bytes().all(|byte| byte.is_ascii_graphic())
        };
        let name = name.to_str().ok().filter(is_key);
        let (Some(name), 1) = (name, headers.get_all(KEY).iter().count()) else {
            let help = "use 1 to 128 visible ASCII characters, as of a UUID, and one key";
            return Err(CloudError::usage("the header `Idempotency-Key` has no key", help));
        };
        let request = sha256(&[path.as_bytes(), &[0], body].concat()).to_string();
        let key = RequestKey { name: name.to_owned(), request };
        Ok(Self { key: Some(key), versions: None })
    }

    /// Parses the versions that a change may replace.
    pub(super) fn of_change(headers: &HeaderMap) -> CloudResult<Self> {
        let Some(tags) = tags(headers, header::IF_MATCH)? else { return Ok(Self::default()) };
        let strong = tags.iter().filter(|tag| !tag.starts_with("W/"));
        let version = |tag: &String| {
            let text = tag.trim_matches('"');
            text.split_once('.').map_or(text, |(version, _)| version).to_owned()
        };
        Ok(Self { key: None, versions: Some(strong.map(version).collect()) })
    }

    /// Returns them with the user who makes the change.
    pub(super) fn by<'c>(&'c self, user: &'c TokenUser) -> ChangeAuthor<'c> {
        let (versions, key) = (self.versions.as_deref(), self.key.as_ref());
        ChangeAuthor { name: &user.actor, user: &user.user.name, key, versions }
    }
}

/// Returns the key of a request that creates something, and its content, which is named `what`.
pub(super) fn created<T: DeserializeOwned>(
    headers: &HeaderMap,
    path: &str,
    (body, what): (&Bytes, &str),
) -> CloudResult<(ChangeConditions, T)> {
    Ok((ChangeConditions::of_new(headers, path, body)?, parsed(body, what)?))
}

/// Returns an answer of JSON with its tag, or that the client has it already. `version` is the
/// first part of the tag.
pub(super) fn tagged(
    headers: &HeaderMap,
    version: &str,
    answer: &impl Serialize,
) -> CloudResult<Response> {
    let text = serde_json::to_string(answer).unwrap_or_default();
    let digest = sha256(text.as_bytes()).to_string().split_off(48);
    let dot = if version.is_empty() { "" } else { "." };
    let tag = format!("\"{version}{dot}{digest}\"");
    let has = tags(headers, header::IF_NONE_MATCH)?
        .is_some_and(|tags| tags.iter().any(|it| it == "*" || it.trim_start_matches("W/") == tag));
    let etag = [(header::ETAG, tag)];
    Ok(match has {
        true => (StatusCode::NOT_MODIFIED, etag).into_response(),
        false => (etag, [(header::CONTENT_TYPE, "application/json")], text).into_response(),
    })
}

/// Returns the tags of a header; `None` without it, or if `If-Match` accepts any.
fn tags(headers: &HeaderMap, name: header::HeaderName) -> CloudResult<Option<Vec<String>>> {
    let mut tags = Vec::new();
    let refused = || {
        let message = format!("the header `{name}` has no list of tags");
        CloudError::usage(message, "use the `ETag` of an answer as it is, with its quotes")
    };
    let values = headers.get_all(&name);
    if values.iter().next().is_none() {
        return Ok(None);
    }
    for value in values {
        let text = value.to_str().ok().filter(|text| text.len() <= TAGS_MAX).ok_or_else(refused)?;
        for tag in text.split(',').map(str::trim) {
            let opaque = tag.trim_start_matches("W/");
            let is_tag = opaque.len() >= 2 && opaque.starts_with('"') && opaque.ends_with('"');
            match tag {
                "*" if name == header::IF_MATCH => return Ok(None),
                "*" => tags.push(tag.to_owned()),
                _ if is_tag => tags.push(tag.to_owned()),
                _ => return Err(refused()),
            }
        }
    }
    Ok(Some(tags))
}
