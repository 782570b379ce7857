//! The API of the vehicle: HTTP on a socket that only this user and its group can open.
//! [`endpoints`] lists the requests, and `docs/api/vehicle.json` describes them.

use std::sync::Arc;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Path, Query, State};
use axum::http::{Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{delete, get, post, put};
use gleaner_base::{Exit, Failure};
use gleaner_fleet::Enrolment;
use gleaner_fleet::openapi::Endpoint;
use gleaner_lambda::manifest::{ItemName, Sha256};
use gleaner_protocol::vehicle_api::{
    Changed, DeployReply, DeployRequest, DeploymentEnvelopes, Problem, StreamLine, VehicleStatus,
};
use schemars::JsonSchema;
use serde::Deserialize;

use crate::cloud::Cloud;
use crate::orchestrator::Orchestrator;
use crate::streams::StreamQuery;
use crate::{metrics, objects, spools, streams};

/// Maximum length of a request without files: a deployment with two revisions of 4 MiB each, as
/// text in JSON.
const BODY_MAX: usize = 12 << 20;

/// The users of the socket, in events.
const USER: &str = "a user";

#[derive(Clone)]
pub(crate) struct Api {
    pub(crate) core: Arc<Orchestrator>,
    pub(crate) cloud: Cloud,
}

/// Choice of what ends with an enrolment.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct LeaveQuery {
    /// True if the key of the vehicle, which signs its clips, is removed, too.
    #[serde(default)]
    new_identity: bool,
}

type Reply<T> = Result<T, ApiError>;

/// Returns every request that the API answers.
fn endpoints() -> Vec<Endpoint<Api>> {
    let read = |path, what, handler| Endpoint::new(Method::GET, path, None, what, handler);
    let send = |path, what, handler| Endpoint::new(Method::POST, path, None, what, handler);
    let set = |path, what, handler| Endpoint::new(Method::PUT, path, None, what, handler);
    let end = |path, what, handler| Endpoint::new(Method::DELETE, path, None, what, handler);
    vec![
        read("/v1/status", "The status of the vehicle", get(status)).gives::<VehicleStatus>(),
        send("/v1/deployments", "Stores a deployment", post(deploy))
            .takes::<DeployRequest>()
            .gives::<DeployReply>(),
        set("/v1/objects/{sha256}", "Stores a file that a deployment needs", put(object))
            .takes_file(),
        end("/v1/deployments/{id}", "Removes a deployment", delete(remove)),
        read("/v1/deployments/{id}/envelopes", "The signed parts of a deployment", get(envelopes))
            .gives::<DeploymentEnvelopes>(),
        send("/v1/deployments/{id}/{change}", "Starts, stops or rolls back", post(change))
            .gives::<Changed>(),
        set("/v1/trust", "Installs the envelope of a trust root", put(trust)).takes_file(),
        set("/v1/cloud", "Enrols the vehicle at a cloud", put(enrol)).takes::<Enrolment>(),
        end("/v1/cloud", "Ends the enrolment", delete(leave)).query::<LeaveQuery>(),
        read("/v1/events", "Events of the vehicle", get(events))
            .query::<StreamQuery>()
            .gives_lines::<StreamLine>(),
        read("/v1/lambdas/{id}/records", "Records of a deployment", get(records))
            .query::<StreamQuery>()
            .gives_lines::<StreamLine>(),
        read("/metrics", "Counts for Prometheus", get(prometheus)).gives_file("text/plain"),
    ]
}

impl Api {
    pub(crate) fn router(self) -> Router {
        let router = Router::new();
        endpoints()
            .into_iter()
            .fold(router, |router, it| router.route(it.path, it.handler))
            .fallback(async || problem("there is nothing under this path"))
            .layer(DefaultBodyLimit::max(BODY_MAX))
            .with_state(self)
    }

    pub(crate) fn metrics_router(self) -> Router {
        Router::new().route("/metrics", get(prometheus)).with_state(self)
    }

    fn status(&self) -> VehicleStatus {
        self.cloud.add_to(self.core.status())
    }

    /// Calls `work`, which waits for the disk, in a thread for that.
    async fn blocking<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Orchestrator) -> Result<T, Failure> + Send + 'static,
    ) -> Reply<T> {
        let core = Arc::clone(&self.core);
        let done = tokio::task::spawn_blocking(move || work(&core)).await;
        let ended = |_| Failure::new(Exit::Internal, "the request was interrupted");
        Ok(done.map_err(ended)??)
    }
}

async fn status(State(api): State<Api>) -> Response {
    axum::Json(api.status()).into_response()
}

async fn prometheus(State(api): State<Api>) -> Response {
    let text = metrics::text(&api.status());
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4")], text).into_response()
}

