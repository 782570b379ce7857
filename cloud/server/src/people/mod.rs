//! The API for people: JSON over HTTP, each request with a token. `gleaner_fleet::people` lists the
//! requests.
//!
//! This room checks no signature and has no key: the cloud stores and forwards what was signed, and
//! each vehicle decides by its own trust root. A deployment is only parsed, within the bounds of
//! its format.

mod deploy;
mod records;
#[cfg(test)]
pub(crate) mod tests;

use std::sync::Arc;

use axum::Json;
use axum::Router;
use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, Extension, Path, Request, State};
use axum::http::{HeaderMap, Method, StatusCode, Uri, header};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, delete, get, post, put};
use gleaner_fleet::Enrolment;
use gleaner_fleet::people::{
    FleetDeployment, Invitation, Login, NewUser, NewVehicle, Role, User, UserToken,
};
use gleaner_fleet::waves::WaveState;

use crate::accept::PeerConnection;
use crate::clips::people as clips;
use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};
use crate::page;
use crate::request::{in_time, parsed};
use crate::store::ENTRIES_MAX;

/// Maximum length of a request without files: a deployment with two revisions of 4 MiB each, as
/// text in JSON.
const BODY_MAX: usize = 12 << 20;

/// Maximum length of a request without a token.
const LOGIN_MAX: usize = 4 << 10;

/// A request that the API answers.
pub(crate) struct Endpoint {
    /// Its method, which the handler has, too.
    #[cfg_attr(not(test), expect(dead_code, reason = "read by the test of all roles"))]
    pub(crate) method: Method,
    /// Its path.
    pub(crate) path: &'static str,
    /// The least role; `None` if no token is needed.
    pub(crate) role: Option<Role>,
    handler: MethodRouter<Arc<Cloud>>,
}

/// Returns every request that the API answers: no role is stated elsewhere.
pub(crate) fn endpoints() -> Vec<Endpoint> {
    use Role::{Admin, Deployer, Operator, Viewer};
    let endpoint = |method, path, role, handler| Endpoint { method, path, role, handler };
    let read = |path, role, handler| endpoint(Method::GET, path, Some(role), handler);
    let send = |path, role, handler| endpoint(Method::POST, path, Some(role), handler);
    let remove = |path, role, handler| endpoint(Method::DELETE, path, Some(role), handler);
    vec![
        endpoint(
            Method::POST,
            "/v1/login",
            None,
            post(login).layer(DefaultBodyLimit::max(LOGIN_MAX)),
        ),
        read("/v1/me", Viewer, get(me)),
        read("/v1/users", Admin, get(users)),
        send("/v1/users", Admin, post(invite)),
        remove("/v1/users/{name}", Admin, delete(remove_user)),
        read("/v1/vehicles", Viewer, get(vehicles)),
        send("/v1/vehicles", Admin, post(invite_vehicle)),
        remove("/v1/vehicles/{name}", Admin, delete(revoke)),
        read("/v1/vehicles/{name}/status", Viewer, get(status)),
        read("/v1/vehicles/{name}/events", Viewer, get(records::events)),
        read("/v1/vehicles/{name}/lambdas/{id}/records", Viewer, get(records::lambda)),
        endpoint(Method::PUT, "/v1/objects/{sha256}", Some(Deployer), put(deploy::object)),
        send("/v1/deployments", Deployer, post(deploy::deploy)),
        read("/v1/deployments", Viewer, get(deployments)),
        send("/v1/deployments/{id}/{change}", Operator, post(change)),
        remove("/v1/deployments/{id}", Deployer, delete(remove_deployment)),
        read("/v1/audit", Admin, get(audit)),
        read("/v1/clips", Viewer, get(clips::list)),
        read("/v1/clips/policy", Viewer, get(clips::policy)),
        endpoint(Method::PUT, "/v1/clips/policy", Some(Admin), put(clips::set_policy)),
        read("/v1/clips/usage", Viewer, get(clips::usage)),
        read("/v1/clips/{id}", Viewer, get(clips::show)),
        remove("/v1/clips/{id}", Deployer, delete(clips::remove)),
        read("/v1/clips/{id}/thumbnail", Viewer, get(clips::thumbnail)),
        read("/v1/clips/{id}/file", Viewer, get(clips::file)),
        send("/v1/clips/{id}/pull", Operator, post(clips::pull)),
    ]
}

