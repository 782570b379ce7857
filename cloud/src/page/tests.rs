use std::sync::Arc;
use std::time::Instant;

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::http::{HeaderMap, Method, Request, StatusCode, header};
use gleaner_fleet::listener::ClientNetwork;
use gleaner_fleet::openapi::Endpoint;
use gleaner_fleet::people::{NewUser, Role};
use hyper::service::Service;
use hyper_util::service::TowerToHyperService;
use serde_json::json;

use super::{router, routes};
use crate::cloud::Cloud;
use crate::store::ClipBounds;

mod limits;
mod vehicles;

const PASSWORD: &str = "correct horse battery staple";

struct Browser {
    router: TowerToHyperService<Router>,
    cookie: Option<String>,
}

struct PageReply {
    status: StatusCode,
    headers: HeaderMap,
    text: String,
}

impl PageReply {
    fn location(&self) -> &str {
        self.headers.get(header::LOCATION).map_or("", |it| it.to_str().unwrap())
    }

    fn has(&self, text: &str) -> bool {
        self.text.contains(text)
    }
}

impl Browser {
    fn new(cloud: &Arc<Cloud>) -> Self {
        let router = router(cloud).with_state(Arc::clone(cloud));
        Self { router: TowerToHyperService::new(router), cookie: None }
    }

    async fn of(cloud: &Arc<Cloud>, name: &str, role: Role) -> Self {
        let new = NewUser { name: name.to_owned(), role };
        let code = cloud.store.invite("console", new).await.unwrap().code;
        let mut browser = Self::new(cloud);
        let reply = browser.send("/login/code", &[("code", &code)]).await;
        assert_eq!(
            (reply.status, reply.location()),
            (StatusCode::SEE_OTHER, "/account?done=first")
        );
        browser
    }

    async fn request(
        &mut self,
        method: Method,
        path: &str,
        fields: &[(&str, &str)],
        site: &str,
    ) -> PageReply {
        let mut request = Request::builder()
            .method(method)
            .uri(path)
            .extension(ClientNetwork::of([127, 0, 0, 1].into()))
            .header("sec-fetch-site", site);
        if let Some(cookie) = &self.cookie {
            request = request.header(header::COOKIE, cookie);
        }
        let mut form = form_urlencoded::Serializer::new(String::new());
        let request = request.body(Body::from(form.extend_pairs(fields).finish())).unwrap();
        let reply = self.router.call(request).await.unwrap();
        let (parts, body) = reply.into_parts();
        if let Some(cookie) = parts.headers.get(header::SET_COOKIE) {
            let cookie = cookie.to_str().unwrap();
            assert!(cookie.contains("; HttpOnly; SameSite=Strict;"), "{cookie}");
            self.cookie = cookie.split(';').next().map(str::to_owned);
        }
        // Streams have no end.
        let is_stream = path.ends_with("/stream") && parts.status == StatusCode::OK;
        let bytes =
            if is_stream { Default::default() } else { to_bytes(body, 1 << 24).await.unwrap() };
        let text = String::from_utf8(bytes.to_vec()).unwrap();
        PageReply { status: parts.status, headers: parts.headers, text }
    }

    async fn get(&mut self, path: &str) -> PageReply {
        self.request(Method::GET, path, &[], "none").await
    }

    async fn send(&mut self, path: &str, fields: &[(&str, &str)]) -> PageReply {
        self.request(Method::POST, path, fields, "same-origin").await
    }

    /// Sends a form with the token of the session's pages.
    async fn post(&mut self, path: &str, fields: &[(&str, &str)]) -> PageReply {
        let page = self.get("/account").await.text;
        let token =
            page.split("name=\"token\" value=\"").nth(1).unwrap().split('"').next().unwrap();
        let token = token.to_owned();
        self.send(path, &[&[("token", &*token)], fields].concat()).await
    }
}

