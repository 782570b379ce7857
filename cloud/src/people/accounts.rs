//! Users, tokens, and the audit trail of all changes.

use axum::Json;
use axum::body::Bytes;
use axum::extract::{Extension, Path, Query, State};
use axum::http::HeaderMap;
use axum::response::NoContent;
use gleaner_fleet::listener::ClientNetwork;
use gleaner_fleet::people::{
    AuditEntry, Invitation, ListPage, Login, NewToken, NewUser, Role, TokenSummary, User, UserToken,
};

use super::conditions::created;
use super::{Actor, ApiRow, CREATES, DELETE, GET, ListPart, POST, bearer, row};
use crate::cloud::{Call, Services};
use crate::error::{CloudResult, JsonResult};
use crate::request::{ListQuery, parsed};
use crate::store::TokenUser;

pub(super) fn endpoints() -> Vec<ApiRow> {
    use Role::{Admin, Viewer};
    let own = "Own tokens for programs, or all for an admin";
    vec![
        row(GET, "/v1/me", Viewer, "The user of the token", me).gives::<User>(),
        row(DELETE, "/v1/login", Viewer, "Ends the token of the request", logout),
        row(GET, "/v1/tokens", Viewer, own, tokens)
            .query::<ListQuery<String>>()
            .gives::<ListPage<TokenSummary>>(),
        row(POST, "/v1/tokens", Viewer, "Makes a token for programs", make_token)
            .needs_login()
            .headers(CREATES)
            .takes::<NewToken>()
            .gives::<UserToken>(),
        row(DELETE, "/v1/tokens/{user}/{name}", Viewer, "Removes a token", remove_token),
        row(GET, "/v1/users", Admin, "All users", users)
            .query::<ListQuery<String>>()
            .gives::<ListPage<User>>(),
        row(POST, "/v1/users", Admin, "Invites a user, or one again", invite)
            .headers(CREATES)
            .takes::<NewUser>()
            .gives::<Invitation>(),
        row(DELETE, "/v1/users/{name}", Admin, "Removes a user", remove_user),
    ]
}

pub(super) async fn login(
    State(cloud): Services,
    Extension(network): Extension<ClientNetwork>,
    body: Bytes,
) -> JsonResult<UserToken> {
    let Login { code } = parsed(&body, "login")?;
    let token = cloud.store.login(&code).await?;
    let help = "a code works once, for 24 hours: let an administrator invite you again, or run \
                `gleaner-cloud invite NAME --role ROLE --data DIR` beside the cloud";
    cloud.accounts.wrong_secrets.check(network, token, "the code is not valid", help).map(Json)
}

async fn me(Extension(user): Extension<TokenUser>) -> Json<User> {
    Json(user.user)
}

async fn logout(Call(cloud, actor): Actor, headers: HeaderMap) -> CloudResult<NoContent> {
    if let Some(token) = bearer(&headers) {
        cloud.accounts.end_token(&actor, token).await?;
    }
    Ok(NoContent)
}

async fn tokens(
    Call(cloud, actor): Actor,
    Query(part): ListPart,
) -> JsonResult<ListPage<TokenSummary>> {
    let of = (actor.user.role < Role::Admin).then_some(&*actor.user.name);
    let tokens = cloud.store.tokens(of, part.after(), part.limit.into()).await?;
    Ok(Json(ListPage::of(tokens, part.limit.into(), |it| format!("{}/{}", it.user, it.name))))
}

async fn make_token(
    Call(cloud, actor): Actor,
    headers: HeaderMap,
    body: Bytes,
) -> JsonResult<UserToken> {
    let (conditions, new) = created(&headers, "/v1/tokens", (&body, "token"))?;
    cloud.accounts.make_token(&actor.user, conditions.by(&actor), new).await.map(Json)
}

async fn remove_token(
    Call(cloud, actor): Actor,
    Path((of, name)): Path<(String, String)>,
) -> CloudResult<NoContent> {
    cloud.accounts.remove_token(&actor, &of, &name).await.map(|()| NoContent)
}

async fn users(State(cloud): Services, Query(part): ListPart) -> JsonResult<ListPage<User>> {
    let users = cloud.store.users(part.after(), part.limit.into()).await?;
    Ok(Json(ListPage::of(users, part.limit.into(), |user| user.name.clone())))
}

async fn invite(
    Call(cloud, actor): Actor,
    headers: HeaderMap,
    body: Bytes,
) -> JsonResult<Invitation> {
    let (conditions, new): (_, NewUser) = created(&headers, "/v1/users", (&body, "invitation"))?;
    cloud.store.invite(conditions.by(&actor), new).await.map(Json)
}

async fn remove_user(
    Call(cloud, actor): Actor,
    Path(name): Path<String>,
) -> CloudResult<NoContent> {
    cloud.accounts.remove_user(&actor.actor, &name).await.map(|()| NoContent)
}

/// Returns entries of the audit trail, the newest first.
pub(super) async fn audit(
    State(cloud): Services,
    Query(part): Query<ListQuery<u64>>,
) -> JsonResult<ListPage<AuditEntry>> {
    let before = part.after.unwrap_or(u64::MAX);
    let entries = cloud.store.audit(before, part.limit.into()).await?;
    Ok(Json(ListPage::of(entries, part.limit.into(), |entry| entry.seq.to_string())))
}
