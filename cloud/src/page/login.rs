//! Login by code or by password, and logout.

use axum::extract::{Extension, State};
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Redirect, Response};
use gleaner_fleet::listener::ClientNetwork;
use maud::{Markup, html};

use super::guard::PostedForm;
use super::layout::{self, PageResult, failure, with_status};
use super::session::{Call, PageUser, Visit, session_of, set_cookie};
use crate::cloud::{Cloud, Services};
use crate::error::CloudError;

pub(super) async fn page(State(cloud): Services, headers: HeaderMap) -> PageResult {
    match PageUser::of(&cloud, &headers).await? {
        Some(_) => Ok(Redirect::to("/vehicles").into_response()),
        None => Ok(login_page(html! {})),
    }
}

fn login_page(message: Markup) -> Response {
    let body = html! {
        h1 { "Log in" }
        (message)
        div.pair {
            section.card aria-labelledby="by-password" {
                h2 id="by-password" { "By password" }
                form method="post" action="/login/password" {
                    label for="name" { "Name" }
                    input id="name" name="name" autocomplete="username" required maxlength="64";
                    label for="password" { "Password" }
                    input id="password" name="password" type="password" required maxlength="256"
                        autocomplete="current-password";
                    button { "Log in" }
                }
            }
            section.card aria-labelledby="by-code" {
                h2 id="by-code" { "By code" }
                form method="post" action="/login/code" {
                    label for="code" { "One-time code" }
                    input id="code" name="code" autocomplete="one-time-code" required
                        maxlength="100" spellcheck="false" autocapitalize="off"
                        aria-describedby="code-help";
                    p.help id="code-help" {
                        "The cloud prints one when it starts for the first time. Later an \
                         administrator gives you one. It works once."
                    }
                    button { "Log in" }
                }
            }
        }
    };
    layout::page("Log in", "", None, body)
}

pub(super) async fn by_code(
    State(cloud): Services,
    Extension(network): Extension<ClientNetwork>,
    Extension(fields): PostedForm,
    headers: HeaderMap,
) -> PageResult {
    let opened = cloud.store.open_session(fields.get("code").trim()).await?;
    let help = "a code works once, for 24 hours: let an administrator invite you again";
    let wrong_secrets = &cloud.accounts.wrong_secrets;
    match wrong_secrets.check(network, opened, "the code is not valid", help) {
        Ok((session, name)) => {
            let has_password = cloud.store.password(&name).await?.is_some();
            let to = if has_password { "/vehicles" } else { "/account?done=first" };
            enter(&cloud, &headers, &session, to).await
        }
        Err(error) => Ok(answer(error)),
    }
}

pub(super) async fn by_password(
    State(cloud): Services,
    Extension(network): Extension<ClientNetwork>,
    Extension(fields): PostedForm,
    headers: HeaderMap,
) -> PageResult {
    let secrets = (fields.get("name").trim(), fields.get("password"));
    match cloud.accounts.open_session(network, secrets).await {
        Ok(session) => enter(&cloud, &headers, &session, "/vehicles").await,
        Err(error) => Ok(answer(error)),
    }
}

fn answer(error: CloudError) -> Response {
    with_status(error.status(), login_page(failure(error)))
}

/// Answers with a new session. The browser's former one ends: it never becomes that of a user.
async fn enter(cloud: &Cloud, headers: &HeaderMap, session: &str, to: &str) -> PageResult {
    if let Some(former) = session_of(headers) {
        cloud.store.close_session(&former).await?;
    }
    let cookie = set_cookie(headers, Some(session));
    Ok(([(header::SET_COOKIE, cookie)], Redirect::to(to)).into_response())
}

pub(super) async fn logout(Call(cloud, user): Visit, headers: HeaderMap) -> PageResult {
    cloud.store.close_session(user.session()).await?;
    let cookie = set_cookie(&headers, None);
    Ok(([(header::SET_COOKIE, cookie)], Redirect::to("/login")).into_response())
}
