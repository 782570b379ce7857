//! Login by code or by password, and logout.

use std::sync::Arc;

use axum::extract::{Extension, State};
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Redirect, Response};
use gleaner_fleet::entrance::ClientNetwork;
use maud::{Markup, html};

use super::guard::FormFields;
use super::layout::{self, PageResult, failure, with_status};
use super::password;
use super::session::{Call, PageUser, Visit, session_of, set_cookie};
use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};

pub(super) async fn page(State(cloud): State<Arc<Cloud>>, headers: HeaderMap) -> PageResult {
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
    State(cloud): State<Arc<Cloud>>,
    Extension(network): Extension<ClientNetwork>,
    Extension(fields): Extension<FormFields>,
    headers: HeaderMap,
) -> PageResult {
    match cloud.store.open_session(fields.get("code").trim()).await? {
        Some((session, name)) => {
            let has_password = cloud.store.password(&name).await?.is_some();
            let to = if has_password { "/vehicles" } else { "/account?done=first" };
            enter(&cloud, &headers, &session, to).await
        }
        None => {
            let help = "a code works once, for 24 hours: let an administrator invite you again";
            Ok(refused(&cloud, network, CloudError::unknown("the code is not valid", help)))
        }
    }
}

pub(super) async fn by_password(
    State(cloud): State<Arc<Cloud>>,
    Extension(network): Extension<ClientNetwork>,
    Extension(fields): Extension<FormFields>,
    headers: HeaderMap,
) -> PageResult {
    match session_by_password(&cloud, network, &fields).await {
        Ok(Some(session)) => enter(&cloud, &headers, &session, "/vehicles").await,
        Ok(None) => {
            let message = "the name or the password is wrong";
            let help = "without a password, log in by a code that an administrator gives you";
            Ok(refused(&cloud, network, CloudError::unknown(message, help)))
        }
        Err(error) => Ok(answer(error)),
    }
}

async fn session_by_password(
    cloud: &Cloud,
    network: ClientNetwork,
    fields: &FormFields,
) -> CloudResult<Option<String>> {
    let (name, password) = (fields.get("name").trim(), fields.get("password"));
    cloud.wrong_secrets.count_password(network, name)?;
    let hash = cloud.store.password(name).await?;
    let is_right = password::is_right(network, password.to_owned(), hash.as_deref()).await?;
    match hash.filter(|_| is_right) {
        Some(hash) => {
            cloud.account_changes.count(name)?;
            cloud.store.open_session_of(name, &hash).await
        }
        None => Ok(None),
    }
}

fn refused(cloud: &Cloud, network: ClientNetwork, error: CloudError) -> Response {
    answer(cloud.wrong_secrets.count(network).err().unwrap_or(error))
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
