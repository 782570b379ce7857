use std::time::Duration;

use axum::body::{Body, to_bytes};
use axum::http::StatusCode;
use gleaner_fleet::people::{NewToken, NewUser};
use hyper::service::Service;
use hyper_util::service::TowerToHyperService;

use super::*;
use crate::page;
use crate::store::{ChangeAuthor, ClipBounds, CloudStore, Retention};
use serde_json::{Value, json};

const ROLES: [Role; 4] = [Role::Viewer, Role::Operator, Role::Deployer, Role::Admin];

struct ApiAnswer {
    status: StatusCode,
    headers: HeaderMap,
    body: Vec<u8>,
}

impl ApiAnswer {
    fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap()
    }
}

/// Sends a request with a token and further headers; returns the answer.
async fn send(
    cloud: &Arc<Cloud>,
    (method, path): (Method, &str),
    token: Option<&str>,
    headers: &[(&str, &str)],
    body: impl Into<Body>,
) -> ApiAnswer {
    let network = ClientNetwork::of([127, 0, 0, 1].into());
    let mut request = Request::builder().method(method).uri(path).extension(network);
    if let Some(token) = token {
        request = request.header(header::AUTHORIZATION, format!("Bearer {token}"));
    }
    for (name, value) in headers {
        request = request.header(*name, *value);
    }
    let reply = answer(cloud, request.body(body.into()).unwrap()).await;
    let (parts, body) = reply.into_parts();
    let body = to_bytes(body, BODY_MAX).await.unwrap().to_vec();
    ApiAnswer { status: parts.status, headers: parts.headers, body }
}

/// Returns an answer whose body may last.
async fn answer(cloud: &Arc<Cloud>, request: Request<Body>) -> Response {
    TowerToHyperService::new(router(cloud, page::router(cloud))).call(request).await.unwrap()
}

async fn status_of(
    cloud: &Arc<Cloud>,
    method: Method,
    path: &str,
    token: Option<&str>,
) -> StatusCode {
    send(cloud, (method, path), token, &[], "{}").await.status
}

async fn code_of(cloud: &Cloud, name: &str, role: Role) -> String {
    let new = NewUser { name: name.to_owned(), role };
    cloud.store.invite("console", new).await.unwrap().code
}

async fn token_of(cloud: &Cloud, name: &str, role: Role) -> String {
    let code = code_of(cloud, name, role).await;
    cloud.store.login(&code).await.unwrap().unwrap().token
}

mod conditions;
mod gaps;
mod metrics;
mod openapi;
mod programs;
mod ranges;

#[tokio::test]
async fn each_request_is_open_to_its_role_and_the_higher_ones_only() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut tokens = Vec::new();
    for role in ROLES {
        tokens.push((role, token_of(&cloud, role.as_str(), role).await));
    }
    for Endpoint { method, path, role, .. } in endpoints() {
        // Things that do not exist: a request that is let through changes nothing.
        let path = path.replace("{name}", "no-such").replace("{id}", "no-such");
        let path = path.replace("{user}", "no-such");
        // It ends the token of each, which has a test of its own.
        if (&method, &*path) == (&Method::DELETE, "/v1/login") {
            continue;
        }
        let path = path.replace("{change}", "start").replace("{sha256}", &"0".repeat(64));
        let status = status_of(&cloud, method.clone(), &path, None).await;
        let expected = match role {
            None if method == Method::GET => StatusCode::OK,
            None => StatusCode::BAD_REQUEST,
            Some(_) => StatusCode::UNAUTHORIZED,
        };
        assert_eq!(status, expected, "{method} {path} without a token");
        for (has, token) in &tokens {
            let status = status_of(&cloud, method.clone(), &path, Some(token)).await;
            let is_let = role.is_none_or(|role| *has >= role);
            assert_eq!(
                status != StatusCode::FORBIDDEN,
                is_let,
                "{method} {path} as {has}: {status}"
            );
            assert_ne!(status, StatusCode::UNAUTHORIZED, "{method} {path} as {has}");
            assert!(!status.is_server_error(), "{method} {path} as {has}: {status}");
        }
    }
}