/// Returns the routes.
pub(crate) fn router(cloud: &Arc<Cloud>) -> Router {
    let mut router = Router::new();
    for Endpoint { path, role, handler, .. } in endpoints() {
        let guarded = match role {
            None => handler,
            Some(role) => handler.route_layer(from_fn_with_state((Arc::clone(cloud), role), guard)),
        };
        // A file may take its time.
        let is_file = path.starts_with("/v1/objects");
        let timed = if is_file { guarded } else { guarded.layer(from_fn(in_time)) };
        router = router.route(path, timed);
    }
    router
        .merge(page::router(cloud))
        .fallback(async |uri: Uri| match uri.path().starts_with("/v1/") {
            true => CloudError::missing("there is nothing under this path", "see the docs")
                .into_response(),
            false => page::nothing_here(),
        })
        .layer(DefaultBodyLimit::max(BODY_MAX))
        .with_state(Arc::clone(cloud))
}

/// Lets requests pass whose token is of a user with the role.
async fn guard(
    State((cloud, role)): State<(Arc<Cloud>, Role)>,
    Extension(peer): Extension<Arc<PeerConnection>>,
    mut request: Request,
    next: Next,
) -> Response {
    match user(&cloud, role, &peer, request.headers()).await {
        Ok(user) => {
            request.extensions_mut().insert(user);
            next.run(request).await
        }
        Err(error) => error.into_response(),
    }
}

async fn user(
    cloud: &Cloud,
    role: Role,
    peer: &PeerConnection,
    headers: &HeaderMap,
) -> CloudResult<User> {
    let help = "log in again: `gleaner login URL --code CODE`; an administrator gives you a code";
    let header = headers.get(header::AUTHORIZATION).and_then(|it| it.to_str().ok());
    let token = header
        .and_then(|it| it.strip_prefix("Bearer "))
        .ok_or_else(|| CloudError::unknown("the request has no token", help))?;
    let Some(user) = cloud.store.user(token).await? else {
        cloud.wrong_secrets.count(peer.address)?;
        return Err(CloudError::unknown("the token is not valid, or has expired", help));
    };
    if user.role < role {
        let message =
            format!("user `{}` has the role {}, and this needs {role}", user.name, user.role);
        return Err(CloudError::denied(message, "let an administrator invite you with that role"));
    }
    Ok(user)
}

async fn login(
    State(cloud): State<Arc<Cloud>>,
    Extension(peer): Extension<Arc<PeerConnection>>,
    body: Bytes,
) -> CloudResult<Json<UserToken>> {
    let Login { code } = parsed(&body, "login")?;
    let Some(token) = cloud.store.login(&code).await? else {
        cloud.wrong_secrets.count(peer.address)?;
        let help = "a code works once, for 24 hours: let an administrator invite you again, or run \
                    `gleaner-cloud invite NAME --role ROLE --data DIR` beside the cloud";
        return Err(CloudError::unknown("the code is not valid", help));
    };
    Ok(Json(token))
}

async fn me(Extension(user): Extension<User>) -> Json<User> {
    Json(user)
}

async fn users(State(cloud): State<Arc<Cloud>>) -> CloudResult<Response> {
    Ok(Json(cloud.store.users().await?).into_response())
}

async fn invite(
    State(cloud): State<Arc<Cloud>>,
    Extension(actor): Extension<User>,
    body: Bytes,
) -> CloudResult<Json<Invitation>> {
    let new: NewUser = parsed(&body, "invitation")?;
    Ok(Json(cloud.store.invite(&actor.name, new).await?))
}

async fn remove_user(
    State(cloud): State<Arc<Cloud>>,
    Extension(actor): Extension<User>,
    Path(name): Path<String>,
) -> CloudResult<StatusCode> {
    cloud.store.remove_user(&actor.name, &name).await?;
    cloud.readers.end(&name);
    Ok(StatusCode::NO_CONTENT)
}