async fn deploy(State(api): State<Api>, body: Bytes) -> Reply<axum::Json<DeployReply>> {
    let request: DeployRequest = serde_json::from_slice(&body)
        .map_err(|error| Failure::caused_by(Exit::Usage, "request is not a deployment", &error))?;
    Ok(axum::Json(api.blocking(move |core| core.deploy(&request, None)).await?))
}

async fn envelopes(
    State(api): State<Api>,
    Path(id): Path<String>,
) -> Reply<axum::Json<DeploymentEnvelopes>> {
    Ok(axum::Json(api.blocking(move |core| core.envelopes(&id)).await?))
}

/// Receives a file. It counts only if its digest is right.
async fn object(
    State(api): State<Api>,
    Path(sha256): Path<String>,
    body: Body,
) -> Reply<StatusCode> {
    let wanted: Sha256 = sha256
        .parse()
        .map_err(|_| Failure::new(Exit::Usage, "the path does not end with a SHA-256"))?;
    objects::receive(&api.core, &wanted, body.into_data_stream()).await?;
    Ok(StatusCode::NO_CONTENT)
}

async fn change(
    State(api): State<Api>,
    Path((id, change)): Path<(String, String)>,
) -> Reply<axum::Json<Changed>> {
    let changed = api.blocking(move |core| match &*change {
        "start" => core.set_wanted(&id, true, USER),
        "stop" => core.set_wanted(&id, false, USER),
        "rollback" => core.roll_back(&id, "rolled back by a user"),
        other => {
            let other = gleaner_base::excerpt(other);
            Err(Failure::new(Exit::Usage, format!("`{other}` is not a change of a deployment"))
                .with_help("the changes are `start`, `stop` and `rollback`"))
        }
    });
    Ok(axum::Json(Changed { attempt: changed.await? }))
}

async fn remove(State(api): State<Api>, Path(id): Path<String>) -> Reply<StatusCode> {
    api.blocking(move |core| core.remove(&id, USER)).await?;
    Ok(StatusCode::NO_CONTENT)
}

async fn trust(State(api): State<Api>, body: Bytes) -> Reply<StatusCode> {
    api.blocking(move |core| core.install_root(&body)).await?;
    Ok(StatusCode::NO_CONTENT)
}

async fn enrol(State(api): State<Api>, body: Bytes) -> Reply<StatusCode> {
    api.cloud.enrol(&api.core, &body).await?;
    Ok(StatusCode::NO_CONTENT)
}

async fn leave(State(api): State<Api>, Query(query): Query<LeaveQuery>) -> Reply<StatusCode> {
    if api.cloud.status().is_some() || !query.new_identity {
        api.cloud.leave()?;
    }
    if !query.new_identity {
        return Ok(StatusCode::NO_CONTENT);
    }
    // The next start makes another one.
    match std::fs::remove_file(api.core.layout.key()) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(Failure::caused_by(Exit::Internal, "cannot remove the key", &error).into())
        }
        _ => Ok(StatusCode::NO_CONTENT),
    }
}

async fn events(State(api): State<Api>, Query(query): Query<StreamQuery>) -> Reply<Response> {
    lines(&api, "", &spools::STREAMS, &query)
}

async fn records(
    State(api): State<Api>,
    Path(id): Path<String>,
    Query(query): Query<StreamQuery>,
) -> Reply<Response> {
    // Records of a deployment that was removed stay for a while.
    let name = id.parse::<ItemName>().ok();
    if !name.is_some_and(|name| api.core.has_records(&name)) {
        return Err(api.core.lock().unknown(&id).into());
    }
    lines(&api, "lambdas", &[&id], &query)
}

fn lines(api: &Api, below: &str, names: &[&str], query: &StreamQuery) -> Reply<Response> {
    let body = streams::lines(&api.core.layout.spool().join(below), names, query)?;
    Ok(([(header::CONTENT_TYPE, "application/x-ndjson")], body).into_response())
}

fn problem(what: &str) -> Response {
    ApiError(Failure::new(Exit::Usage, what)).into_response()
}

/// An error, as the client gets it.
pub(crate) struct ApiError(Failure);

impl From<Failure> for ApiError {
    fn from(failure: Failure) -> Self {
        Self(failure)
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let status = match self.0.exit {
            Exit::Usage => StatusCode::BAD_REQUEST,
            Exit::Denied => StatusCode::FORBIDDEN,
            Exit::Unreachable => StatusCode::SERVICE_UNAVAILABLE,
            _ => StatusCode::INTERNAL_SERVER_ERROR,
        };
        let text = serde_json::to_string(&Problem::new(self.0, status.as_u16()));
        let text = text.expect("plain data");
        (status, [(header::CONTENT_TYPE, "application/problem+json")], text).into_response()
    }
}

#[cfg(test)]
mod tests;
