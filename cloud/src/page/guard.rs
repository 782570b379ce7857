//! The door of every page: sessions, roles, and forms that come from a page of the session.

use std::collections::HashMap;
use std::sync::Arc;

use axum::body::{Body, to_bytes};
use axum::extract::{Extension, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Redirect, Response};
use gleaner_fleet::people::Role;

use super::layout::PageError;
use super::session::{PageUser, check_origin};
use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};

pub(super) const FORM_MAX: usize = 16 << 10;

/// Scripts, styles and pictures come from this program only, and no other site can frame a page.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; \
                      connect-src 'self'; form-action 'self'; base-uri 'none'; \
                      frame-ancestors 'none'";

const HEADERS: [(HeaderName, &str); 6] = [
    (header::CONTENT_SECURITY_POLICY, POLICY),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    // With `no-referrer`, browsers would send forms without their origin.
    (header::REFERRER_POLICY, "same-origin"),
    (header::X_FRAME_OPTIONS, "DENY"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
];

#[derive(Debug, Clone, Default)]
pub(super) struct FormFields(HashMap<String, String>);

pub(super) type PostedForm = Extension<FormFields>;

impl FormFields {
    pub(super) fn role(&self) -> CloudResult<Role> {
        self.get("role").parse().map_err(|error: String| {
            CloudError::usage("the role is not known", "choose one of the list").because(error)
        })
    }

    /// Returns a field; empty without one.
    pub(super) fn get(&self, name: &str) -> &str {
        self.0.get(name).map_or("", String::as_str)
    }
}

/// A request, or the answer that comes without a page.
enum Admission {
    In(Request),
    Out(Response),
}

/// Lets requests pass that have a session with the role, and forms that a page of it has sent.
pub(super) async fn guard(
    State((cloud, role)): State<(Arc<Cloud>, Option<Role>)>,
    request: Request,
    next: Next,
) -> Response {
    secured(match admit(&cloud, role, request).await {
        Ok(Admission::In(request)) => next.run(request).await,
        Ok(Admission::Out(reply)) => reply,
        Err(error) => PageError(error).into_response(),
    })
}

pub(super) fn secured(mut reply: Response) -> Response {
    let headers = reply.headers_mut();
    for (name, value) in HEADERS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.entry(header::CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    reply
}

async fn admit(cloud: &Cloud, role: Option<Role>, request: Request) -> CloudResult<Admission> {
    let (mut parts, body) = request.into_parts();
    let is_form = parts.method != Method::GET && parts.method != Method::HEAD;
    if is_form {
        check_origin(&parts.headers)?;
    }
    let user = match role {
        None => None,
        Some(_) => match PageUser::of(cloud, &parts.headers).await? {
            None => return to_login(&parts.headers).map(Admission::Out),
            user => user,
        },
    };
    let body = match is_form {
        false => body,
        true => {
            let fields = fields(body).await?;
            if user.as_ref().is_some_and(|user| !user.sent(fields.get("token"))) {
                let message = "the form does not belong to this session";
                return Err(CloudError::denied(message, "open the page again, and send it there"));
            }
            parts.extensions.insert(fields);
            Body::empty()
        }
    };
    if let (Some(user), Some(role)) = (user, role) {
        if user.user.role < role {
            let user = user.user;
            let message =
                format!("user `{}` has the role {}, and this needs {role}", user.name, user.role);
            let help = "let an administrator invite you with that role";
            return Err(CloudError::denied(message, help));
        }
        parts.extensions.insert(user);
    }
    Ok(Admission::In(Request::from_parts(parts, body)))
}

/// Returns the answer without a session: scripts load the whole page, and streams end.
fn to_login(headers: &HeaderMap) -> CloudResult<Response> {
    let accepts = headers.get(header::ACCEPT).and_then(|it| it.to_str().ok());
    if accepts.is_some_and(|it| it.contains("text/event-stream")) {
        return Err(CloudError::unknown("the session has ended", "log in again"));
    }
    Ok(match headers.contains_key("hx-request") {
        true => (StatusCode::UNAUTHORIZED, [("hx-redirect", "/login")]).into_response(),
        false => Redirect::to("/login").into_response(),
    })
}

async fn fields(body: Body) -> CloudResult<FormFields> {
    let bytes = to_bytes(body, FORM_MAX).await.map_err(|error| {
        CloudError::usage("the form cannot be read", "send less than 16 KiB").because(error)
    })?;
    Ok(FormFields(form_urlencoded::parse(&bytes).into_owned().collect()))
}