async fn vehicles(State(cloud): State<Arc<Cloud>>) -> CloudResult<Response> {
    let vehicles = cloud.store.vehicles(|name| cloud.hub.is_online(name)).await?;
    Ok(Json(vehicles).into_response())
}

async fn invite_vehicle(
    State(cloud): State<Arc<Cloud>>,
    Extension(actor): Extension<User>,
    body: Bytes,
) -> CloudResult<Json<Enrolment>> {
    let NewVehicle { name } = parsed(&body, "enrolment of a vehicle")?;
    enrolment(&cloud, &actor.name, &name).await.map(Json)
}

/// Invites a vehicle; returns the content of its file.
pub(crate) async fn enrolment(cloud: &Cloud, actor: &str, name: &str) -> CloudResult<Enrolment> {
    let token = cloud.store.invite_vehicle(actor, name).await?;
    Ok(Enrolment {
        gleaner_enrolment: 1,
        address: cloud.address.clone(),
        vehicle: name.to_owned(),
        authority: cloud.authorities.server_pem().to_owned(),
        token,
    })
}

async fn revoke(
    State(cloud): State<Arc<Cloud>>,
    Extension(actor): Extension<User>,
    Path(name): Path<String>,
) -> CloudResult<StatusCode> {
    cloud.store.revoke(&actor.name, &name).await?;
    cloud.hub.end(&name, "the vehicle was cut off");
    Ok(StatusCode::NO_CONTENT)
}

async fn status(
    State(cloud): State<Arc<Cloud>>,
    Path(name): Path<String>,
) -> CloudResult<Response> {
    let status = cloud.store.status(&name).await?;
    Ok(([(header::CONTENT_TYPE, "application/json")], status).into_response())
}

async fn deployments(State(cloud): State<Arc<Cloud>>) -> CloudResult<Json<Vec<FleetDeployment>>> {
    Ok(Json(cloud.store.deployments().await?))
}

/// Makes a change of a deployment that its name states, and wakes the vehicles that it is for.
pub(crate) async fn change_deployment(
    cloud: &Cloud,
    actor: &User,
    id: &str,
    change: &str,
) -> CloudResult<()> {
    let changed = match change {
        "start" => cloud.store.set_wanted(&actor.name, id, true).await?,
        "stop" => cloud.store.set_wanted(&actor.name, id, false).await?,
        "rollback" => cloud.store.roll_back(&actor.name, id).await?,
        "pause" => cloud.store.steer_waves(&actor.name, id, WaveState::Paused).await?,
        "resume" => cloud.store.steer_waves(&actor.name, id, WaveState::Running).await?,
        "abort" => cloud.store.steer_waves(&actor.name, id, WaveState::Aborted).await?,
        other => {
            let message = format!("`{}` is no change", gleaner_base::excerpt(other));
            let help = "use `start`, `stop`, `rollback`, `pause`, `resume` or `abort`";
            return Err(CloudError::usage(message, help));
        }
    };
    cloud.hub.wake(&changed);
    Ok(())
}

async fn change(
    State(cloud): State<Arc<Cloud>>,
    Extension(actor): Extension<User>,
    Path((id, change)): Path<(String, String)>,
) -> CloudResult<Json<FleetDeployment>> {
    change_deployment(&cloud, &actor, &id, &change).await?;
    Ok(Json(cloud.store.deployment(&id).await?))
}

async fn remove_deployment(
    State(cloud): State<Arc<Cloud>>,
    Extension(actor): Extension<User>,
    Path(id): Path<String>,
) -> CloudResult<StatusCode> {
    let changed = cloud.store.remove_deployment(&actor.name, &id).await?;
    cloud.hub.wake(&changed);
    Ok(StatusCode::NO_CONTENT)
}

async fn audit(State(cloud): State<Arc<Cloud>>) -> CloudResult<Response> {
    Ok(Json(cloud.store.audit(u64::MAX, ENTRIES_MAX).await?).into_response())
}
