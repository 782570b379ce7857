//! Requests of people about clips.

use std::io;
use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use gleaner_base::{Exit, Failure};
use gleaner_fleet::clips::{ClipId, ClipPolicy, ClipState, ClipUsage, FleetClip};
use gleaner_fleet::people::ListPage;

use super::FileOfClip;
use crate::cloud::{Call, Cloud};
use crate::error::{CloudError, CloudResult};
use crate::request::parsed;
use crate::store::{ClipQuery, TokenUser};
use crate::transfer::{OCTETS, OutgoingFile};

pub(crate) async fn list(
    State(cloud): State<Arc<Cloud>>,
    Query(query): Query<ClipQuery>,
) -> CloudResult<Json<ListPage<FleetClip>>> {
    Ok(Json(cloud.store.clips(&query).await?))
}

pub(crate) async fn show(
    State(cloud): State<Arc<Cloud>>,
    Path(id): Path<String>,
) -> CloudResult<Json<FleetClip>> {
    Ok(Json(cloud.store.clip(&parse(&id)?).await?))
}

/// Marks a clip as wanted. The vehicle sends it when it is connected and has bytes left for today.
pub(crate) async fn pull(
    Call(cloud, actor): Call<TokenUser>,
    Path(id): Path<String>,
) -> CloudResult<Json<FleetClip>> {
    let id = parse(&id)?;
    let before = cloud.store.clip(&id).await?;
    // Only a file that was stored before this look can be lost: another one may arrive meanwhile.
    let is_lost = before.state == ClipState::Stored && {
        let parts = cloud.store.clip_parts(&id).await?;
        !cloud.clips.has_recording(&id, &parts).await.map_err(|error| not_sent(&id, error))?
    };
    let clip = cloud.store.pull_clip(&actor.actor, before, is_lost).await?;
    cloud.hub.wake(&[id.vehicle().to_owned()]);
    Ok(Json(clip))
}

/// Removes a clip. A kill before its files are removed loses nothing: they go with the next look.
pub(crate) async fn remove(
    Call(cloud, actor): Call<TokenUser>,
    Path(id): Path<String>,
) -> CloudResult<StatusCode> {
    let id = parse(&id)?;
    cloud.store.remove_clip(&actor.actor, &id).await?;
    super::remove_files_of(&cloud, id).await?;
    Ok(StatusCode::NO_CONTENT)
}

pub(crate) async fn usage(State(cloud): State<Arc<Cloud>>) -> CloudResult<Json<ClipUsage>> {
    Ok(Json(cloud.store.clip_counts().await?))
}

pub(crate) async fn thumbnail(
    State(cloud): State<Arc<Cloud>>,
    Path(id): Path<String>,
) -> CloudResult<Response> {
    let id = parse(&id)?;
    let clip = cloud.store.clip(&id).await?;
    if !clip.has_thumbnail {
        let message = format!("clip `{id}` has no thumbnail here");
        return Err(CloudError::missing(message, "its vehicle sends it when it is connected"));
    }
    let file = (&id, FileOfClip::Thumbnail, clip.facts.thumbnail.as_deref());
    send(&cloud, file, "image/jpeg", &HeaderMap::new(), ()).await
}

pub(crate) async fn file(
    Call(cloud, user): Call<TokenUser>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let slot = cloud.transfers.open(&user.user.name)?;
    recording(&cloud, &parse(&id)?, &headers, slot).await
}

/// Returns the answer with the file of a clip; it has `slot` until all of it is sent.
pub(crate) async fn recording(
    cloud: &Cloud,
    id: &ClipId,
    headers: &HeaderMap,
    slot: impl Send + 'static,
) -> CloudResult<Response> {
    let clip = cloud.store.clip(id).await?;
    if clip.state != ClipState::Stored {
        let message =
            format!("the file of clip `{id}` is not in the cloud: {}", clip.state.as_str());
        return Err(CloudError::missing(message, "fetch it: `gleaner clips pull ID`"));
    }
    let file = FileOfClip::Recording(clip.facts.bytes, cloud.store.clip_parts(id).await?);
    send(cloud, (id, file, clip.facts.sha256.as_deref()), OCTETS, headers, slot).await
}

pub(crate) async fn policy(State(cloud): State<Arc<Cloud>>) -> CloudResult<Json<ClipPolicy>> {
    Ok(Json(cloud.store.clip_policy().await?))
}

pub(crate) async fn set_policy(
    Call(cloud, actor): Call<TokenUser>,
    body: Bytes,
) -> CloudResult<Json<ClipPolicy>> {
    let policy: ClipPolicy = parsed(&body, "policy of clips")?;
    let vehicles = cloud.store.set_clip_policy(&actor.actor, &policy).await?;
    cloud.hub.wake(&vehicles);
    Ok(Json(policy))
}

fn parse(id: &str) -> CloudResult<ClipId> {
    id.parse().map_err(|reason: String| CloudError::missing(reason, "`gleaner clips` lists all"))
}

fn not_sent(id: &ClipId, error: io::Error) -> CloudError {
    Failure::caused_by(Exit::Internal, format!("cannot send clip `{id}`"), &error).into()
}

/// Returns the answer with a file, or with the end of it that `Range` asks for.
async fn send(
    cloud: &Cloud,
    (id, file, sha256): (&ClipId, FileOfClip, Option<&str>),
    kind: &'static str,
    headers: &HeaderMap,
    slot: impl Send + 'static,
) -> CloudResult<Response> {
    let name = format!("a file of clip `{id}`");
    let help = "fetch it again: `gleaner clips pull ID`";
    let length = cloud.clips.length(id, &file).await;
    let content = async |begin| cloud.clips.content(id, file, begin).await;
    OutgoingFile { name: &name, kind, help, sha256 }.send(slot, headers, length, content).await
}