#[tokio::test]
async fn each_page_is_open_to_its_role_and_the_higher_ones_only() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut browsers = Vec::new();
    for role in [Role::Viewer, Role::Operator, Role::Deployer, Role::Admin] {
        browsers.push((role, Browser::of(&cloud, role.as_str(), role).await));
    }
    assert!(routes().len() > 25);
    for Endpoint { method, path, role, .. } in routes() {
        if path == "/logout" {
            continue;
        }
        // Things that do not exist: a form that is let through changes nothing.
        let path = path.replace("{name}", "no-such").replace("{id}", "no-such");
        let path = path
            .replace("{change}", "start")
            .replace("{digest}", "no-such")
            .replace("{file}", "page.css");
        let mut stranger = Browser::new(&cloud);
        let reply = stranger.request(method.clone(), &path, &[], "same-origin").await;
        assert!(reply.headers.contains_key(header::CONTENT_SECURITY_POLICY), "{path}");
        let is_sent_away = (reply.status, reply.location()) == (StatusCode::SEE_OTHER, "/login");
        assert_eq!(is_sent_away, role.is_some(), "{method} {path} without a session");
        let Some(role) = role else { continue };
        for (has, browser) in &mut browsers {
            let reply = match method == Method::POST {
                true => browser.post(&path, &[]).await,
                false => browser.get(&path).await,
            };
            let status = reply.status;
            let is_let = *has >= role;
            assert_eq!(
                status != StatusCode::FORBIDDEN,
                is_let,
                "{method} {path} as {has}: {status}"
            );
            assert!(!status.is_server_error(), "{method} {path} as {has}: {status}");
            assert_ne!(reply.location(), "/login", "{method} {path} as {has}");
        }
    }
}

#[tokio::test]
async fn a_form_needs_the_token_of_its_session_and_the_origin_of_the_page() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut admin = Browser::of(&cloud, "ann", Role::Admin).await;
    let mut other = Browser::of(&cloud, "bea", Role::Admin).await;
    let page = other.get("/access").await.text;
    let token = page.split("name=\"token\" value=\"").nth(1).unwrap().split('"').next().unwrap();
    let user = [("name", "eve"), ("role", "admin")];
    for fields in [&user[..], &[&user[..], &[("token", token)]].concat()] {
        assert_eq!(admin.send("/access/users", fields).await.status, StatusCode::FORBIDDEN);
    }
    let own = [&user[..], &[("token", token)]].concat();
    for site in ["cross-site", "same-site", "none"] {
        let reply = other.request(Method::POST, "/access/users", &own, site).await;
        assert_eq!(reply.status, StatusCode::FORBIDDEN, "{site}");
        let login =
            Browser::new(&cloud).request(Method::POST, "/login/code", &[("code", "x")], site).await;
        assert_eq!(login.status, StatusCode::FORBIDDEN, "{site}");
    }
    assert_eq!(cloud.store.users("", 10).await.unwrap().len(), 2);
    assert!(other.send("/access/users", &own).await.has("glc_"));
    let long = "x".repeat(20_000);
    assert_eq!(
        admin.post("/access/users", &[("name", &long)]).await.status,
        StatusCode::BAD_REQUEST
    );
}

#[tokio::test]
async fn each_login_makes_a_session_and_ends_the_former_one() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut browser = Browser::of(&cloud, "ann", Role::Viewer).await;
    let first = browser.cookie.clone();
    assert_eq!(
        browser
            .post("/account/password", &[("password", "short"), ("again", "short")])
            .await
            .status,
        StatusCode::BAD_REQUEST
    );
    let fields = [("password", PASSWORD), ("again", PASSWORD)];
    let reply = browser.post("/account/password", &fields).await;
    assert_eq!(reply.location(), "/account?done=password");

    let wrong = [("name", "ann"), ("password", "wrong")];
    let reply = browser.send("/login/password", &wrong).await;
    assert_eq!(reply.status, StatusCode::UNAUTHORIZED);
    assert!(reply.has("the name or the password is wrong"));
    // A session that someone else has chosen does not become that of the user.
    for chosen in [first.clone(), Some("gleaner_session=gls_chosen".to_owned())] {
        browser.cookie = chosen.clone();
        let fields = [("name", "ann"), ("password", PASSWORD)];
        let reply = browser.send("/login/password", &fields).await;
        assert_eq!(reply.location(), "/vehicles");
        assert_ne!(browser.cookie, chosen);
        let mut former = Browser::new(&cloud);
        former.cookie = chosen;
        assert_eq!(former.get("/vehicles").await.location(), "/login");
    }
    let last = browser.cookie.clone();
    assert_eq!(browser.post("/logout", &[]).await.location(), "/login");
    browser.cookie = last;
    assert_eq!(browser.get("/vehicles").await.location(), "/login", "it has ended for all");
}

