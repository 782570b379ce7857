//! Sessions of the page: the cookie, the token in each form, and the origin of a request.

use axum::http::{HeaderMap, HeaderValue, header};
use gleaner_fleet::people::User;

pub(super) use crate::cloud::Call;
use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};

/// Name of the cookie. Behind a proxy with TLS it has a prefix, by which browsers accept it only
/// from this very host and over TLS.
const COOKIE: &str = "gleaner_session";

/// Lifetime of the cookie, in s: that of the session in the database.
const LIFETIME_S: u32 = 12 * 3600;

pub(super) type Visit = Call<PageUser>;

#[derive(Debug, Clone)]
pub(super) struct PageUser {
    pub(super) user: User,
    session: String,
}

impl PageUser {
    /// Returns the user whose session the request has, if it is valid.
    pub(super) async fn of(cloud: &Cloud, headers: &HeaderMap) -> CloudResult<Option<Self>> {
        let Some(session) = session_of(headers) else { return Ok(None) };
        let user = cloud.store.session(&session).await?;
        Ok(user.map(|user| Self { user, session }))
    }

    /// Returns whether the session is still valid, with the same role.
    pub(super) async fn is_current(&self, cloud: &Cloud) -> bool {
        matches!(cloud.store.session(&self.session).await, Ok(Some(user)) if user == self.user)
    }

    pub(super) fn session(&self) -> &str {
        &self.session
    }

    /// Returns the token of this session's forms: only pages of this session have it.
    pub(super) fn form_token(&self) -> String {
        gleaner_trust::sha256(format!("form {}", self.session).as_bytes()).to_string()
    }

    /// Returns whether a form has the token of this session.
    pub(super) fn sent(&self, token: &str) -> bool {
        // Compared by their digests: the time of the comparison depends on no secret.
        let digest = |token: &str| gleaner_trust::sha256(token.as_bytes());
        digest(token) == digest(&self.form_token())
    }
}

pub(super) fn session_of(headers: &HeaderMap) -> Option<String> {
    let name = cookie_name(headers);
    let cookies = headers.get_all(header::COOKIE).iter().filter_map(|it| it.to_str().ok());
    let mut pairs = cookies.flat_map(|all| all.split(';')).filter_map(|it| it.split_once('='));
    let session = pairs.find(|(found, _)| found.trim() == name).map(|(_, value)| value.trim());
    session.filter(|it| it.len() < 128).map(str::to_owned)
}

/// Returns the header that sets the session's cookie, or removes it without a session.
pub(super) fn set_cookie(headers: &HeaderMap, session: Option<&str>) -> HeaderValue {
    let name = cookie_name(headers);
    let secure = if is_secure(headers) { "; Secure" } else { "" };
    let (value, age) = session.map_or(("", 0), |session| (session, LIFETIME_S));
    let text = format!("{name}={value}; Path=/; HttpOnly; SameSite=Strict; Max-Age={age}{secure}");
    // Sessions are letters, digits and `_`.
    HeaderValue::from_str(&text).unwrap_or(HeaderValue::from_static(""))
}

fn cookie_name(headers: &HeaderMap) -> String {
    let prefix = if is_secure(headers) { "__Host-" } else { "" };
    format!("{prefix}{COOKIE}")
}

/// Returns whether the request came through a proxy with TLS, as the proxy states. A client that
/// states it itself gets a cookie that it does not send without TLS, and nothing else.
fn is_secure(headers: &HeaderMap) -> bool {
    let proto = headers.get("x-forwarded-proto").and_then(|it| it.to_str().ok());
    // Of several proxies, the first one is the nearest to the browser.
    let first = proto.and_then(|all| all.split(',').next());
    first.is_some_and(|it| it.trim().eq_ignore_ascii_case("https"))
}

/// Refuses a change that a page of another origin has sent. Browsers state the origin of each form.
pub(super) fn check_origin(headers: &HeaderMap) -> CloudResult<()> {
    let text = |name: &str| headers.get(name).and_then(|it| it.to_str().ok());
    let is_same = match (text("sec-fetch-site"), text("origin")) {
        (Some(site), _) => site == "same-origin",
        (None, Some(origin)) => {
            let host = origin.split_once("://").map(|(_, host)| host);
            host.is_some() && host == text("host")
        }
        (None, None) => false,
    };
    match is_same {
        true => Ok(()),
        false => Err(CloudError::denied(
            "the form was sent by a page of another site",
            "open the page of the cloud, and send the form there",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(&'static str, &'static str)]) -> HeaderMap {
        pairs
            .iter()
            .map(|(name, value)| {
                (header::HeaderName::from_static(name), HeaderValue::from_static(value))
            })
            .collect()
    }

    #[test]
    fn only_forms_of_the_same_origin_are_accepted() {
        let ok = |pairs: &[_]| check_origin(&headers(pairs)).is_ok();
        assert!(ok(&[("sec-fetch-site", "same-origin")]));
        assert!(ok(&[("origin", "https://cloud:1"), ("host", "cloud:1")]));
        for wrong in ["cross-site", "same-site", "none"] {
            let host = [("origin", "http://cloud"), ("host", "cloud")];
            assert!(!ok(&[&[("sec-fetch-site", wrong)], &host[..]].concat()), "{wrong}");
        }
        assert!(!ok(&[("origin", "http://evil"), ("host", "cloud")]));
        assert!(!ok(&[("origin", "null"), ("host", "cloud")]));
        assert!(!ok(&[("host", "cloud")]));
    }

    #[test]
    fn behind_a_proxy_with_tls_the_cookie_stays_there() {
        let plain = set_cookie(&headers(&[]), Some("gls_1"));
        assert_eq!(
            plain.to_str().unwrap(),
            "gleaner_session=gls_1; Path=/; HttpOnly; SameSite=Strict; Max-Age=43200"
        );
        let tls = [("x-forwarded-proto", "https"), ("cookie", "a=b; __Host-gleaner_session=gls_2")];
        let cookie = set_cookie(&headers(&tls), Some("gls_2"));
        let cookie = cookie.to_str().unwrap();
        assert!(cookie.starts_with("__Host-gleaner_session=gls_2;"), "{cookie}");
        assert!(cookie.ends_with("; Secure"), "{cookie}");
        assert_eq!(session_of(&headers(&tls)).as_deref(), Some("gls_2"));
        let without = [("x-forwarded-proto", "https"), ("cookie", "gleaner_session=gls_2")];
        assert_eq!(session_of(&headers(&without)), None);
    }
}
