//! The API for people: JSON over HTTP, each request with a token. [`endpoints`] lists the requests,
//! and `docs/api/fleet.json` describes them; `gleaner_fleet::people` has the messages.
//!
//! This room checks no signature and has no key: the cloud stores and forwards what was signed, and
//! each vehicle decides by its own trust root. A deployment is only parsed, within the bounds of
//! its format.

mod conditions;
mod deploy;
mod lists;
mod metrics;
mod records;
#[cfg(test)]
pub(crate) mod tests;
pub(crate) mod tokens;

use std::sync::{Arc, LazyLock};

use axum::Json;
use axum::Router;
use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, Extension, Path, Request, State};
use axum::http::{HeaderMap, Method, StatusCode, Uri, header};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{self, delete, get, post};
use gleaner_fleet::Enrolment;
use gleaner_fleet::clips::{ClipPolicy, ClipUsage, FleetClip};
use gleaner_fleet::entrance::ClientNetwork;
use gleaner_fleet::openapi::{Endpoint, describe};
use gleaner_fleet::people::{
    AuditEntry, FleetDeployRequest, FleetDeployment, Invitation, ListPage, Login, NewToken,
    NewUser, NewVehicle, ReportedRelease, Role, TokenSummary, User, UserToken, VehicleSummary,
};
use gleaner_fleet::records::FoundRecords;
use gleaner_fleet::waves::WaveState;
use gleaner_protocol::vehicle_api::{DeployReply, DeploymentEnvelopes, StreamLine, VehicleStatus};
use serde_json::{Map, Value};

use crate::clips::people as clips;
use crate::cloud::{Call, Cloud};
use crate::error::{CloudError, CloudResult, as_problem, is_api};
use crate::page;
use crate::records::RecordSearch;
use crate::request::{ListQuery, in_time, parsed};
use crate::store::{ChangeAuthor, ClipQuery, TokenUser};
use crate::transfer::OCTETS;

use self::conditions::{ChangeConditions, tagged};
use self::records::RecordQuery;

/// Maximum length of a deployment without its files: one with two revisions of 4 MiB each, as
/// text in JSON.
const BODY_MAX: usize = 12 << 20;

/// Maximum length of any other request without files.
const SMALL_MAX: usize = 64 << 10;

/// Maximum length of a request without a token.
const LOGIN_MAX: usize = 4 << 10;

/// Headers of a request that creates something, of a change, of a read, and of a stream.
const CREATES: &[&str] = &["Idempotency-Key"];
const CHANGES: &[&str] = &["If-Match"];
const READS: &[&str] = &["If-None-Match"];
const RESUMES: &[&str] = &["Last-Event-ID"];

/// The way out for a token for programs that is refused.
const LOGIN: &str = "use the token of a login: `gleaner login`";

