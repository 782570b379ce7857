//! Requests of vehicles about their clips.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::Json;
use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Path};
use axum::http::Method;
use axum::middleware::from_fn;
use axum::routing::{post, put};
use futures_util::TryStreamExt;
use gleaner_base::{Exit, Failure};
use gleaner_fleet::clips::{
    CLIP_PART, CLIP_PIECE_MIN, CLIP_REPORT_MAX, CLIPS_IN_REPORT, ClipFacts, ClipId, ClipName,
    ClipOrders, ClipReport, THUMBNAIL_MAX,
};
use gleaner_fleet::openapi::Endpoint;
use gleaner_image::Format;

use super::remove_noted;
use crate::cloud::{Call, Cloud};
use crate::error::{CloudError, CloudResult};
use crate::request::{digest, in_time, parsed};
use crate::store::{ClipProgress, StoredPart};
use crate::transfer::{ReceivedPiece, skip};
use crate::vehicles::KnownVehicle;

/// Longest position in the list of a vehicle.
const CURSOR_MAX: usize = 256;
/// The reason of a failed upload whose earlier parts were lost.
const NO_PARTS: &str = "its first parts are not there any more";
/// Largest side of a thumbnail, in pixels: a few KiB could claim more than a browser has memory
/// for.
const SIDE_MAX: u32 = 4096;

/// Returns the requests, which need a certificate.
pub(crate) fn endpoints() -> [Endpoint<Arc<Cloud>>; 4] {
    let report = post(report).layer(DefaultBodyLimit::max(CLIP_REPORT_MAX));
    let report = report.layer(from_fn(in_time));
    let thumbnail = put(thumbnail).layer(DefaultBodyLimit::max(THUMBNAIL_MAX as usize));
    let put_file = |path, what, handler| {
        Endpoint::new(Method::PUT, path, None, what, handler).takes_file().gives::<ClipOrders>()
    };
    [
        Endpoint::new(Method::POST, "/v1/clips", None, "Announces clips", report)
            .takes::<ClipReport>()
            .gives::<ClipOrders>(),
        put_file("/v1/clips/{name}/thumbnail", "Sends an image", thumbnail.layer(from_fn(in_time))),
        put_file("/v1/clips/{name}/from/{begin}", "Sends a piece of a clip", put(piece)),
        put_file("/v1/clips/{name}/parts/{part}/{sha256}", "Sends a part of a clip", put(part)),
    ]
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
        cloud.store.announce_clips(&vehicle.name, &report, bounds).await?;
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
    let length = body.len() as u64;
    let file = format!("the thumbnail of clip `{name}`");
    let file = (&*file, Some(THUMBNAIL_MAX));
    let fits = cloud.store.must_fit(&vehicle.name, file, cloud.clips.bounds).await;
    cloud.store.clip_bytes_arrived(&vehicle.name, length).await?;
    let Some(wanted) = cloud.store.wanted_thumbnail(&vehicle.name, &name).await? else {
        return orders(&cloud, &vehicle.name).await;
    };
    fits?;
    let id = id(&name, &vehicle.name)?;
    if gleaner_trust::sha256(&body).as_str() != wanted || !is_thumbnail(&body) {
        // It will never be the announced one.
        cloud.store.thumbnail_refused(&id, &wanted).await?;
        let help = "announce a JPEG of at most 4096 pixels a side, and send that one";
        return Err(CloudError::denied(format!("the thumbnail of clip `{id}` is refused"), help));
    }
    let part = cloud.clips.receive(&id, length, Body::from(body)).await?;
    let _turn = cloud.clips.turn(&id).await;
    if cloud.store.wanted_thumbnail(&vehicle.name, &name).await?.is_none() {
        // The clip was removed meanwhile, or another request has sent it.
        return orders(&cloud, &vehicle.name).await;
    }
    cloud.clips.keep_thumbnail(&id, &part.file).await.map_err(|error| not_stored(&id, error))?;
    cloud.store.thumbnail_received(&id, length).await?;
    orders(&cloud, &vehicle.name).await
}

/// Returns whether bytes begin as a JPEG of a size that a browser can show.
pub(crate) fn is_thumbnail(bytes: &[u8]) -> bool {
    bytes.len() as u64 <= THUMBNAIL_MAX
        && gleaner_image::probe(bytes).is_ok_and(|image| {
            image.format == Format::Jpeg && image.width.max(image.height) <= SIDE_MAX
        })
}

/// Receives a piece that begins at a byte. What has come of one that breaks off is kept.
async fn piece(
    Call(cloud, vehicle): Call<KnownVehicle>,
    Path((name, begin)): Path<(String, u64)>,
    body: Body,
) -> CloudResult<Json<ClipOrders>> {
    received(cloud, vehicle, (clip_name(&name)?, begin), body).await
}

/// Receives a part of an older vehicle, as a piece: all of the file is compared at its end.
async fn part(
    Call(cloud, vehicle): Call<KnownVehicle>,
    Path((name, number, sha256)): Path<(String, u64, String)>,
    body: Body,
) -> CloudResult<Json<ClipOrders>> {
    digest(&sha256)?;
    let piece = (clip_name(&name)?, number.saturating_mul(CLIP_PART));
    received(cloud, vehicle, piece, body).await
}