#[tokio::test]
async fn a_token_for_programs_has_at_most_the_rights_of_its_user_and_makes_no_others() {
    let (_folder, cloud) = Cloud::of_test().await;
    let invite = async |role| code_of(&cloud, "ann", role).await;
    let login = cloud.store.login(&invite(Role::Deployer).await).await.unwrap().unwrap();
    let make = async |name: &str, role, days| {
        let new = NewToken { name: name.to_owned(), role, days };
        cloud.store.make_token((&login.user, (&login.user.name).into()), new).await
    };
    let made = make("nightly", Role::Operator, 30).await.unwrap();
    let reason = |made: CloudResult<UserToken>| made.unwrap_err().reason();
    assert!(reason(make("nightly", Role::Viewer, 1).await).contains("a token `nightly` already"));
    assert!(reason(make("a", Role::Admin, 1).await).contains("has the role deployer, not admin"));
    assert!(reason(make("a/b", Role::Viewer, 1).await).contains("cannot be the name"));
    for days in [0, 367, u32::MAX] {
        assert!(reason(make("a", Role::Viewer, days).await).contains("cannot be valid"));
    }
    let status =
        async |method, path, token: &str| status_of(&cloud, method, path, Some(token)).await;
    let token = &*made.token;
    assert_eq!(status(Method::GET, "/v1/vehicles", token).await, StatusCode::OK);
    assert_eq!(status(Method::POST, "/v1/deployments", token).await, StatusCode::FORBIDDEN);
    let new = NewToken { name: "child".to_owned(), role: Role::Viewer, days: 1 };
    let body = serde_json::to_string(&new).unwrap();
    let path = (Method::POST, "/v1/tokens");
    let sent = send(&cloud, path.clone(), Some(token), &[], body.clone()).await;
    assert_eq!(sent.status, StatusCode::FORBIDDEN);
    let sent = send(&cloud, path, Some(&login.token), &[], body).await;
    assert_eq!(sent.status, StatusCode::OK);
    // Nor does it make a login, or end other tokens.
    let code = code_of(&cloud, "eve", Role::Admin).await;
    let eve = cloud.store.login(&code).await.unwrap().unwrap();
    let new = NewToken { name: "ops".to_owned(), role: Role::Admin, days: 1 };
    let made = cloud.store.make_token((&eve.user, (&eve.user.name).into()), new).await.unwrap();
    let new = serde_json::to_string(&NewUser { name: "mallory".to_owned(), role: Role::Admin });
    let path = (Method::POST, "/v1/users");
    let sent = send(&cloud, path, Some(&made.token), &[], new.unwrap()).await;
    assert_eq!(sent.status, StatusCode::FORBIDDEN);
    for other in ["/v1/tokens/ann/nightly", "/v1/tokens/eve/other"] {
        let sent = status(Method::DELETE, other, &made.token).await;
        assert_eq!(sent, StatusCode::FORBIDDEN, "{other}");
    }
    let sent = status(Method::DELETE, "/v1/tokens/eve/ops", &made.token).await;
    assert_eq!(sent, StatusCode::NO_CONTENT);
    // A user who has fewer rights from now on has them with each token.
    invite(Role::Viewer).await;
    assert_eq!(status(Method::POST, "/v1/deployments/x/start", token).await, StatusCode::FORBIDDEN);
    // Of other users, only an administrator can remove it, or learn that it exists.
    let bea = token_of(&cloud, "bea", Role::Viewer).await;
    let path = "/v1/tokens/ann/nightly";
    assert_eq!(status(Method::DELETE, path, &bea).await, StatusCode::NOT_FOUND);
    assert_eq!(cloud.store.tokens(Some("bea"), "", 9).await.unwrap(), []);
    let after = async |after| {
        let all = cloud.store.tokens(None, after, 9).await.unwrap();
        all.into_iter().map(|it| it.name).collect::<Vec<_>>()
    };
    assert_eq!(after("").await, ["child", "nightly"]);
    assert_eq!(after("ann/child").await, ["nightly"]);
    assert_eq!(status(Method::DELETE, path, &login.token).await, StatusCode::NO_CONTENT);
    assert_eq!(status(Method::GET, "/v1/me", token).await, StatusCode::UNAUTHORIZED);
    // A logout ends the token in the cloud, too.
    assert_eq!(status(Method::DELETE, "/v1/login", &bea).await, StatusCode::NO_CONTENT);
    assert_eq!(status(Method::GET, "/v1/me", &bea).await, StatusCode::UNAUTHORIZED);
}

