//! Clips and the rules for them.

use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, Query, State};
use axum::http::HeaderMap;
use axum::response::{NoContent, Response};
use gleaner_fleet::clips::{ClipId, ClipPolicy, ClipUsage, FleetClip};
use gleaner_fleet::people::{ListPage, Role};

use super::{Actor, ApiRow, DELETE, GET, POST, PUT, row};
use crate::cloud::{Call, Services};
use crate::error::{CloudError, CloudResult, JsonResult};
use crate::request::parsed;
use crate::store::ClipQuery;
use crate::transfer::OCTETS;

pub(super) fn endpoints() -> Vec<ApiRow> {
    use Role::{Admin, Deployer, Operator, Viewer};
    vec![
        row(GET, "/v1/clips", Viewer, "Clips, the last announced first", list)
            .query::<ClipQuery>()
            .gives::<ListPage<FleetClip>>(),
        row(GET, "/v1/clips/policy", Viewer, "The rules for the upload of clips", policy)
            .gives::<ClipPolicy>(),
        row(PUT, "/v1/clips/policy", Admin, "Sets these rules", set_policy)
            .takes::<ClipPolicy>()
            .gives::<ClipPolicy>(),
        row(GET, "/v1/clips/usage", Viewer, "What is stored of clips", usage).gives::<ClipUsage>(),
        row(GET, "/v1/clips/{id}", Viewer, "A clip", show).gives::<FleetClip>(),
        row(DELETE, "/v1/clips/{id}", Deployer, "Removes a stored clip", remove_one),
        row(GET, "/v1/clips/{id}/thumbnail", Viewer, "An image of a clip", thumbnail)
            .gives_file("image/jpeg"),
        row(GET, "/v1/clips/{id}/file", Viewer, "The file of a clip", file)
            .headers(&["Range"])
            .gives_file(OCTETS),
        row(POST, "/v1/clips/{id}/pull", Operator, "Marks a clip as wanted", pull)
            .gives::<FleetClip>(),
    ]
}

async fn list(
    State(cloud): Services,
    Query(query): Query<ClipQuery>,
) -> JsonResult<ListPage<FleetClip>> {
    cloud.store.clips(&query).await.map(Json)
}

async fn policy(State(cloud): Services) -> JsonResult<ClipPolicy> {
    cloud.store.clip_policy().await.map(Json)
}

async fn set_policy(Call(cloud, actor): Actor, body: Bytes) -> JsonResult<ClipPolicy> {
    let policy = parsed(&body, "policy of clips")?;
    cloud.clips.set_policy(&actor.actor, &policy).await?;
    Ok(Json(policy))
}

async fn usage(State(cloud): Services) -> JsonResult<ClipUsage> {
    cloud.store.clip_counts().await.map(Json)
}

async fn show(State(cloud): Services, Path(id): Path<String>) -> JsonResult<FleetClip> {
    cloud.store.clip(&parse(&id)?).await.map(Json)
}

async fn remove_one(Call(cloud, actor): Actor, Path(id): Path<String>) -> CloudResult<NoContent> {
    cloud.clips.remove(&actor.actor, parse(&id)?).await.map(|()| NoContent)
}

async fn thumbnail(State(cloud): Services, Path(id): Path<String>) -> CloudResult<Response> {
    cloud.clips.thumbnail(&parse(&id)?).await
}

async fn file(
    Call(cloud, user): Actor,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let slot = cloud.transfers.open(&user.user.name)?;
    cloud.clips.recording(&parse(&id)?, &headers, slot).await
}

async fn pull(Call(cloud, actor): Actor, Path(id): Path<String>) -> JsonResult<FleetClip> {
    cloud.clips.pull(&actor.actor, &parse(&id)?).await.map(Json)
}

fn parse(id: &str) -> CloudResult<ClipId> {
    id.parse().map_err(|reason: String| CloudError::missing(reason, "`gleaner clips` lists all"))
}