/// Receives a piece, and counts what arrives, whatever becomes of it. One that was received before
/// changes nothing.
async fn received(
    cloud: Arc<Cloud>,
    vehicle: KnownVehicle,
    piece: (ClipName, u64),
    body: Body,
) -> CloudResult<Json<ClipOrders>> {
    let arrived = Arc::new(AtomicU64::new(0));
    let counter = Arc::clone(&arrived);
    let pieces = body.into_data_stream().inspect_ok(move |piece| {
        counter.fetch_add(piece.len() as u64, Ordering::Relaxed);
    });
    let (working, name) = (Arc::clone(&cloud), vehicle.name.clone());
    // A vehicle that goes away in the middle must not leave it half done.
    let stored = tokio::spawn(async move {
        let stored = store_piece(&working, &name, piece, Body::from_stream(pieces)).await;
        let arrived = arrived.load(Ordering::Relaxed);
        stored.and(working.store.clip_bytes_arrived(&name, arrived).await)
    });
    stored.await.map_err(|error| {
        Failure::caused_by(Exit::Internal, "a part of a clip is not stored", &error)
    })??;
    orders(&cloud, &vehicle.name).await
}

/// Stores a piece, if some of it comes next.
async fn store_piece(
    cloud: &Arc<Cloud>,
    vehicle: &str,
    (name, begin): (ClipName, u64),
    body: Body,
) -> CloudResult<()> {
    let slot = cloud.transfers.open_of_vehicle(vehicle);
    let wanted = match &slot {
        Ok(_) => expected(cloud, vehicle, &name, begin).await,
        Err(busy) => Err(busy.clone()),
    };
    let Ok(Some((progress, length))) = wanted else {
        skip(body).await;
        return wanted.map(drop);
    };
    // Some of it may have come before.
    let mut left = progress.received - begin;
    let length = length - left;
    let pieces = body.into_data_stream().map_ok(move |mut piece| {
        let skipped = left.min(piece.len() as u64);
        left -= skipped;
        piece.split_off(skipped as usize)
    });
    let body = Body::from_stream(pieces);
    let received = cloud.clips.receive(&progress.id, length, body).await?;
    append_piece(cloud, progress, received).await
}

/// Returns the clip and the largest length of a piece, if the next byte is in it.
async fn expected(
    cloud: &Cloud,
    vehicle: &str,
    name: &ClipName,
    begin: u64,
) -> CloudResult<Option<(ClipProgress, u64)>> {
    let progress = cloud.store.clip_progress(vehicle, name, cloud.clips.bounds).await?;
    let length = ClipFacts::piece_length(progress.bytes, begin).ok_or_else(|| {
        let message = format!("clip `{}` has no byte {begin}", progress.id);
        CloudError::usage(message, "send the next bytes of the orders")
    })?;
    let is_next = (begin..begin + length).contains(&progress.received);
    Ok(is_next.then_some((progress, length)))
}

/// Appends a piece, and compares the file after the last one.
async fn append_piece(
    cloud: &Arc<Cloud>,
    progress: ClipProgress,
    received: ReceivedPiece,
) -> CloudResult<()> {
    let id = progress.id.clone();
    let _turn = cloud.clips.turn(&id).await;
    let name = clip_name(id.name())?;
    let bounds = cloud.clips.bounds;
    let now = cloud.store.clip_progress(id.vehicle(), &name, bounds).await?;
    let is_last = now.received + received.bytes == now.bytes;
    // Another request may have stored a piece meanwhile. Each costs an entry, and in a bucket an
    // object.
    if now != progress || (received.bytes < CLIP_PIECE_MIN && !is_last) {
        return Ok(());
    }
    let failed = |error| not_stored(&id, error);
    let part = StoredPart { sha256: received.sha256.clone(), bytes: received.bytes };
    let is_appended = cloud.clips.append(&now, received).await.map_err(failed)?;
    let outcome = match (is_appended, is_last) {
        (false, _) => Err(NO_PARTS.to_owned()),
        (true, false) => Ok(()),
        (true, true) => {
            let announced = (now.bytes, now.sha256.clone());
            let mut parts = cloud.store.clip_parts(&id).await?;
            parts.push(part.clone());
            match cloud.clips.compare(&id, announced, parts).await {
                Err(error) if error.kind() == io::ErrorKind::NotFound => Err(NO_PARTS.to_owned()),
                compared => compared.map_err(failed)?,
            }
        }
    };
    match outcome {
        Ok(()) => {
            let part = (part.bytes, &*part.sha256);
            cloud.store.clip_part_received(&now, part, is_last, bounds).await
        }
        Err(reason) => {
            // Otherwise another replica has stored it meanwhile.
            if cloud.store.clip_upload_failed(&id, &reason).await? {
                remove_noted(cloud, id.clone()).await?;
            }
            let message = format!("the file of clip `{id}` is refused");
            Err(CloudError::denied(message, "send it again from its first byte").because(reason))
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