/// Returns every request that the API answers: no role is stated elsewhere, and no need of a login
/// but that of tokens, of which one for programs removes itself only.
#[expect(clippy::too_many_lines, reason = "a table of requests, read from top to bottom")]
pub(crate) fn endpoints() -> Vec<Endpoint<Arc<Cloud>>> {
    use Role::{Admin, Deployer, Operator, Viewer};
    let new = Endpoint::new;
    let read = |path, role, what, handler| new(Method::GET, path, Some(role), what, handler);
    let send = |path, role, what, handler| new(Method::POST, path, Some(role), what, handler);
    let put = |path, role, what, handler| new(Method::PUT, path, Some(role), what, handler);
    let remove = |path, role, what, handler| new(Method::DELETE, path, Some(role), what, handler);
    let deploy = post(deploy::deploy).layer(DefaultBodyLimit::max(BODY_MAX));
    let open = |method, path, what, handler| new(method, path, None, what, handler);
    vec![
        open(Method::GET, "/v1/openapi.json", "This description", get(document))
            .gives::<Map<String, Value>>(),
        open(Method::GET, "/health", "The health of the cloud", get(metrics::health))
            .gives::<Map<String, Value>>(),
        read("/metrics", Viewer, "Numbers for Prometheus", get(metrics::metrics))
            .gives_file("text/plain"),
        open(
            Method::POST,
            "/v1/login",
            "Exchanges a one-time code for a token",
            post(login).layer(DefaultBodyLimit::max(LOGIN_MAX)),
        )
        .takes::<Login>()
        .gives::<UserToken>(),
        read("/v1/me", Viewer, "The user of the token", get(me)).gives::<User>(),
        remove("/v1/login", Viewer, "Ends the token of the request", delete(tokens::logout)),
        read(
            "/v1/tokens",
            Viewer,
            "Own tokens for programs, or all for an admin",
            get(tokens::list),
        )
        .query::<ListQuery<String>>()
        .gives::<ListPage<TokenSummary>>(),
        send("/v1/tokens", Viewer, "Makes a token for programs", post(tokens::make))
            .needs_login()
            .headers(CREATES)
            .takes::<NewToken>()
            .gives::<UserToken>(),
        remove("/v1/tokens/{user}/{name}", Viewer, "Removes a token", delete(tokens::remove)),
        read("/v1/users", Admin, "All users", get(lists::users))
            .query::<ListQuery<String>>()
            .gives::<ListPage<User>>(),
        send("/v1/users", Admin, "Invites a user, or one again", post(invite))
            .headers(CREATES)
            .takes::<NewUser>()
            .gives::<Invitation>(),
        remove("/v1/users/{name}", Admin, "Removes a user", delete(remove_user)),
        read("/v1/vehicles", Viewer, "All vehicles", get(lists::vehicles))
            .query::<ListQuery<String>>()
            .gives::<ListPage<VehicleSummary>>(),
        send("/v1/vehicles", Admin, "Invites a vehicle, or one again", post(invite_vehicle))
            .headers(CREATES)
            .takes::<NewVehicle>()
            .gives::<Enrolment>(),
        remove("/v1/vehicles/{name}", Admin, "Cuts a vehicle off", delete(revoke)),
        send(
            "/v1/vehicles/{name}/agree",
            Admin,
            "Lets a vehicle follow a state that is older than it has followed",
            post(agree),
        ),
        read("/v1/vehicles/{name}/status", Viewer, "The last report of a vehicle", get(status))
            .gives::<VehicleStatus>(),
        read("/v1/vehicles/{name}/events", Viewer, "Events of a vehicle", get(records::lines))
            .query::<RecordQuery>()
            .headers(RESUMES)
            .gives_lines::<StreamLine>(),
        read(
            "/v1/vehicles/{name}/lambdas/{id}/records",
            Viewer,
            "Records of a deployment on a vehicle",
            get(records::lines),
        )
        .query::<RecordQuery>()
        .headers(RESUMES)
        .gives_lines::<StreamLine>(),
        read("/v1/records", Viewer, "Searches records of all vehicles", get(lists::records))
            .query::<RecordSearch>()
            .gives::<FoundRecords>(),
        put(
            "/v1/objects/{sha256}",
            Deployer,
            "Stores a file that a deployment needs",
            routing::put(deploy::object),
        )
        .takes_file(),
        send("/v1/deployments", Deployer, "Stores a deployment", deploy)
            .headers(CREATES)
            .takes::<FleetDeployRequest>()
            .gives::<DeployReply>(),
        read("/v1/deployments", Viewer, "All deployments", get(lists::deployments))
            .query::<ListQuery<String>>()
            .headers(READS)
            .gives::<ListPage<FleetDeployment>>(),
        read("/v1/deployments/{id}", Viewer, "A deployment", get(deployment))
            .headers(READS)
            .gives::<FleetDeployment>(),
        read(
            "/v1/deployments/{id}/envelopes",
            Deployer,
            "The signed parts of a deployment",
            get(deploy::envelopes),
        )
        .gives::<DeploymentEnvelopes>(),
        read(
            "/v1/deployments/{id}/reported",
            Viewer,
            "The highest releases of a deployment that vehicles have reported",
            get(deploy::reported),
        )
        .gives::<Vec<ReportedRelease>>(),
        send(
            "/v1/deployments/{id}/{change}",
            Operator,
            "Changes a deployment: `start`, `stop`, `rollback`, `pause`, `resume` or `abort`",
            post(change),
        )
        .headers(CHANGES)
        .gives::<FleetDeployment>(),
        remove("/v1/deployments/{id}", Deployer, "Removes a deployment", delete(remove_deployment))
            .headers(CHANGES),
        read("/v1/audit", Admin, "The audit trail, the newest entry first", get(lists::audit))
            .query::<ListQuery<u64>>()
            .gives::<ListPage<AuditEntry>>(),
        read("/v1/clips", Viewer, "Clips, the last announced first", get(clips::list))
            .query::<ClipQuery>()
            .gives::<ListPage<FleetClip>>(),
        read("/v1/clips/policy", Viewer, "The rules for the upload of clips", get(clips::policy))
            .gives::<ClipPolicy>(),
        put("/v1/clips/policy", Admin, "Sets these rules", routing::put(clips::set_policy))
            .takes::<ClipPolicy>()
            .gives::<ClipPolicy>(),
        read("/v1/clips/usage", Viewer, "What is stored of clips", get(clips::usage))
            .gives::<ClipUsage>(),
        read("/v1/clips/{id}", Viewer, "A clip", get(clips::show)).gives::<FleetClip>(),
        remove("/v1/clips/{id}", Deployer, "Removes a stored clip", delete(clips::remove)),
        read("/v1/clips/{id}/thumbnail", Viewer, "An image of a clip", get(clips::thumbnail))
            .gives_file("image/jpeg"),
        read("/v1/clips/{id}/file", Viewer, "The file of a clip", get(clips::file))
            .headers(&["Range"])
            .gives_file(OCTETS),
        send("/v1/clips/{id}/pull", Operator, "Marks a clip as wanted", post(clips::pull))
            .gives::<FleetClip>(),
    ]
}

