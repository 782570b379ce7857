//! Requests of vehicles about their clips.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Path};
use axum::middleware::from_fn;
use axum::routing::{post, put};
use futures_util::StreamExt;
use gleaner_base::{Exit, Failure};
use gleaner_fleet::UnfinishedFile;
use gleaner_fleet::clips::{
    CLIP_PART, CLIP_REPORT_MAX, CLIPS_IN_REPORT, ClipFacts, ClipId, ClipName, ClipOrders,
    ClipReport, THUMBNAIL_MAX,
};
use gleaner_image::Format;
use gleaner_lambda::manifest::Sha256;
use tokio::time::timeout;

use super::remove_recordings;
use crate::cloud::{Call, Cloud};
use crate::error::{CloudError, CloudResult};
use crate::request::{digest, in_time, parsed};
use crate::store::ClipProgress;
use crate::vehicles::KnownVehicle;

/// Time for a part that is not wanted.
const UNWANTED_TIME: Duration = Duration::from_secs(30);
/// Longest position in the list of a vehicle.
const CURSOR_MAX: usize = 256;
/// The reason of a failed upload whose earlier parts were lost.
const NO_PARTS: &str = "its first parts are not there any more";
/// Largest side of a thumbnail, in pixels: a few KiB could claim more than a browser has memory
/// for.
const SIDE_MAX: u32 = 4096;

/// Returns the routes, which need a certificate.
pub(crate) fn router() -> Router<Arc<Cloud>> {
    let report = post(report).layer(DefaultBodyLimit::max(CLIP_REPORT_MAX));
    let thumbnail = put(thumbnail).layer(DefaultBodyLimit::max(THUMBNAIL_MAX as usize));
    Router::new()
        .route("/v1/clips", report.layer(from_fn(in_time)))
        .route("/v1/clips/{name}/thumbnail", thumbnail.layer(from_fn(in_time)))
        .route("/v1/clips/{name}/parts/{part}/{sha256}", put(part))
}

/// Stores a report; answers with everything that is wanted.
async fn report(
    Call(cloud, vehicle): Call<KnownVehicle>,
    body: Bytes,
) -> CloudResult<Json<ClipOrders>> {
    let report: ClipReport = parsed(&body, "report of clips")?;
    let refused = |reason: String| {
        let help = "use a version of gleaner that fits the one of the cloud";
        CloudError::usage("the report of clips is refused", help).because(reason)
    };
    if report.clips.len() > CLIPS_IN_REPORT
        || report.gone.len() > CLIPS_IN_REPORT
        || report.cursor.as_ref().is_some_and(|it| it.len() > CURSOR_MAX)
    {
        return Err(refused("it is too long".to_owned()));
    }
    report.clips.iter().try_for_each(ClipFacts::check).map_err(refused)?;
    // A vehicle whose name is no safe part of a path has no clips here.
    if let Some(first) = report.clips.first() {
        ClipId::new(first.name.clone(), &vehicle.name).map_err(refused)?;
    }
    let bounds = cloud.clips.bounds;
    if report != ClipReport::default() {
        let dropped = cloud.store.announce_clips(&vehicle.name, &report, bounds).await?;
        remove_recordings(&cloud, &dropped).await;
    }
    orders(&cloud, &vehicle.name).await
}

async fn orders(cloud: &Cloud, vehicle: &str) -> CloudResult<Json<ClipOrders>> {
    Ok(Json(cloud.store.clip_orders(vehicle, cloud.clips.bounds).await?))
}

async fn thumbnail(
    Call(cloud, vehicle): Call<KnownVehicle>,
    Path(name): Path<String>,
    body: Bytes,
) -> CloudResult<Json<ClipOrders>> {
    let name = clip_name(&name)?;
    let Some(wanted) = cloud.store.wanted_thumbnail(&vehicle.name, &name).await? else {
        return orders(&cloud, &vehicle.name).await;
    };
    let id = id(&name, &vehicle.name)?;
    let refused =
        |help| CloudError::denied(format!("the thumbnail of clip `{id}` is refused"), help);
    if gleaner_trust::sha256(&body).as_str() != wanted {
        return Err(refused("send the JPEG that was announced"));
    }
    if !is_thumbnail(&body) {
        // It will never be another one.
        cloud.store.thumbnail_refused(&id, &wanted).await?;
        return Err(refused("announce a JPEG of at most 4096 pixels a side"));
    }
    let length = body.len() as u64;
    let part = cloud.clips.receive(&id, (length, &wanted), Body::from(body)).await?;
    let _turn = cloud.clips.turn(&id).await;
    if cloud.store.wanted_thumbnail(&vehicle.name, &name).await?.is_none() {
        // The clip was removed meanwhile, or another request has sent it.
        return orders(&cloud, &vehicle.name).await;
    }
    cloud.clips.keep_thumbnail(&id, &part).await.map_err(|error| not_stored(&id, error))?;
    cloud.store.thumbnail_received(&id).await?;
    orders(&cloud, &vehicle.name).await
}

