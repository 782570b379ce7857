//! Requests of people about clips.

use std::io;
use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::{Extension, Path, Query, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use gleaner_base::{Exit, Failure};
use gleaner_fleet::clips::{ClipId, ClipPolicy, ClipState, FleetClip};
use gleaner_fleet::people::{ListPage, User};

use super::FileOfClip;
use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};
use crate::request::parsed;
use crate::store::ClipQuery;

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
    State(cloud): State<Arc<Cloud>>,
    Extension(actor): Extension<User>,
    Path(id): Path<String>,
) -> CloudResult<Json<FleetClip>> {
    let id = parse(&id)?;
    let is_lost = !cloud.clips.has_recording(&id).await.map_err(|error| not_sent(&id, error))?;
    let clip = cloud.store.pull_clip(&actor.name, &id, is_lost).await?;
    cloud.hub.wake(&[id.vehicle().to_owned()]);
    Ok(Json(clip))
}

pub(crate) async fn thumbnail(
    State(cloud): State<Arc<Cloud>>,
    Path(id): Path<String>,
) -> CloudResult<Response> {
    let id = parse(&id)?;
    if !cloud.store.clip(&id).await?.has_thumbnail {
        let message = format!("clip `{id}` has no thumbnail here");
        return Err(CloudError::missing(message, "its vehicle sends it when it is connected"));
    }
    send(&cloud, (&id, FileOfClip::Thumbnail), "image/jpeg", &HeaderMap::new()).await
}

pub(crate) async fn file(
    State(cloud): State<Arc<Cloud>>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let id = parse(&id)?;
    let clip = cloud.store.clip(&id).await?;
    if clip.state != ClipState::Stored {
        let message =
            format!("the file of clip `{id}` is not in the cloud: {}", clip.state.as_str());
        return Err(CloudError::missing(message, "fetch it: `gleaner clips pull ID`"));
    }
    let file = FileOfClip::Recording(clip.facts.bytes);
    send(&cloud, (&id, file), "application/octet-stream", &headers).await
}

pub(crate) async fn policy(State(cloud): State<Arc<Cloud>>) -> CloudResult<Json<ClipPolicy>> {
    Ok(Json(cloud.store.clip_policy().await?))
}

pub(crate) async fn set_policy(
    State(cloud): State<Arc<Cloud>>,
    Extension(actor): Extension<User>,
    body: Bytes,
) -> CloudResult<Json<ClipPolicy>> {
    let policy: ClipPolicy = parsed(&body, "policy of clips")?;
    let vehicles = cloud.store.set_clip_policy(&actor.name, &policy).await?;
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
    (id, file): (&ClipId, FileOfClip),
    kind: &'static str,
    headers: &HeaderMap,
) -> CloudResult<Response> {
    let failed = |error| not_sent(id, error);
    let missing = || {
        let message = format!("a file of clip `{id}` is not among the files of the cloud");
        CloudError::missing(message, "fetch it again: `gleaner clips pull ID`")
    };
    let length = cloud.clips.length(id, file).await.map_err(failed)?.ok_or_else(missing)?;
    let range = headers.get(header::RANGE).and_then(|it| it.to_str().ok());
    // Any other range is answered with the whole file, as the standard allows.
    let begin = range.and_then(|it| it.strip_prefix("bytes=")?.strip_suffix('-')?.parse().ok());
    let (begin, status) = match begin {
        Some(begin) if begin > 0 && begin < length => (begin, StatusCode::PARTIAL_CONTENT),
        Some(begin) if begin > 0 => {
            let range = (header::CONTENT_RANGE, format!("bytes */{length}"));
            return Ok((StatusCode::RANGE_NOT_SATISFIABLE, [range]).into_response());
        }
        _ => (0, StatusCode::OK),
    };
    let content = cloud.clips.content(id, file, begin).await.map_err(failed)?;
    let mut answer = content.ok_or_else(missing)?.into_response();
    *answer.status_mut() = status;
    let mut set = |name, value: String| {
        if let Ok(value) = value.parse() {
            answer.headers_mut().insert(name, value);
        }
    };
    set(header::CONTENT_TYPE, kind.to_owned());
    set(header::X_CONTENT_TYPE_OPTIONS, "nosniff".to_owned());
    set(header::ACCEPT_RANGES, "bytes".to_owned());
    set(header::CONTENT_LENGTH, (length - begin).to_string());
    if status == StatusCode::PARTIAL_CONTENT {
        set(header::CONTENT_RANGE, format!("bytes {begin}-{}/{length}", length - 1));
    }
    Ok(answer)
}