#[tokio::test]
async fn wrong_tokens_are_limited_and_the_user_is_removed_with_the_token() {
    let (_folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "ann", Role::Viewer).await;
    let me = async |token| status_of(&cloud, Method::GET, "/v1/me", Some(token)).await;
    assert_eq!(me(&token).await, StatusCode::OK);
    cloud.store.remove_user("console", "ann").await.unwrap();
    for _ in 0..10 {
        assert_eq!(me(&token).await, StatusCode::UNAUTHORIZED);
    }
    assert_eq!(me(&token).await, StatusCode::TOO_MANY_REQUESTS);
    // Others at the address are not refused.
    let other = token_of(&cloud, "bea", Role::Viewer).await;
    assert_eq!(me(&other).await, StatusCode::OK);
}

#[tokio::test]
async fn each_error_is_a_problem_with_its_status() {
    let (_folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "ann", Role::Admin).await;
    let long = "x".repeat(BODY_MAX + 1);
    let number = u64::from(u16::MAX) + 1;
    let (get, post) = (Method::GET, Method::POST);
    for (method, path, body, status) in [
        (&get, "/v1", "", 404),
        (&get, "/v1/no-such", "", 404),
        (&Method::PUT, "/v1/no-such", "", 404),
        (&get, "/v1/me/", "", 404),
        (&get, "/v1/users/%ff/x", "", 404),
        (&Method::PATCH, "/v1/users", "", 405),
        (&Method::DELETE, "/v1/users/%ff", "", 400),
        (&get, "/v1/vehicles/%ff/status", "", 400),
        (&get, "/v1/vehicles/car-7/events?last=some", "", 400),
        (&get, "/v1/vehicles/car-7/events?last=-1", "", 400),
        (&get, "/v1/vehicles/car-7/events?follow=yes", "", 400),
        (&get, "/v1/vehicles/car-7/events?more=1", "", 400),
        (&get, "/v1/vehicles/car-7/events?from=1", "", 400),
        (&get, "/v1/vehicles?limit=0", "", 400),
        (&get, "/v1/vehicles?limit=501", "", 400),
        (&get, &format!("/v1/vehicles?limit={number}"), "", 400),
        (&get, "/v1/vehicles?after=%00", "", 200),
        (&get, "/v1/vehicles?after=a&after=b", "", 400),
        (&get, "/v1/users?limit=", "", 400),
        (&get, "/v1/deployments?limit=1.5", "", 400),
        (&get, "/v1/deployments?last=1", "", 400),
        (&get, "/v1/audit?after=x", "", 400),
        (&get, "/v1/audit?after=-1", "", 400),
        (&get, "/v1/clips?after=18446744073709551616", "", 400),
        (&get, "/v1/clips?limit=0", "", 400),
        (&get, "/v1/clips?from_ns=1e3", "", 400),
        (&get, "/v1/clips/no-id", "", 404),
        (&post, "/v1/users", "no JSON", 400),
        (&post, "/v1/users", r#"{"name":"a","role":"root"}"#, 400),
        (&post, "/v1/users", r#"{"name":"a","role":"viewer","more":1}"#, 400),
        (&post, "/v1/login", &long[..LOGIN_MAX + 1], 413),
        (&post, "/v1/users", &long, 413),
        (&post, "/v1/deployments/a/explode", "", 400),
        (&Method::PUT, "/v1/objects/..", "", 400),
    ] {
        let answer = send(&cloud, (method.clone(), path), Some(&token), &[], body.to_owned()).await;
        // PostgreSQL has no texts with NUL.
        let is_refused = answer.status == 400 && path.contains("%00");
        assert!(answer.status == status || is_refused, "{method} {path}: {}", answer.status);
        if answer.status == 200 {
            continue;
        }
        assert_eq!(answer.headers[header::CONTENT_TYPE], "application/problem+json", "{path}");
        let problem = answer.json();
        assert_eq!(problem["status"], answer.status.as_u16(), "{path}");
        let texts = ["title", "help"].map(|name| problem[name].as_str().map(str::len));
        assert!(texts.iter().all(|length| length.is_some_and(|it| it > 5)), "{path}: {problem}");
        assert!(problem["causes"].is_array() && problem["exit"] == 2, "{path}: {problem}");
        assert_eq!(problem["detail"].is_string(), problem["causes"] != json!([]), "{problem}");
    }
    let answer = send(&cloud, (Method::PATCH, "/v1/users"), None, &[], "").await;
    let allowed = answer.headers[header::ALLOW].to_str().unwrap();
    assert!(["GET", "POST"].iter().all(|it| allowed.contains(it)), "{allowed}");
    // The page answers with pages.
    let answer = send(&cloud, (Method::GET, "/no-such"), None, &[], "").await;
    assert_eq!(answer.status, StatusCode::NOT_FOUND);
    assert!(answer.headers[header::CONTENT_TYPE].to_str().unwrap().starts_with("text/html"));
}

#[tokio::test]
async fn a_list_has_each_entry_once_in_parts_of_any_length() {
    let (_folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "u0", Role::Admin).await;
    for number in 1..7 {
        token_of(&cloud, &format!("u{number}"), Role::Viewer).await;
        cloud.store.invite_vehicle("u0", &format!("car-{number}")).await.unwrap();
    }
    for (list, key, count) in [("users", "name", 7), ("vehicles", "name", 6), ("audit", "seq", 20)]
    {
        let whole =
            send(&cloud, (Method::GET, &format!("/v1/{list}")), Some(&token), &[], "").await;
        let whole = whole.json();
        assert_eq!(whole["items"].as_array().unwrap().len(), count, "{list}");
        assert_eq!(whole["next"], Value::Null);
        for limit in [1, 3, count, count + 1] {
            let (mut entries, mut after) = (Vec::new(), String::new());
            loop {
                let path = format!("/v1/{list}?limit={limit}{after}");
                let part = send(&cloud, (Method::GET, &path), Some(&token), &[], "").await.json();
                let items = part["items"].as_array().unwrap();
                assert!(items.len() <= limit);
                entries.extend(items.iter().cloned());
                let Some(next) = part["next"].as_str() else { break };
                assert_eq!(items.len(), limit, "only full parts have a next one");
                after = format!("&after={next}");
            }
            assert_eq!(Value::from(entries), whole["items"], "{list} by {limit} {key}");
        }
    }
}

#[tokio::test]
async fn a_stream_ends_once_its_token_has_no_right_any_more() {
    let (_folder, cloud) = Cloud::of_test().await;
    cloud.store.invite_vehicle("console", "car-7").await.unwrap();
    let login = token_of(&cloud, "ann", Role::Operator).await;
    let ann = cloud.store.user(&login).await.unwrap().unwrap().user;
    let new = NewToken { name: "nightly".to_owned(), role: Role::Viewer, days: 1 };
    let made = cloud.store.make_token((&ann, (&*ann.name).into()), new).await.unwrap();
    // As another process does it: nothing here learns of it but from the database.
    for (token, end) in [
        (&made.token, "DELETE FROM secrets WHERE kind = 'token' AND name = 'nightly'"),
        (&login, "UPDATE secrets SET expires = 1 WHERE kind = 'token'"),
    ] {
        let network = ClientNetwork::of([127, 0, 0, 1].into());
        let request = Request::get("/v1/vehicles/car-7/events?follow=true")
            .extension(network)
            .header(header::AUTHORIZATION, format!("Bearer {token}"));
        let request = request.body(Body::empty()).unwrap();
        let reply = answer(&cloud, request).await;
        assert_eq!(reply.status(), StatusCode::OK);
        cloud.store.execute(end).await;
        let all = tokio::time::timeout(Duration::from_secs(30), to_bytes(reply.into_body(), 99));
        assert_eq!(all.await.expect("the stream goes on").unwrap(), "");
    }
}

#[tokio::test]
async fn only_a_deployment_has_a_long_body() {
    let (_folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "ann", Role::Admin).await;
    for (path, length, status) in [
        ("/v1/users", SMALL_MAX, StatusCode::BAD_REQUEST),
        ("/v1/users", SMALL_MAX + 1, StatusCode::PAYLOAD_TOO_LARGE),
        ("/v1/deployments", BODY_MAX, StatusCode::BAD_REQUEST),
        ("/v1/deployments", BODY_MAX + 1, StatusCode::PAYLOAD_TOO_LARGE),
        ("/v1/login", LOGIN_MAX + 1, StatusCode::PAYLOAD_TOO_LARGE),
    ] {
        let body = vec![b' '; length];
        let answer = send(&cloud, (Method::POST, path), Some(&token), &[], body).await;
        assert_eq!(answer.status, status, "{path}: {length}");
    }
}
