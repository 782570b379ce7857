//! The API for people: JSON over HTTP, each request with a token. [`endpoints`] lists the requests,
//! and `docs/api/fleet.json` describes them; `gleaner_fleet::people` has the messages.
//!
//! This room checks no signature and has no key: the cloud stores and forwards what was signed, and
//! each vehicle decides by its own trust root. A deployment is only parsed, within the bounds of
//! its format.

mod accounts;
mod clips;
mod conditions;
mod deployments;
mod metrics;
mod records;
#[cfg(test)]
mod tests;
mod vehicles;

use std::sync::{Arc, LazyLock};

use axum::Router;
use axum::extract::{DefaultBodyLimit, Extension, Query, Request, State};
use axum::handler::Handler;
use axum::http::{HeaderMap, Method, header};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodFilter, get, on, post};
use gleaner_fleet::listener::ClientNetwork;
use gleaner_fleet::openapi::{Endpoint, describe};
use gleaner_fleet::people::{AuditEntry, ListPage, Login, Role, User, UserToken};
use serde_json::{Map, Value};

use crate::accounts::LOGIN;
use crate::cloud::{Call, Cloud};
use crate::error::{CloudError, CloudResult, as_problem, is_api};
use crate::request::{ListQuery, in_time};
use crate::store::TokenUser;

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

type ApiRow = Endpoint<Arc<Cloud>>;
type Actor = Call<TokenUser>;
type ListPart = Query<ListQuery<String>>;

const GET: Method = Method::GET;
const POST: Method = Method::POST;
const PUT: Method = Method::PUT;
const DELETE: Method = Method::DELETE;

/// Returns a request of users with the role.
fn row<T: 'static>(
    method: Method,
    path: &'static str,
    role: Role,
    summary: &'static str,
    handler: impl Handler<T, Arc<Cloud>>,
) -> ApiRow {
    let filter = MethodFilter::try_from(method.clone()).expect("it is one of those above");
    Endpoint::new(method, path, Some(role), summary, on(filter, handler))
}

/// Returns every request that the API answers: no role is stated elsewhere, and no need of a login
/// but that of tokens, of which one for programs removes itself only.
pub(crate) fn endpoints() -> Vec<ApiRow> {
    let open = |method, path, summary, handler| Endpoint::new(method, path, None, summary, handler);
    let login = post(accounts::login).layer(DefaultBodyLimit::max(LOGIN_MAX));
    let first = [
        open(GET, "/v1/openapi.json", "This description", get(document))
            .gives::<Map<String, Value>>(),
        open(GET, "/health", "The health of the cloud", get(metrics::health))
            .gives::<Map<String, Value>>(),
        row(GET, "/metrics", Role::Viewer, "Numbers for Prometheus", metrics::metrics)
            .gives_file("text/plain"),
        open(POST, "/v1/login", "Exchanges a one-time code for a token", login)
            .takes::<Login>()
            .gives::<UserToken>(),
    ];
    let trail = "The audit trail, the newest entry first";
    let audit = row(GET, "/v1/audit", Role::Admin, trail, accounts::audit)
        .query::<ListQuery<u64>>()
        .gives::<ListPage<AuditEntry>>();
    let areas = accounts::endpoints().into_iter().chain(vehicles::endpoints());
    let areas = areas.chain(deployments::endpoints()).chain([audit]).chain(clips::endpoints());
    first.into_iter().chain(areas).collect()
}

/// Returns all requests of the API, and the pages.
pub(crate) fn router(cloud: &Arc<Cloud>, pages: Router<Arc<Cloud>>) -> Router {
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
        .merge(pages.layer(from_fn(missing)))
        .layer(DefaultBodyLimit::max(SMALL_MAX))
        .layer(from_fn(as_problem))
        .with_state(Arc::clone(cloud))
}

/// Answers paths of the API that no request has. All others are of the pages.
async fn missing(request: Request, next: Next) -> Response {
    if !is_api(request.uri().path()) {
        return next.run(request).await;
    }
    let help = "`GET /v1/openapi.json` describes all requests";
    CloudError::missing("there is nothing under this path", help).into_response()
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
    let (found, wrong) = (cloud.store.user(token).await?, "the token is not valid, or has expired");
    let token_user = cloud.accounts.wrong_secrets.check(network, found, wrong, help)?;
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
