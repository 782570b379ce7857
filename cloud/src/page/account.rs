//! The account of a user: the password, and the tokens for programs.

use axum::extract::{Extension, Path, Query};
use axum::response::{IntoResponse, Redirect};
use gleaner_fleet::people::{NewToken, TOKEN_DAYS_MAX, TokenSummary};
use maud::{Markup, html};
use serde::Deserialize;

use super::access::ROLES;
use super::guard::PostedForm;
use super::layout::{self, PageResult, confirmed, done, failure, form, with_status};
use super::session::{Call, PageUser, Visit};
use super::text::{segment, shown, time};
use crate::cloud::Cloud;
use crate::error::CloudError;
use crate::store::{TOKENS_MAX, TokenUser};

/// The change that was made before a page is shown.
#[derive(Debug, Deserialize)]
pub(super) struct CompletedChange {
    pub(super) done: Option<String>,
}

pub(super) async fn page(
    Call(cloud, user): Visit,
    Query(query): Query<CompletedChange>,
) -> PageResult {
    account_page(&cloud, &user, done(query.done.as_deref())).await
}

async fn account_page(cloud: &Cloud, user: &PageUser, message: Markup) -> PageResult {
    let most = TOKENS_MAX.unsigned_abs();
    let has_password = cloud.store.password(&user.user.name).await?.is_some();
    let title = if has_password { "Change your password" } else { "Set a password" };
    let body = html! {
        h1 { "Your account" }
        (message)
        section.card.narrow aria-labelledby="password-title" {
            h2 id="password-title" { (title) }
            (form(user, "/account/password", html! {
                // Password managers store it under this name.
                input type="hidden" name="name" value=(user.user.name) autocomplete="username";
                label for="password" { "New password" }
                input id="password" name="password" type="password" required minlength="12"
                    maxlength="256" autocomplete="new-password" aria-describedby="password-help";
                p.help id="password-help" { "12 characters or more, such as four random words." }
                label for="again" { "New password again" }
                input id="again" name="again" type="password" required minlength="12"
                    maxlength="256" autocomplete="new-password";
                button { (title) }
            }))
        }
        (tokens(user, &cloud.store.tokens(Some(&user.user.name), "", most).await?))
    };
    Ok(layout::page("Account", "/account", Some(user), body))
}

pub(super) async fn set_password(
    Call(cloud, user): Visit,
    Extension(fields): PostedForm,
) -> PageResult {
    let new = fields.get("password");
    let hash = async {
        if new != fields.get("again") {
            return Err(CloudError::usage("the two passwords differ", "type the same one twice"));
        }
        cloud.accounts.hashed(&user.user.name, new).await
    };
    match hash.await {
        Ok(hash) => {
            cloud.store.set_password(&user.user.name, &hash, user.session()).await?;
            Ok(Redirect::to("/account?done=password").into_response())
        }
        Err(error) => refused(&cloud, &user, error).await,
    }
}

async fn refused(cloud: &Cloud, user: &PageUser, error: CloudError) -> PageResult {
    let status = error.status();
    let page = account_page(cloud, user, failure(error)).await?;
    Ok(with_status(status, page))
}

fn tokens(user: &PageUser, all: &[TokenSummary]) -> Markup {
    html! {
        section aria-labelledby="tokens" {
            h2 id="tokens" { "Tokens for programs" }
            @if all.is_empty() { (layout::empty("No tokens.")) }
            ul.rows { @for it in all {
                li.card {
                    span { b { (shown(&it.name)) } " " span.dim { (it.role) ", expires "
                        (time(it.expires)) } }
                    (confirmed(user, &format!("/account/tokens/{}/remove", segment(&it.name)),
                        "Remove", &format!("Programs that use {} are refused at once.", it.name),
                        html! {}))
                }
            } }
        }
        section.card.narrow aria-labelledby="new-token" {
            h2 id="new-token" { "Create a token" }
            (form(user, "/account/tokens", html! {
                label for="token-name" { "Name" }
                input id="token-name" name="name" required maxlength="64" autocomplete="off"
                    spellcheck="false" aria-describedby="token-help";
                p.help id="token-help" {
                    "Letters, digits and ._- are allowed, as in nightly-export. Tokens cannot \
                     create tokens."
                }
                label for="token-role" { "Role" }
                select id="token-role" name="role" {
                    @for (role, may) in ROLES.into_iter().filter(|(it, _)| *it <= user.user.role) {
                        option value=(role) { (role) ": " (may) }
                    }
                }
                label for="token-days" { "Expires in (days)" }
                input id="token-days" name="days" type="number" required min="1"
                    max=(TOKEN_DAYS_MAX) value="90";
                button { "Create" }
            }))
        }
    }
}

pub(super) async fn make_token(
    Call(cloud, user): Visit,
    Extension(fields): PostedForm,
) -> PageResult {
    let made = async {
        let role = fields.role()?;
        let name = fields.get("name").trim().to_owned();
        // No number is none that is allowed.
        let days = fields.get("days").trim().parse().unwrap_or(0);
        let new = NewToken { name, role, days };
        cloud.accounts.make_token(&user.user, (&user.user.name).into(), new).await
    };
    let made = match made.await {
        Ok(made) => made,
        Err(error) => return refused(&cloud, &user, error).await,
    };
    let body = html! {
        nav.crumbs aria-label="Path" { a href="/account" { "Account" } }
        h1 { "Token " (shown(fields.get("name").trim())) }
        section.card.narrow aria-label="Token" {
            p { "Copy this token now. It is not shown again." }
            p.code { code { (made.token) } }
            p { "It has the role " (made.user.role) ", and expires "
                (time(made.expires))
                ". Set it for programs as " code { "GLEANER_CLOUD_TOKEN" } ", with the address of \
                the cloud as " code { "GLEANER_CLOUD" } "." }
        }
    };
    Ok(layout::page("Token", "/account", Some(&user), body))
}

pub(super) async fn remove_token(Call(cloud, user): Visit, Path(name): Path<String>) -> PageResult {
    let actor = TokenUser::new(user.user.clone(), String::new());
    cloud.accounts.remove_token(&actor, &user.user.name, &name).await?;
    Ok(Redirect::to("/account?done=token").into_response())
}
