//! Requests of vehicles about their clips.

use std::sync::Arc;

use axum::Json;
use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Path};
use axum::http::Method;
use axum::middleware::from_fn;
use axum::routing::{post, put};
use gleaner_fleet::clips::{
    CLIP_PART, CLIP_REPORT_MAX, ClipName, ClipOrders, ClipReport, THUMBNAIL_MAX,
};
use gleaner_fleet::openapi::Endpoint;

use super::{KnownVehicle, VehicleCall};
use crate::cloud::{Call, Cloud};
use crate::error::{CloudError, CloudResult, JsonResult};
use crate::request::{digest, in_time, parsed};

pub(super) fn endpoints() -> [Endpoint<Arc<Cloud>>; 4] {
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

async fn report(Call(cloud, vehicle): VehicleCall, body: Bytes) -> JsonResult<ClipOrders> {
    let report = parsed(&body, "report of clips")?;
    cloud.clips.announce(&vehicle.name, &report).await.map(Json)
}

async fn thumbnail(
    Call(cloud, vehicle): VehicleCall,
    Path(name): Path<String>,
    body: Bytes,
) -> JsonResult<ClipOrders> {
    cloud.clips.receive_thumbnail(&vehicle.name, &clip_name(&name)?, body).await.map(Json)
}

async fn piece(
    call: VehicleCall,
    Path((name, begin)): Path<(String, u64)>,
    body: Body,
) -> JsonResult<ClipOrders> {
    received(call, (clip_name(&name)?, begin), body).await
}

/// Receives a part of an older vehicle, as a piece: all of the file is compared at its end.
async fn part(
    call: VehicleCall,
    Path((name, number, sha256)): Path<(String, u64, String)>,
    body: Body,
) -> JsonResult<ClipOrders> {
    digest(&sha256)?;
    received(call, (clip_name(&name)?, number.saturating_mul(CLIP_PART)), body).await
}

async fn received(
    Call(cloud, KnownVehicle { name, .. }): VehicleCall,
    piece: (ClipName, u64),
    body: Body,
) -> JsonResult<ClipOrders> {
    let slot = cloud.transfers.open_of_vehicle(&name);
    cloud.clips.receive_piece(&name, slot, piece, body).await.map(Json)
}

fn clip_name(text: &str) -> CloudResult<ClipName> {
    text.parse()
        .map_err(|reason: String| CloudError::usage(reason, "use the name that was announced"))
}