#[tokio::test]
async fn tokens_are_shown_once_and_can_be_removed() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut browser = Browser::of(&cloud, "ann", Role::Operator).await;
    let page = browser.get("/account").await;
    assert!(page.has("value=\"operator\"") && !page.has("value=\"deployer\""));
    let fields = |days| [("name", "nightly"), ("role", "viewer"), ("days", days)];
    for days in ["", "0", "1e9", "-1"] {
        let reply = browser.post("/account/tokens", &fields(days)).await;
        assert_eq!(reply.status, StatusCode::BAD_REQUEST, "{days}");
    }
    let reply = browser.post("/account/tokens", &fields("30")).await;
    let token = reply.text.split("<code>").nth(1).unwrap().split('<').next().unwrap();
    let found = cloud.store.user(token).await.unwrap().unwrap();
    assert_eq!((found.user.role, &*found.name), (Role::Viewer, "nightly"));
    assert!(browser.get("/account").await.has("<b>nightly</b>"));
    let reply = browser.post("/account/tokens/nightly/remove", &[]).await;
    assert_eq!(reply.location(), "/account?done=token");
    assert!(cloud.store.user(token).await.unwrap().is_none());
}

#[tokio::test]
async fn passwords_cannot_be_guessed_and_a_new_one_ends_other_sessions() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut one = Browser::of(&cloud, "ann", Role::Viewer).await;
    let mut two = Browser::of(&cloud, "ann", Role::Viewer).await;
    two.post("/account/password", &[("password", PASSWORD), ("again", PASSWORD)]).await;
    assert_eq!(one.get("/vehicles").await.location(), "/login");
    assert_eq!(two.get("/vehicles").await.status, StatusCode::OK);
    for _ in 0..10 {
        assert!(cloud.accounts.wrong_secrets.count_password(ClientNetwork::LOCAL, "ann").is_ok());
    }
    let right = [("name", "ann"), ("password", PASSWORD)];
    let reply = one.send("/login/password", &right).await;
    assert_eq!(reply.status, StatusCode::TOO_MANY_REQUESTS, "also the right one");
}

#[tokio::test]
async fn the_sessions_of_a_removed_user_end_at_once() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut admin = Browser::of(&cloud, "ann", Role::Admin).await;
    let mut user = Browser::of(&cloud, "bea", Role::Viewer).await;
    assert_eq!(user.get("/vehicles").await.status, StatusCode::OK);
    assert_eq!(admin.post("/access/users/bea/remove", &[]).await.location(), "/access?done=user");
    assert_eq!(user.get("/vehicles").await.location(), "/login");
    // Another role counts at once, too.
    let mut user = Browser::of(&cloud, "eve", Role::Admin).await;
    assert!(user.get("/access").await.status.is_success());
    admin.post("/access/users", &[("name", "eve"), ("role", "viewer")]).await;
    assert_eq!(user.get("/access").await.status, StatusCode::FORBIDDEN);
}

/// Adds a vehicle whose labels, problems, status and log line are markup.
async fn hostile_vehicle(cloud: &Cloud) {
    let bad = "<script>alert(1)</script>\u{1b}[2J\u{202e}\"'><b>";
    let line = json!({ "stream": "a", "seq": 0, "time_ns": 1, "boot_ns": 1, "boot": "b",
                       "kind": "log",
                       "record": { "at_ns": 1, "level": "info", "message": bad } });
    let event = json!({ "stream": "events", "seq": 0, "time_ns": 1, "boot_ns": 1, "boot": "b",
                        "kind": bad, "record": { bad: bad } });
    let program =
        json!({ "version": bad, "pid": 1, "up_s": 1e300, "rss_bytes": u64::MAX, "cpu_s": 1.0 });
    let revision = json!({ "digest": bad, "version": bad, "release": 1 });
    let deployment = json!({ "id": bad, "release": 1, "attempt": 1, "lambda": bad,
        "revision": revision, "fallback": null, "is_wanted": true, "runs_fallback": true,
        "is_proven": true, "failed": bad, "refused": bad, "stale": bad, "status": null,
        "grants": { "topics": [bad], "models": [bad], "record": true } });
    let capacity =
        json!({ "resource": bad, "unit": bad, "asked": -1.0, "most": 0.0, "source": bad });
    let status = json!({ "vehicle": bad, "key": bad, "labels": { bad: bad },
        "orchestrator": program, "generation": 1,
        "trust": { "version": 1, "expires": u64::MAX, "is_expired": true },
        "deployments": [deployment], "capacity": [capacity], "supervisor": null });
    let text = |value: serde_json::Value| value.to_string();
    cloud.store.invite_vehicle("console", "car-1").await.unwrap();
    let moment = json!({ "lambda": bad, "kind": bad, "label": bad, "score": 1e300,
                         "attributes": { bad: bad }, "at_ns": i64::MAX, "source": bad });
    let lambda = json!({ "name": bad, "version": bad, "digest": bad, "deployment": bad,
                         "revision": bad });
    let clip = json!({ "name": "a", "from_ns": i64::MIN, "to_ns": i64::MAX, "bytes": 0,
                       "sha256": null, "thumbnail": null, "lambdas": [lambda], "triggers": 9,
                       "moments": [moment], "incomplete": [bad], "is_recovered": true });
    let report = json!({ "cursor": "1", "clips": [clip], "gone": [] });
    let report = serde_json::from_value(report).unwrap();
    cloud.store.announce_clips("car-1", &report, ClipBounds::DEFAULT).await.unwrap();
    let update =
        "UPDATE vehicles SET epoch = 1, arrived = 3, labels = $1, problems = $2, status = $3";
    let values = [text(json!({ bad: bad })), text(json!([bad])), text(status)];
    cloud.store.execute_with(update, &values.each_ref().map(String::as_str)).await;
    let stream = "INSERT INTO streams (vehicle, stream, life, next, seq, boot, boot_ns)
                  VALUES ('car-1', 'events', 1, 1, 0, '', 0)";
    cloud.store.execute(stream).await;
    for (stream, line) in [("lambdas/a", text(line)), ("events", text(event))] {
        let record = "INSERT INTO records (vehicle, stream, life, seq, mark, arrival, line, bytes)
                      VALUES ('car-1', $1, 1, 0, '', 2, $2, 1)";
        cloud.store.execute_with(record, &[stream, &line]).await;
    }
}

