//! The page for people: HTML that needs no script, at the address of the API.
//!
//! `routes` lists every page and every form with its role; `guard` lets requests pass by it. A form
//! has to come from a page of the same session. `htmx` refreshes parts and follows streams where a
//! browser runs scripts; all else works without.
//!
//! Names, labels, problems and log lines come from vehicles and lambdas: they are escaped as HTML
//! by the templates, and lose their control characters and their excess of length in `text`. The
//! page signs nothing: it has no key, and offers only what needs none.

mod access;
mod account;
mod assets;
mod audit;
mod charts;
mod clip;
mod clips;
mod deployments;
mod fleet;
mod guard;
mod lambdas;
mod layout;
mod line;
mod login;
mod recording;
mod records;
mod search;
mod session;
mod status;
mod stream;
#[cfg(test)]
mod tests;
mod text;
mod vehicle;

use std::sync::Arc;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::http::Method;
use axum::middleware::{from_fn, from_fn_with_state};
use axum::routing::{get, post};
use gleaner_fleet::openapi::Endpoint;
use gleaner_fleet::people::Role;

use crate::cloud::Cloud;
use crate::request::in_time;

/// Returns every page and every form: no role is stated elsewhere.
pub(crate) fn routes() -> Vec<Endpoint<Arc<Cloud>>> {
    use Role::{Admin, Deployer, Operator, Viewer};
    let route = |method, path, role, handler| Endpoint::new(method, path, role, "", handler);
    let open = |path, handler| route(Method::GET, path, None, handler);
    let enter = |path, handler| route(Method::POST, path, None, handler);
    let read = |path, role, handler| route(Method::GET, path, Some(role), handler);
    let send = |path, role, handler| route(Method::POST, path, Some(role), handler);
    vec![
        open("/assets/{file}", get(assets::file)),
        open("/login", get(login::page)),
        enter("/login/code", post(login::by_code)),
        enter("/login/password", post(login::by_password)),
        send("/logout", Viewer, post(login::logout)),
        read("/account", Viewer, get(account::page)),
        send("/account/password", Viewer, post(account::set_password)),
        send("/account/tokens", Viewer, post(account::make_token)),
        send("/account/tokens/{name}/remove", Viewer, post(account::remove_token)),
        read("/", Viewer, get(fleet::start)),
        read("/vehicles", Viewer, get(fleet::page)),
        read("/vehicles/{name}", Viewer, get(vehicle::page)),
        send("/vehicles/{name}/agree", Admin, post(vehicle::agree)),
        read("/vehicles/{name}/events", Viewer, get(records::page)),
        read("/vehicles/{name}/events/stream", Viewer, get(stream::follow)),
        read("/vehicles/{name}/lambdas/{id}", Viewer, get(records::page)),
        read("/vehicles/{name}/lambdas/{id}/stream", Viewer, get(stream::follow)),
        read("/clips", Viewer, get(clips::page)),
        read("/clips/{id}", Viewer, get(clip::page)),
        read("/clips/{id}/thumbnail", Viewer, get(clip::thumbnail)),
        read("/clips/{id}/file", Viewer, get(clip::file)),
        send("/clips/{id}/pull", Operator, post(clip::pull)),
        read("/lambdas", Viewer, get(lambdas::page)),
        read("/lambdas/{digest}", Viewer, get(lambdas::revision)),
        read("/deployments", Viewer, get(deployments::list)),
        read("/deployments/{id}", Viewer, get(deployments::page)),
        send("/deployments/{id}/{change}", Operator, post(deployments::change)),
        send("/deployments/{id}/remove", Deployer, post(deployments::remove)),
        read("/access", Admin, get(access::page)),
        send("/access/users", Admin, post(access::invite)),
        send("/access/users/{name}/remove", Admin, post(access::remove_user)),
        send("/access/vehicles", Admin, post(access::enrol)),
        send("/access/vehicles/{name}/revoke", Admin, post(access::revoke)),
        read("/audit", Admin, get(audit::page)),
    ]
}

pub(crate) fn router(cloud: &Arc<Cloud>) -> Router<Arc<Cloud>> {
    let mut router = Router::new();
    for Endpoint { path, role, handler, .. } in routes() {
        let state = (Arc::clone(cloud), role);
        let guarded = handler.route_layer(from_fn_with_state(state, guard::guard));
        router =
            router.route(path, guarded.layer(from_fn(in_time)).layer(from_fn(layout::as_page)));
    }
    router.layer(DefaultBodyLimit::max(guard::FORM_MAX)).fallback(async || layout::nothing_here())
}