pub(crate) fn router(cloud: &Arc<Cloud>) -> Router {
    let mut router = Router::new();
    for Endpoint { path, role, needs_login, handler, .. } in endpoints() {
        let guarded = match role {
            None => handler,
            Some(role) => {
                let state = (Arc::clone(cloud), role, needs_login);
                handler.route_layer(from_fn_with_state(state, guard))
            }
        };
        // A file may take its time.
        let is_file = path.starts_with("/v1/objects");
        let timed = if is_file { guarded } else { guarded.layer(from_fn(in_time)) };
        router = router.route(path, timed);
    }
    router
        .merge(page::router(cloud))
        .fallback(async |uri: Uri| match is_api(uri.path()) {
            true => CloudError::missing(
                "there is nothing under this path",
                "`GET /v1/openapi.json` describes all requests",
            )
            .into_response(),
            false => page::nothing_here(),
        })
        .layer(DefaultBodyLimit::max(SMALL_MAX))
        .layer(from_fn(as_problem))
        .with_state(Arc::clone(cloud))
}

/// Lets requests pass whose token is of a user with the role, and of a login if it has to be.
async fn guard(
    State((cloud, role, needs_login)): State<(Arc<Cloud>, Role, bool)>,
    Extension(network): Extension<ClientNetwork>,
    mut request: Request,
    next: Next,
) -> Response {
    match user(&cloud, role, network, request.headers()).await {
        Ok(user) if needs_login && !user.name.is_empty() => {
            let message = format!("token `{}` is for programs, and this needs a login", user.name);
            CloudError::denied(message, LOGIN).into_response()
        }
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
    network: ClientNetwork,
    headers: &HeaderMap,
) -> CloudResult<TokenUser> {
    let help = "log in again: `gleaner login URL --code CODE`; an administrator gives you a code";
    let token = bearer(headers);
    let token = token.ok_or_else(|| CloudError::unknown("the request has no token", help))?;
    let Some(token_user) = cloud.store.user(token).await? else {
        cloud.wrong_secrets.count(network)?;
        return Err(CloudError::unknown("the token is not valid, or has expired", help));
    };
    let User { name, role: has } = &token_user.user;
    if *has < role {
        let (message, help) = match &*token_user.name {
            "" => (
                format!("user `{name}` has the role {has}, and this needs {role}"),
                "let an administrator invite you with that role",
            ),
            token => (
                format!("token `{token}` has the role {has}, and this needs {role}"),
                "make another token with that role, if you have it",
            ),
        };
        return Err(CloudError::denied(message, help));
    }
    Ok(token_user)
}

fn bearer(headers: &HeaderMap) -> Option<&str> {
    let header = headers.get(header::AUTHORIZATION)?.to_str().ok()?;
    header.strip_prefix("Bearer ")
}

async fn document() -> Response {
    static DOCUMENT: LazyLock<String> = LazyLock::new(|| {
        describe("Gleaner cloud", "The API for people of the cloud of a fleet.", &endpoints())
    });
    ([(header::CONTENT_TYPE, "application/json")], DOCUMENT.as_str()).into_response()
}

async fn login(
    State(cloud): State<Arc<Cloud>>,
    Extension(network): Extension<ClientNetwork>,
    body: Bytes,
) -> CloudResult<Json<UserToken>> {
    let Login { code } = parsed(&body, "login")?;
    let Some(token) = cloud.store.login(&code).await? else {
        cloud.wrong_secrets.count(network)?;
        let help = "a code works once, for 24 hours: let an administrator invite you again, or run \
                    `gleaner-cloud invite NAME --role ROLE --data DIR` beside the cloud";
        return Err(CloudError::unknown("the code is not valid", help));
    };
    Ok(Json(token))
}

async fn me(Extension(user): Extension<TokenUser>) -> Json<User> {
    Json(user.user)
}

async fn invite(
    Call(cloud, actor): Call<TokenUser>,
    headers: HeaderMap,
    body: Bytes,
) -> CloudResult<Json<Invitation>> {
    let conditions = ChangeConditions::of_new(&headers, "/v1/users", &body)?;
    let new: NewUser = parsed(&body, "invitation")?;
    Ok(Json(cloud.store.invite(conditions.by(&actor), new).await?))
}

pub(crate) async fn remove_user(
    Call(cloud, actor): Call<TokenUser>,
    Path(name): Path<String>,
) -> CloudResult<StatusCode> {
    cloud.store.remove_user(&actor.actor, &name).await?;
    cloud.readers.end(&name);
    Ok(StatusCode::NO_CONTENT)
}

async fn invite_vehicle(
    Call(cloud, actor): Call<TokenUser>,
    headers: HeaderMap,
    body: Bytes,
) -> CloudResult<Json<Enrolment>> {
    let conditions = ChangeConditions::of_new(&headers, "/v1/vehicles", &body)?;
    let NewVehicle { name } = parsed(&body, "enrolment of a vehicle")?;
    enrolment(&cloud, conditions.by(&actor), &name).await.map(Json)
}

/// Invites a vehicle; returns the content of its file.
pub(crate) async fn enrolment(
    cloud: &Cloud,
    author: impl Into<ChangeAuthor<'_>>,
    name: &str,
) -> CloudResult<Enrolment> {
    let token = cloud.store.invite_vehicle(author, name).await?;
    Ok(Enrolment {
        gleaner_enrolment: 1,
        address: cloud.address.clone(),
        vehicle: name.to_owned(),
        authority: cloud.authorities.server_pem().to_owned(),
        token,
    })
}

pub(crate) async fn agree(
    Call(cloud, actor): Call<TokenUser>,
    Path(name): Path<String>,
) -> CloudResult<StatusCode> {
    cloud.store.agree(&actor.actor, &name).await?;
    cloud.hub.wake(&[name]);
    Ok(StatusCode::NO_CONTENT)
}

pub(crate) async fn revoke(
    Call(cloud, actor): Call<TokenUser>,
    Path(name): Path<String>,
) -> CloudResult<StatusCode> {
    cloud.store.revoke(&actor.actor, &name).await?;
    cloud.hub.end(&name, "the vehicle was cut off");
    Ok(StatusCode::NO_CONTENT)
}

async fn status(
    State(cloud): State<Arc<Cloud>>,
    Path(name): Path<String>,
) -> CloudResult<Response> {
    let status = cloud.store.status(&name).await?;
    cloud.tails.watch(&name);
    Ok(([(header::CONTENT_TYPE, "application/json")], status).into_response())
}

async fn deployment(
    State(cloud): State<Arc<Cloud>>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let deployment = cloud.store.deployment(&id).await?;
    tagged(&headers, &deployment.version, &deployment)
}

/// Makes a change of a deployment that its name states, and wakes the vehicles that it is for.
pub(crate) async fn change_deployment(
    cloud: &Cloud,
    author: impl Into<ChangeAuthor<'_>>,
    id: &str,
    change: &str,
) -> CloudResult<()> {
    let author = author.into();
    let changed = match change {
        "start" => cloud.store.set_wanted(author, id, true).await?,
        "stop" => cloud.store.set_wanted(author, id, false).await?,
        "rollback" => cloud.store.roll_back(author, id).await?,
        "pause" => cloud.store.steer_waves(author, id, WaveState::Paused).await?,
        "resume" => cloud.store.steer_waves(author, id, WaveState::Running).await?,
        "abort" => cloud.store.steer_waves(author, id, WaveState::Aborted).await?,
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
    Call(cloud, actor): Call<TokenUser>,
    Path((id, change)): Path<(String, String)>,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let conditions = ChangeConditions::of_change(&headers)?;
    change_deployment(&cloud, conditions.by(&actor), &id, &change).await?;
    let deployment = cloud.store.deployment(&id).await?;
    tagged(&HeaderMap::new(), &deployment.version, &deployment)
}

pub(crate) async fn remove_deployment(
    Call(cloud, actor): Call<TokenUser>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> CloudResult<StatusCode> {
    let conditions = ChangeConditions::of_change(&headers)?;
    let changed = cloud.store.remove_deployment(conditions.by(&actor), &id).await?;
    cloud.hub.wake(&changed);
    Ok(StatusCode::NO_CONTENT)
}
