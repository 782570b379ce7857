//! The listener for vehicles: HTTPS, each request but the first with the vehicle's certificate.
//! [`endpoints`] lists the requests, and `docs/api/link.json` describes them; besides, `GET
//! /v1/link` opens the control channel, a WebSocket.

mod batch;
mod clips;
mod link;

use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Extension, Path, Request, State};
use axum::http::{HeaderMap, Method, header};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use gleaner_fleet::listener::{ClientNetwork, PeerConnection};
use gleaner_fleet::openapi::Endpoint;
use gleaner_fleet::{EnrolReply, EnrolRequest, FRAME_MAX, RenewRequest};
use hyper_util::rt::TokioIo;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::handshake::server::create_response_with_body;
use tokio_tungstenite::tungstenite::protocol::{Role, WebSocketConfig};

use crate::cloud::{Call, Cloud, Services};
use crate::error::{CloudError, CloudResult, JsonResult};
use crate::request::{digest, in_time, parsed};
use crate::transfer::OCTETS;

const BODY_MAX: usize = 64 << 10;
/// Buffer for reading frames: with the default of 128 KiB, idle vehicles would take ten times the
/// memory. Most frames are shorter than this.
const READ_BUFFER: usize = 1024;
/// The only request without a certificate.
const ENROL: &str = "/v1/enrol";

/// The vehicle that sends a request, by its certificate.
#[derive(Debug, Clone)]
pub(crate) struct KnownVehicle {
    pub(crate) name: String,
    certificate: String,
}

type VehicleCall = Call<KnownVehicle>;

/// Returns every request with an answer. All but the first need a certificate.
pub(crate) fn endpoints() -> Vec<Endpoint<Arc<Cloud>>> {
    let new = Endpoint::new;
    let read = |path, what, handler| new(Method::GET, path, None, what, handler).gives_file(OCTETS);
    let send = |path, what, handler| new(Method::POST, path, None, what, handler);
    let mut endpoints = vec![
        send(ENROL, "Gives the first certificate", post(enrol).layer(from_fn(in_time)))
            .takes::<EnrolRequest>()
            .gives::<EnrolReply>(),
        send("/v1/renew", "Gives the next certificate", post(renew).layer(from_fn(in_time)))
            .takes::<RenewRequest>()
            .gives::<EnrolReply>(),
        read("/v1/deployments/{sha256}", "The envelope of a deployment", get(deployment)),
        read("/v1/revisions/{digest}", "The envelope of a revision", get(revision)),
        read("/v1/objects/{sha256}", "A file of a revision", get(object)).headers(&["Range"]),
    ];
    endpoints.extend(clips::endpoints());
    endpoints
}

pub(crate) fn router(cloud: &Arc<Cloud>) -> Router {
    let known = from_fn_with_state(Arc::clone(cloud), guard);
    let mut router = Router::new().route("/v1/link", get(link).route_layer(known.clone()));
    for Endpoint { path, handler, .. } in endpoints() {
        let guarded = if path == ENROL { handler } else { handler.route_layer(known.clone()) };
        router = router.route(path, guarded);
    }
    router
        .fallback(async || CloudError::missing("there is nothing under this path", "see the docs"))
        .layer(DefaultBodyLimit::max(BODY_MAX))
        .with_state(Arc::clone(cloud))
}

/// Lets requests pass whose certificate is that of a vehicle which is not revoked. The authority
/// signs no other names than those of vehicles; the fingerprint settles which one, and whether the
/// certificate still counts.
async fn guard(
    State(cloud): Services,
    Extension(peer): Extension<Arc<PeerConnection>>,
    mut request: Request,
    next: Next,
) -> Response {
    let help = "enrol the vehicle: `gleaner vehicles enrol NAME --to FILE`, and there `gleaner \
                enrol FILE`";
    let Some(certificate) = peer.certificate.clone() else {
        return CloudError::unknown("the request has no certificate", help).into_response();
    };
    match cloud.store.vehicle_of(&certificate).await {
        Ok(Some(name)) => {
            if let Err(busy) = cloud.limits.request(&name) {
                return busy.into_response();
            }
            request.extensions_mut().insert(KnownVehicle { name, certificate });
            next.run(request).await
        }
        Ok(None) => {
            let message =
                "the certificate is not valid: it has expired, or the vehicle was revoked";
            CloudError::unknown(message, help).into_response()
        }
        Err(error) => error.into_response(),
    }
}