#[tokio::test]
async fn what_a_vehicle_sends_is_never_markup() {
    let (_folder, cloud) = Cloud::of_test().await;
    hostile_vehicle(&cloud).await;
    let mut admin = Browser::of(&cloud, "ann", Role::Admin).await;
    let label = "/vehicles?label=%3Cscript%3E&name=%22%3E%3Cb%3E";
    for (path, is_shown) in [
        ("/vehicles", true),
        ("/vehicles/car-1", true),
        ("/vehicles/car-1/events", true),
        ("/clips?lambda=%3Cscript%3E&label=%22%3E%3Cb%3E", false),
        ("/clips", true),
        ("/clips/a%40car-1", true),
        ("/vehicles/car-1/lambdas/a", true),
        ("/vehicles/car-1/lambdas/%3Cscript%3Ealert(1)", true),
        (label, false),
    ] {
        let reply = admin.get(path).await;
        assert_eq!(reply.status, StatusCode::OK, "{path}");
        assert!(!reply.has("<script>") && !reply.has("<b>&gt;"), "{path}: {}", reply.text);
        assert!(!reply.text.contains(['\u{1b}', '\u{202e}']), "{path}");
        assert_eq!(reply.has("&lt;script&gt;alert(1)"), is_shown, "{path}");
    }
    let missing = admin.get("/vehicles/%3Cscript%3E%1b").await;
    assert_eq!(missing.status, StatusCode::NOT_FOUND);
    assert!(!missing.has("<script>") && missing.has("&lt;script&gt;\\u{1b}"));
}

#[tokio::test]
async fn ten_thousand_vehicles_are_filtered_and_listed_in_parts() {
    let (_folder, cloud) = Cloud::of_test().await;
    let all = "WITH RECURSIVE n (i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 9999)
         INSERT INTO vehicles (name, epoch, seen, labels, problems, version, status)
         SELECT 'car-' || i, i % 10, 1,
         '{\"site\":\"' || CASE i % 3 WHEN 0 THEN 'berlin' ELSE 'ulm' END ||
         '\",\"x\\\"site\":\"berlin\"}',
         CASE i % 100 WHEN 0 THEN '[\"no room\"]' ELSE '[]' END, '0.1.0', '' FROM n";
    cloud.store.execute(all).await;
    let mut user = Browser::of(&cloud, "ann", Role::Viewer).await;
    let begin = Instant::now();
    let first = user.get("/vehicles").await;
    println!("10,000 vehicles: {:?}, {} bytes", begin.elapsed(), first.text.len());
    assert!(first.has("Vehicles 1 to 50 of 10000") && first.has("page=1\">Next"));
    assert!(first.has("<b>9,000</b> offline") && first.has("<b>1,000</b> invited"));
    let begin = Instant::now();
    let berlin = user.get("/vehicles?label=site%3Dberlin&state=offline&page=1").await;
    println!("with filters: {:?}, {} bytes", begin.elapsed(), berlin.text.len());
    assert!(berlin.has("Vehicles 51 to 100 of 3000"), "{}", berlin.text);
    assert!(berlin.has("label=site%3Dberlin&amp;state=offline&amp;page=2"));
    for (query, found) in [
        ("problem=yes", "1 to 50 of 100"),
        ("name=car-999", "1 to 11 of 11"),
        ("label=site", "1 to 50 of 10000"),
        ("page=199", "9951 to 10000 of 10000"),
    ] {
        let reply = user.get(&format!("/vehicles?{query}")).await;
        assert!(reply.has(&format!("Vehicles {found}")), "{query}");
    }
    for none in ["label=site%3Dbonn", "page=200", "state=online", "page=99999999"] {
        assert!(user.get(&format!("/vehicles?{none}")).await.has("No vehicle fits"), "{none}");
    }
}

