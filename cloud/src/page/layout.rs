//! The frame of every page: head, navigation, forms and errors.

use axum::body::to_bytes;
use axum::extract::Request;
use axum::http::{StatusCode, header};
use axum::middleware::Next;
use axum::response::{Html, IntoResponse, Response};
use gleaner_base::Failure;
use gleaner_fleet::people::Role;
use maud::{DOCTYPE, Markup, html};

use super::assets;
use super::guard::secured;
use super::session::PageUser;
use super::text::shown;
use crate::error::{CloudError, TEXT_MAX};

/// Settings of htmx: it evaluates no text as a script, and adds no style.
const HTMX: &str = r#"{"includeIndicatorStyles":false,"allowEval":false,"allowScriptTags":false,
"historyCacheSize":0,"selfRequestsOnly":true}"#;

/// The places of the navigation: name, path, and the least role.
const PLACES: [(&str, &str, Role); 6] = [
    ("Fleet", "/vehicles", Role::Viewer),
    ("Clips", "/clips", Role::Viewer),
    ("Deployments", "/deployments", Role::Viewer),
    ("Lambdas", "/lambdas", Role::Viewer),
    ("Access", "/access", Role::Admin),
    ("Audit", "/audit", Role::Admin),
];

pub(super) type PageResult = Result<Response, PageError>;

#[derive(Debug)]
pub(super) struct PageError(pub(super) CloudError);

impl<E: Into<CloudError>> From<E> for PageError {
    fn from(error: E) -> Self {
        Self(error.into())
    }
}

impl IntoResponse for PageError {
    fn into_response(self) -> Response {
        let status = self.0.status();
        if status.is_server_error() {
            tracing::error!("{}", self.0.reason());
        }
        let body = html! {
            h1 { "Something went wrong" }
            (failure(self.0))
            p { a href="/vehicles" { "Go to the fleet" } }
        };
        (status, page("Error", "", None, body)).into_response()
    }
}

/// Gives the errors that the framework itself answers the form of a page.
pub(super) async fn as_page(request: Request, next: Next) -> Response {
    let answer = next.run(request).await;
    let status = answer.status();
    let kind = answer.headers().get(header::CONTENT_TYPE).and_then(|it| it.to_str().ok());
    let is_text = kind.is_none_or(|it| it.starts_with("text/plain"));
    if !is_text || !(status.is_client_error() || status.is_server_error()) {
        return answer;
    }
    let help = "use the links of a page";
    let mut error = CloudError::conflict(status, "the address or the form cannot be used", help);
    let (parts, body) = answer.into_parts();
    let text = to_bytes(body, TEXT_MAX).await.unwrap_or_default();
    if !text.is_empty() {
        error = error.because(String::from_utf8_lossy(&text));
    }
    let mut page = secured(PageError(error).into_response());
    if let Some(allow) = parts.headers.get(header::ALLOW) {
        page.headers_mut().insert(header::ALLOW, allow.clone());
    }
    page
}

pub(super) fn nothing_here() -> Response {
    let error = CloudError::missing("there is no page at this address", "use the links of a page");
    secured(PageError(error).into_response())
}

/// Renders an error: the failed action, its causes, and a way out.
pub(super) fn failure(error: CloudError) -> Markup {
    let Failure { message, causes, help, .. } = error.into();
    html! {
        div.banner.bad role="alert" {
            p { b { "Error: " } (shown(&message)) }
            @for cause in causes { p { "Cause: " (shown(&cause)) } }
            @if let Some(help) = help { p { "Help: " (shown(&help)) } }
        }
    }
}

