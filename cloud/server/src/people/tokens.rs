//! Tokens for programs, and the end of the token of a login.

use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, Query};
use axum::http::{HeaderMap, StatusCode};
use gleaner_base::excerpt;
use gleaner_fleet::people::{ListPage, NewToken, Role, TokenSummary, UserToken};

use super::bearer;
use super::conditions::ChangeConditions;
use crate::cloud::Call;
use crate::error::{CloudError, CloudResult};
use crate::request::{ListQuery, parsed};
use crate::store::TokenUser;

pub(super) async fn make(
    Call(cloud, actor): Call<TokenUser>,
    headers: HeaderMap,
    body: Bytes,
) -> CloudResult<Json<UserToken>> {
    let conditions = ChangeConditions::of_new(&headers, "/v1/tokens", &body)?;
    let new: NewToken = parsed(&body, "token")?;
    cloud.account_changes.count(&actor.user.name)?;
    Ok(Json(cloud.store.make_token((&actor.user, conditions.by(&actor)), new).await?))
}

pub(super) async fn list(
    Call(cloud, actor): Call<TokenUser>,
    Query(part): Query<ListQuery<String>>,
) -> CloudResult<Json<ListPage<TokenSummary>>> {
    let of = (actor.user.role < Role::Admin).then_some(&*actor.user.name);
    let after = part.after.unwrap_or_default();
    let tokens = cloud.store.tokens(of, &after, part.limit.into()).await?;
    let position = |it: &TokenSummary| format!("{}/{}", it.user, it.name);
    Ok(Json(ListPage::of(tokens, part.limit.into(), position)))
}

pub(crate) async fn remove(
    Call(cloud, actor): Call<TokenUser>,
    Path((of, name)): Path<(String, String)>,
) -> CloudResult<StatusCode> {
    let TokenUser { user, name: own, actor } = actor;
    if !own.is_empty() && (&of, &name) != (&user.name, &own) {
        let message = format!("token `{own}` removes no tokens but itself");
        return Err(CloudError::denied(message, super::LOGIN));
    }
    if of != user.name && user.role < Role::Admin {
        let message = format!("you have no token `{}/{}`", excerpt(&of), excerpt(&name));
        let help = "remove one of your own, or let an administrator remove it";
        return Err(CloudError::missing(message, help));
    }
    cloud.store.remove_token(&actor, &of, &name).await?;
    cloud.readers.end(&of);
    Ok(StatusCode::NO_CONTENT)
}

pub(super) async fn logout(
    Call(cloud, actor): Call<TokenUser>,
    headers: HeaderMap,
) -> CloudResult<StatusCode> {
    if let Some(token) = bearer(&headers) {
        cloud.store.end_token(&actor.actor, token).await?;
        cloud.readers.end(&actor.user.name);
    }
    Ok(StatusCode::NO_CONTENT)
}