#[tokio::test]
async fn the_audit_trail_and_records_are_listed_in_parts() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut admin = Browser::of(&cloud, "ann", Role::Admin).await;
    for _ in 0..60 {
        cloud.store.invite_vehicle("console", "car-1").await.unwrap();
    }
    let newest = admin.get("/audit").await;
    assert!(newest.has("Entries 62 to 13") && newest.has("/audit?before=13"));
    let older = admin.get("/audit?before=13").await;
    assert!(older.has("Entries 12 to 1") && !older.has(">Older"));

    let all = "WITH RECURSIVE n (i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 250)
         INSERT INTO records (vehicle, stream, life, seq, mark, arrival, line, bytes)
         SELECT 'car-1', 'lambdas/a', 1, i, '', i, '{\"stream\":\"a\",\"seq\":' || i ||
         ',\"time_ns\":1,\"boot_ns\":1,\"boot\":\"b\",\"kind\":\"log\",\"record\":{\"at_ns\":1,' ||
         '\"level\":\"info\",\"message\":\"line ' || i || '.\"}}', 1 FROM n";
    cloud.store.execute(all).await;
    cloud.store.execute("UPDATE vehicles SET arrived = 250").await;
    let page = "/vehicles/car-1/lambdas/a";
    let newest = admin.get(page).await;
    assert!(newest.has("line 250.") && newest.has("line 151.") && !newest.has("line 150."));
    assert!(newest.has("stream?after=250") && newest.has("?before=151"));
    let oldest = admin.get(&format!("{page}?before=51")).await;
    assert!(oldest.has("line 50.") && oldest.has("line 1.") && !oldest.has(">Older"));

    let stream = "INSERT INTO streams (vehicle, stream, life, next, seq, boot, boot_ns)
                  VALUES ('car-1', 'lambdas/a', 1, 251, 250, 'b', 1)";
    cloud.store.execute(stream).await;
    let found = admin.get(&format!("{page}?text=LINE+7&level=info")).await;
    assert!(found.has("line 79.") && found.has("line 7.") && !found.has("line 8."));
    let found = admin.get(&format!("{page}?text=line")).await;
    assert!(found.has("line 151.") && !found.has("line 150."));
    let (_, older) =
        found.text.split_once("href=\"/vehicles/car-1/lambdas/a?text=line&amp;").unwrap();
    let older = older.split_once('"').unwrap().0;
    let found = admin.get(&format!("{page}?text=line&{older}")).await;
    assert!(found.has("line 150.") && !found.has("line 151."));
    assert!(admin.get("/vehicles/car-1/events?level=warn").await.has("No record fits."));
    let refused = admin.get(&format!("{page}?text=x&after=y")).await;
    assert_eq!(refused.status, StatusCode::BAD_REQUEST);
}

#[tokio::test]
async fn a_vehicle_is_enrolled_by_a_file_and_cut_off() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut admin = Browser::of(&cloud, "ann", Role::Admin).await;
    let file = admin.post("/access/vehicles", &[("name", "car-7")]).await;
    let attached = file.headers[header::CONTENT_DISPOSITION].to_str().unwrap();
    assert_eq!(attached, "attachment; filename=\"car-7.json\"");
    assert_eq!(file.headers[header::CACHE_CONTROL], "no-store");
    let enrolment = gleaner_fleet::Enrolment::parse(file.text.as_bytes()).unwrap();
    assert_eq!(enrolment.vehicle, "car-7");
    let refused = admin.post("/access/vehicles", &[("name", "../car\"7")]).await;
    assert_eq!(refused.status, StatusCode::BAD_REQUEST);
    assert!(refused.has("no vehicle can be enrolled"));
    let done = admin.post("/access/vehicles/car-7/revoke", &[]).await;
    assert_eq!(done.location(), "/access?done=vehicle");
    assert!(admin.get("/vehicles").await.has("<span class=\"state failed\">revoked</span>"));
}