/// Renders a page. `place` is the path of its place in the navigation.
pub(super) fn page(title: &str, place: &str, user: Option<&PageUser>, body: Markup) -> Response {
    let markup = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                meta name="htmx-config" content=(HTMX);
                title { (shown(title)) " – Gleaner" }
                link rel="icon" type="image/svg+xml" href=(assets::address("icon.svg"));
                link rel="stylesheet" href=(assets::address("page.css"));
                @for script in ["htmx.min.js", "htmx-sse.js", "page.js"] {
                    script src=(assets::address(script)) defer {}
                }
            }
            body {
                a.skip href="#content" { "Skip to the content" }
                header.top {
                    a.logo href="/vehicles" { "Gleaner" }
                    @if let Some(user) = user { (navigation(place, user)) }
                }
                main id="content" tabindex="-1" { (body) }
            }
        }
    };
    ([(header::CACHE_CONTROL, "no-store")], Html(markup.into_string())).into_response()
}

fn navigation(place: &str, user: &PageUser) -> Markup {
    let current = |path: &str| (path == place).then_some("page");
    html! {
        nav aria-label="Pages" {
            @for (name, path, role) in PLACES {
                @if user.user.role >= role {
                    a href=(path) aria-current=[current(path)] { (name) }
                }
            }
        }
        div.account {
            a href="/account" aria-current=[current("/account")] {
                (user.user.name) " " span.dim { "(" (user.user.role) ")" }
            }
            (form(user, "/logout", html! { button.plain { "Log out" } }))
        }
    }
}

/// Renders a form that a page of this session sends.
pub(super) fn form(user: &PageUser, action: &str, content: Markup) -> Markup {
    html! {
        form method="post" action=(action) {
            input type="hidden" name="token" value=(user.form_token());
            (content)
        }
    }
}

/// Renders a form for a change that cannot be undone: its button appears after a first click.
pub(super) fn confirmed(
    user: &PageUser,
    action: &str,
    label: &str,
    warning: &str,
    content: Markup,
) -> Markup {
    html! {
        details.confirm {
            summary { (label) "…" }
            div.card {
                p { (warning) }
                (form(user, action, html! { (content) button.bad { (label) } }))
            }
        }
    }
}

/// Renders the confirmation of a change, which the address names after it was made.
pub(super) fn done(change: Option<&str>) -> Markup {
    let text = match change {
        Some("start") => "Starting on its vehicles; offline ones start it when they reconnect.",
        Some("stop") => "Stopping on its vehicles; offline ones stop it when they reconnect.",
        Some("rollback") => "Rolling back its vehicles; offline ones follow when they reconnect.",
        Some("pause") => "The waves are paused.",
        Some("resume") => "The waves are resumed.",
        Some("abort") => "The waves are aborted.",
        Some("clip") => "The file is wanted: its vehicle sends it as soon as it can.",
        Some("deployment") => "The deployment is removed.",
        Some("user") => "The user is removed, with all sessions and tokens.",
        Some("vehicle") => "The vehicle is revoked.",
        Some("password") => "The password is set. Your other sessions have ended.",
        Some("token") => "The token is removed.",
        Some("first") => "You are logged in. Set a password to log in without a code next time.",
        _ => return html! {},
    };
    html! { p.banner.good role="status" { (text) } }
}

/// Renders a notice in the place of an empty list.
pub(super) fn empty(text: &str) -> Markup {
    html! { p.empty { (text) } }
}

/// Renders links to the parts before and after the part `index` of a list with `total` entries, of
/// which each part has `size`. `address` returns the address of a part.
pub(super) fn parts(
    name: &str,
    index: usize,
    (size, total): (usize, usize),
    address: impl Fn(usize) -> String,
) -> Markup {
    let has_next = (index + 1) * size < total;
    html! {
        @if index > 0 || has_next {
            nav.pages aria-label=(format!("Parts of the list of {name}")) {
                @if index > 0 {
                    a id=(format!("{name}-before")) href=(address(index - 1)) { "Previous" } }
                @if has_next {
                    a id=(format!("{name}-after")) href=(address(index + 1)) { "Next" } }
            }
        }
    }
}

pub(super) fn with_status(status: StatusCode, page: Response) -> Response {
    (status, page).into_response()
}