/// Returns whether bytes begin as a JPEG of a size that a browser can show.
pub(crate) fn is_thumbnail(bytes: &[u8]) -> bool {
    bytes.len() as u64 <= THUMBNAIL_MAX
        && gleaner_image::probe(bytes).is_ok_and(|image| {
            image.format == Format::Jpeg && image.width.max(image.height) <= SIDE_MAX
        })
}

/// Receives a part. One that was received before changes nothing.
async fn part(
    Call(cloud, vehicle): Call<KnownVehicle>,
    Path((name, number, sha256)): Path<(String, u64, String)>,
    body: Body,
) -> CloudResult<Json<ClipOrders>> {
    let (name, sha256) = (clip_name(&name)?, digest(&sha256)?);
    let expected = expected(&cloud, &vehicle.name, &name, number).await;
    let Ok(Some((progress, length))) = expected else {
        // Unread, it could hide the answer from the vehicle.
        let _ = timeout(UNWANTED_TIME, skip(body)).await;
        expected?;
        return orders(&cloud, &vehicle.name).await;
    };
    let _slot = cloud.clips.slot(&vehicle.name)?;
    let received = cloud.clips.receive(&progress.id, (length, sha256.as_str()), body).await?;
    let working = Arc::clone(&cloud);
    // A vehicle that goes away in the middle must not leave it half done.
    let stored = tokio::spawn(store_part(working, progress, (length, sha256), received)).await;
    stored.map_err(|error| {
        Failure::caused_by(Exit::Internal, "a part of a clip is not stored", &error)
    })??;
    orders(&cloud, &vehicle.name).await
}

/// Returns the clip and the length of a part that is the next one; `None` of any other one.
async fn expected(
    cloud: &Cloud,
    vehicle: &str,
    name: &ClipName,
    number: u64,
) -> CloudResult<Option<(ClipProgress, u64)>> {
    let progress = cloud.store.clip_progress(vehicle, name, cloud.clips.bounds).await?;
    let length = ClipFacts::part_length(progress.bytes, number).ok_or_else(|| {
        let message = format!("clip `{}` has no part {number}", progress.id);
        CloudError::usage(message, "send the next part of the orders")
    })?;
    Ok((progress.part == number).then_some((progress, length)))
}

/// Reads a body that is not wanted, up to the length of a part.
async fn skip(body: Body) {
    let (mut pieces, mut bytes) = (body.into_data_stream(), 0);
    while let Some(Ok(piece)) = pieces.next().await {
        bytes += piece.len() as u64;
        if bytes > CLIP_PART {
            return;
        }
    }
}

/// Appends a part, and compares the file after the last one.
async fn store_part(
    cloud: Arc<Cloud>,
    progress: ClipProgress,
    (length, sha256): (u64, Sha256),
    received: UnfinishedFile,
) -> CloudResult<()> {
    let id = progress.id.clone();
    let _turn = cloud.clips.turn(&id).await;
    let name = clip_name(id.name())?;
    let now = cloud.store.clip_progress(id.vehicle(), &name, cloud.clips.bounds).await?;
    if now != progress {
        // Another request has stored the part meanwhile.
        return Ok(());
    }
    let is_last = ClipFacts::part_length(progress.bytes, progress.part + 1).is_none();
    let failed = |error| not_stored(&id, error);
    let part = (progress.part, sha256.as_str());
    let is_appended = cloud.clips.append(&id, part, received).await.map_err(failed)?;
    let outcome = match (is_appended, is_last) {
        (false, _) => Err(NO_PARTS.to_owned()),
        (true, false) => Ok(()),
        (true, true) => {
            let announced = (progress.bytes, progress.sha256.clone());
            let mut parts = cloud.store.clip_parts(&id).await?;
            parts.push(sha256.to_string());
            match cloud.clips.compare(&id, announced, parts).await {
                Err(error) if error.kind() == io::ErrorKind::NotFound => Err(NO_PARTS.to_owned()),
                compared => compared.map_err(failed)?,
            }
        }
    };
    match outcome {
        Ok(()) => {
            let part = (length, sha256.as_str());
            cloud.store.clip_part_received(&progress, part, is_last).await
        }
        Err(reason) => {
            // Otherwise another replica has stored it meanwhile.
            if cloud.store.clip_upload_failed(&id, &reason).await? {
                cloud.clips.remove_recording(&id).await.map_err(failed)?;
            }
            let message = format!("the file of clip `{id}` is refused");
            Err(CloudError::denied(message, "send it again from its first part").because(reason))
        }
    }
}

fn not_stored(id: &ClipId, error: io::Error) -> CloudError {
    Failure::caused_by(Exit::Internal, format!("cannot store clip `{id}`"), &error).into()
}

fn clip_name(text: &str) -> CloudResult<ClipName> {
    text.parse()
        .map_err(|reason: String| CloudError::usage(reason, "use the name that was announced"))
}

fn id(name: &ClipName, vehicle: &str) -> CloudResult<ClipId> {
    ClipId::new(name.clone(), vehicle)
        .map_err(|reason| CloudError::usage(reason, "enrol the vehicle under another name"))
}