async fn enrol(
    State(cloud): Services,
    Extension(network): Extension<ClientNetwork>,
    body: Bytes,
) -> JsonResult<EnrolReply> {
    let request = parsed(&body, "enrolment")?;
    let reply = cloud.enrolments.enrol(&request).await?;
    let help = "an enrolment works once, for 24 hours, and for its own vehicle: make another one \
                with `gleaner vehicles enrol NAME --to FILE`";
    let wrong_secrets = &cloud.accounts.wrong_secrets;
    wrong_secrets.check(network, reply, "the enrolment is not valid", help).map(Json)
}

async fn renew(
    Call(cloud, KnownVehicle { name, certificate }): VehicleCall,
    body: Bytes,
) -> JsonResult<EnrolReply> {
    let RenewRequest { csr } = parsed(&body, "request for a certificate")?;
    cloud.limits.renewal(&name)?;
    cloud.enrolments.renew((&name, &certificate), &csr).await.map(Json)
}

/// Opens the control channel. The WebSockets of axum are not used: they need an older tungstenite,
/// with a second `rand` and a third `getrandom`.
async fn link(
    Call(cloud, vehicle): VehicleCall,
    Extension(peer): Extension<Arc<PeerConnection>>,
    mut request: Request,
) -> CloudResult<Response> {
    let response = create_response_with_body(&request, Body::empty).map_err(|error| {
        let help = "use a version of gleaner that fits the one of the cloud";
        CloudError::usage("the request opens no WebSocket", help).because(error.to_string())
    })?;
    cloud.limits.link(&vehicle.name)?;
    let upgrade = hyper::upgrade::on(&mut request);
    tokio::spawn(async move {
        // An upgrade fails if the vehicle closed the connection before it.
        if let Ok(upgraded) = upgrade.await {
            let config = WebSocketConfig::default()
                .read_buffer_size(READ_BUFFER)
                .write_buffer_size(0)
                .max_message_size(Some(FRAME_MAX))
                .max_frame_size(Some(FRAME_MAX));
            let (stream, role) = (TokioIo::new(upgraded), Role::Server);
            let socket = WebSocketStream::from_raw_socket(stream, role, Some(config)).await;
            link::serve(&cloud, (&vehicle.name, &vehicle.certificate), socket).await;
        }
        drop(peer);
    });
    Ok(response)
}

/// Sends a deployment that the vehicle should have. Only from one it learns the digests of
/// revisions and their files, so that these need no check of their own.
async fn deployment(
    Call(cloud, vehicle): VehicleCall,
    Path(sha256): Path<String>,
) -> CloudResult<Response> {
    let digest = digest(&sha256)?;
    let wants = cloud.store.wants(&vehicle.name).await?;
    let envelope = match wants.deployments.iter().any(|it| it.envelope == digest.as_str()) {
        true => cloud.store.envelope(digest.as_str()).await?,
        false => None,
    };
    found(envelope, "deployment", &sha256)
}

async fn revision(State(cloud): Services, Path(sha256): Path<String>) -> CloudResult<Response> {
    let envelope = cloud.store.revision(digest(&sha256)?.as_str()).await?;
    found(envelope, "revision", &sha256)
}

fn found(envelope: Option<String>, what: &str, digest: &str) -> CloudResult<Response> {
    let missing = || {
        let help = "wait for the next desired state: it was replaced or removed meanwhile";
        CloudError::missing(format!("there is no {what} {digest}"), help)
    };
    Ok(([(header::CONTENT_TYPE, OCTETS)], envelope.ok_or_else(missing)?).into_response())
}

async fn object(
    Call(cloud, vehicle): VehicleCall,
    Path(sha256): Path<String>,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let slot = cloud.transfers.open_of_vehicle(&vehicle.name)?;
    cloud.objects.send(slot, &digest(&sha256)?, &headers).await
}
