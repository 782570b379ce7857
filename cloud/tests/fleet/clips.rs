//! Clips of a vehicle, from their announcement to the file that a person gets.

use std::time::Duration;

use gleaner_cloud::CloudServer;
use gleaner_fleet::Body;
use gleaner_fleet::clips::{CLIP_PART, ClipOrders};
use gleaner_test_support::cloud::fake::{FakeVehicle, Person, Signed, soon};
use gleaner_trust::sha256;
use http_body_util::BodyExt;
use hyper::{Method, StatusCode};
use serde_json::{Value, json};
use tokio::io::AsyncWriteExt;
use tokio::time::sleep;

use crate::{options, start, start_with_vehicle};

/// Time between two looks at what changes soon: with more looks, the vehicle would be in a loop.
const PAUSE: Duration = Duration::from_millis(250);
const BUSY: StatusCode = StatusCode::TOO_MANY_REQUESTS;

const IMAGE: &[u8] = &jpeg(1920, 1080);

/// Returns the head of a JPEG of this size, and then nothing that matters.
const fn jpeg(width: u16, height: u16) -> [u8; 100_000] {
    let mut image = [7; 100_000];
    let head = [0xff, 0xd8, 0xff, 0xc0, 0, 11, 8, 0, 0, 0, 0, 1, 1, 0x11, 0];
    let mut index = 0;
    while index < head.len() {
        image[index] = head[index];
        index += 1;
    }
    [image[7], image[8]] = height.to_be_bytes();
    [image[9], image[10]] = width.to_be_bytes();
    image
}

pub(crate) fn facts(name: &str, label: &str, at_ns: i64, content: &[u8]) -> Value {
    let moment = json!({ "lambda": "brake", "kind": "event", "label": label, "score": 0.5,
                         "attributes": { "lat": 59.9 }, "at_ns": at_ns });
    let lambda = json!({ "name": "brake", "version": "1.0.0", "digest": "d", "deployment": "b",
                         "revision": "r" });
    json!({ "name": name, "from_ns": at_ns - 5, "to_ns": at_ns + 5, "bytes": content.len(),
            "sha256": sha256(content), "thumbnail": sha256(IMAGE), "lambdas": [lambda],
            "triggers": 1, "moments": [moment] })
}

pub(crate) fn two_parts() -> Vec<u8> {
    (0..CLIP_PART + 5).map(|byte| byte as u8).collect()
}

pub(crate) async fn report(
    vehicle: &FakeVehicle,
    clips: &[Value],
    gone: Value,
) -> (StatusCode, ClipOrders) {
    let cursor = (!clips.is_empty()).then(|| format!("after {}", clips.len()));
    let body = json!({ "cursor": cursor, "clips": clips, "gone": gone }).to_string();
    let (status, text) = vehicle.request(Method::POST, "/v1/clips", body.as_bytes()).await;
    (status, serde_json::from_slice(&text).unwrap_or_default())
}

pub(crate) async fn orders(vehicle: &FakeVehicle) -> ClipOrders {
    let (status, orders) = report(vehicle, &[], json!([])).await;
    assert_eq!(status, StatusCode::OK);
    orders
}

/// Sends a part of a content; returns the status, or the reason of the refusal.
pub(crate) async fn put(
    vehicle: &FakeVehicle,
    name: &str,
    number: u64,
    part: &[u8],
) -> (StatusCode, String) {
    let path = format!("/v1/clips/{name}/parts/{number}/{}", sha256(part));
    let (status, text) = vehicle.request(Method::PUT, &path, part).await;
    (status, String::from_utf8_lossy(&text).into_owned())
}

/// Sends a piece that begins at a byte; returns the status.
pub(crate) async fn put_from(
    vehicle: &FakeVehicle,
    name: &str,
    begin: u64,
    piece: &[u8],
) -> StatusCode {
    vehicle.request(Method::PUT, &format!("/v1/clips/{name}/from/{begin}"), piece).await.0
}

pub(crate) async fn pull(person: &Person, id: &str) -> StatusCode {
    person.open(Method::POST, &format!("/v1/clips/{id}/pull"), b"").await.status()
}

async fn clip(person: &Person, id: &str) -> Value {
    person.call(Method::GET, &format!("/v1/clips/{id}"), Value::Null).await
}

async fn names(person: &Person, query: &str) -> Vec<String> {
    let page = person.call(Method::GET, &format!("/v1/clips{query}"), Value::Null).await;
    let clips = page["items"].as_array().unwrap().iter();
    clips.map(|clip| clip["name"].as_str().unwrap().to_owned()).collect()
}

pub(crate) async fn bytes(person: &Person, path: &str) -> (StatusCode, Vec<u8>) {
    let answer = person.open(Method::GET, path, b"").await;
    let status = answer.status();
    (status, soon(answer.into_body().collect()).await.unwrap().to_bytes().to_vec())
}

#[tokio::test]
async fn announced_clips_are_listed_once_by_vehicle_lambda_label_and_time() {
    let (folder, server, admin, vehicle) = start_with_vehicle().await;
    let (other, _) = admin.enrol("car-8").await;
    let none = orders(&vehicle).await;
    assert_eq!(ClipOrders { budget: None, ..none }, ClipOrders::default());
    let clips = [facts("a", "dark", 1000, b"a"), facts("b", "wet", 2000, b"b")];
    for _ in 0..2 {
        let (status, orders) = report(&vehicle, &clips, json!([])).await;
        assert_eq!((status, orders.cursor.as_deref()), (StatusCode::OK, Some("after 2")));
        assert_eq!(orders.wanted, [], "files come only on demand");
    }
    let again = report(&vehicle, &[facts("a", "other", 1, b"x")], json!([])).await;
    assert_eq!(again.0, StatusCode::OK);
    assert_eq!(clip(&admin, "a@car-7").await["sha256"], sha256(b"a").as_str(), "the first counts");
    report(&other, &[facts("a", "dark", 3000, b"z")], json!([])).await;
    for (query, expected) in [
        ("", &["a", "b", "a"][..]),
        ("?vehicle=car-7", &["b", "a"]),
        ("?label=dark", &["a", "a"]),
        ("?lambda=brake&label=wet", &["b"]),
        ("?lambda=other", &[]),
        ("?from_ns=1500&to_ns=2500", &["b"]),
        ("?limit=1", &["a"]),
    ] {
        assert_eq!(names(&admin, query).await, expected, "{query}");
    }
    let first = admin.call(Method::GET, "/v1/clips?limit=2", Value::Null).await;
    let rest = format!("?limit=2&after={}", first["next"].as_str().unwrap());
    assert_eq!(names(&admin, &rest).await, ["a"]);
    // After a restart it goes on where the cloud has acknowledged it.
    server.stop().await;
    let server = CloudServer::start(&options(folder.path()).await).await.unwrap();
    let position = orders(&vehicle.at(server.vehicles)).await.cursor;
    assert_eq!(position.as_deref(), Some("after 1"));
    server.stop().await;
}

#[tokio::test]
async fn a_wanted_clip_comes_in_parts_across_an_interruption_and_a_restart() {
    let (folder, server, admin, vehicle) = start_with_vehicle().await;
    let (mut link, ..) = vehicle.connect().await;
    let content = two_parts();
    let (first, second) = content.split_at(CLIP_PART as usize);
    let (_, orders_before) =
        report(&vehicle, &[facts("a", "dark", 1000, &content)], json!([])).await;
    assert_eq!(orders_before.thumbnails.len(), 1);
    let path = "/v1/clips/a/thumbnail";
    assert_eq!(vehicle.request(Method::PUT, path, IMAGE).await.0, StatusCode::OK);
    let image = bytes(&admin, "/v1/clips/a@car-7/thumbnail").await;
    assert_eq!(image, (StatusCode::OK, IMAGE.to_vec()));
    assert_eq!(put(&vehicle, "a", 0, first).await.0, StatusCode::NOT_FOUND, "it is not wanted");

    // The vehicle learns of the wish by the number of its desired state.
    assert_eq!(pull(&admin, "a@car-7").await, StatusCode::OK);
    let Some(Body::Desired(desired)) = link.next().await else { panic!("no desired state") };
    assert_eq!(desired.generation, 2);
    let wanted = &orders(&vehicle).await.wanted[0];
    assert_eq!((wanted.name.as_str(), wanted.part), ("a", 0));
    assert_eq!(clip(&admin, "a@car-7").await["state"], "wanted");
    assert_eq!(put(&vehicle, "a", 0, first).await.0, StatusCode::OK);
    assert_eq!(put(&vehicle, "a", 0, first).await.0, StatusCode::OK, "it came before");
    let half = clip(&admin, "a@car-7").await;
    assert_eq!((&half["state"], &half["received"]), (&json!("uploading"), &json!(CLIP_PART)));
    assert_eq!(bytes(&admin, "/v1/clips/a@car-7/file").await.0, StatusCode::NOT_FOUND);

    // A connection that is lost in the middle of a part, and a cloud that starts again.
    let mut stream = vehicle.stream().await;
    let head = format!(
        "PUT /v1/clips/a/parts/1/{} HTTP/1.1\r\nhost: cloud\r\ncontent-length: 5\r\n\r\n12",
        sha256(second)
    );
    stream.write_all(head.as_bytes()).await.unwrap();
    stream.flush().await.unwrap();
    drop(stream);
    server.stop().await;
    let server = CloudServer::start(&options(folder.path()).await).await.unwrap();
    let (vehicle, admin) = (vehicle.at(server.vehicles), admin.at(server.people));
    assert_eq!(orders(&vehicle).await.wanted[0].part, 1);

    // The same part twice at once.
    let (one, two) = tokio::join!(put(&vehicle, "a", 1, second), put(&vehicle, "a", 1, second));
    assert_eq!((one.0, two.0), (StatusCode::OK, StatusCode::OK));
    assert_eq!(orders(&vehicle).await.wanted, []);
    assert_eq!(clip(&admin, "a@car-7").await["state"], "stored");
    let whole = bytes(&admin, "/v1/clips/a@car-7/file").await;
    assert!(whole == (StatusCode::OK, content.clone()));
    assert_eq!(pull(&admin, "a@car-7").await, StatusCode::OK);
    assert_eq!(clip(&admin, "a@car-7").await["state"], "stored", "it is not fetched again");
    // A file that is lost in the cloud can be fetched again.
    for entry in std::fs::read_dir(folder.path().join("data/clips")).unwrap() {
        let path = entry.unwrap().path();
        assert!(path.extension().is_some_and(|it| it != "part"), "{}", path.display());
        std::fs::remove_file(path).unwrap();
    }
    assert_eq!(bytes(&admin, "/v1/clips/a@car-7/file").await.0, StatusCode::NOT_FOUND);
    assert_eq!(pull(&admin, "a@car-7").await, StatusCode::OK);
    assert_eq!(orders(&vehicle).await.wanted[0].part, 0);
    // Nor does a part that is lost lock the upload.
    assert_eq!(put(&vehicle, "a", 0, first).await.0, StatusCode::OK);
    for entry in std::fs::read_dir(folder.path().join("data/clips")).unwrap() {
        std::fs::remove_file(entry.unwrap().path()).unwrap();
    }
    let (status, reason) = put(&vehicle, "a", 1, second).await;
    assert_eq!(status, StatusCode::FORBIDDEN);
    assert!(reason.contains("its first parts are gone"), "{reason}");
    for (number, part) in [(0, first), (1, second)] {
        assert_eq!(orders(&vehicle).await.wanted[0].part, number);
        assert_eq!(put(&vehicle, "a", number, part).await.0, StatusCode::OK);
    }
    assert_eq!(clip(&admin, "a@car-7").await["state"], "stored");
    server.stop().await;
}

#[tokio::test]
async fn a_piece_that_breaks_off_is_kept_and_the_next_one_goes_on_there() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    let content = two_parts();
    report(&vehicle, &[facts("a", "dark", 1000, &content)], json!([])).await;
    assert_eq!(pull(&admin, "a@car-7").await, StatusCode::OK);
    let from = async || orders(&vehicle).await.wanted[0].from.unwrap();
    assert_eq!(from().await, 0);
    let mut stream = vehicle.stream().await;
    let head = "PUT /v1/clips/a/from/0 HTTP/1.1\r\nhost: cloud\r\ncontent-length: 65536\r\n\r\n";
    stream.write_all(&[head.as_bytes(), &content[..20_000]].concat()).await.unwrap();
    stream.shutdown().await.unwrap();
    while from().await == 0 {
        sleep(PAUSE).await;
    }
    assert_eq!(from().await, 20_000);
    let put = async |begin: usize, end: usize| {
        let status = put_from(&vehicle, "a", begin as u64, &content[begin..end]).await;
        assert_eq!(status, StatusCode::OK);
    };
    put(20_000, 24_000).await;
    assert_eq!(from().await, 20_000, "less than 4 KiB are not worth an entry");
    tokio::join!(put(20_000, 50_000), put(20_000, 50_000));
    put(40_000, 60_000).await;
    put(70_000, 80_000).await;
    assert_eq!(from().await, 60_000, "of the one the rest counts, and of the other nothing");
    let beyond = put_from(&vehicle, "a", CLIP_PART + 5, b"x").await;
    assert_eq!(beyond, StatusCode::BAD_REQUEST);
    // An older vehicle goes on with whole parts.
    let (first, second) = content.split_at(CLIP_PART as usize);
    assert_eq!(orders(&vehicle).await.wanted[0].part, 0);
    assert_eq!(self::put(&vehicle, "a", 0, first).await.0, StatusCode::OK);
    assert_eq!(orders(&vehicle).await.wanted[0].part, 1);
    let long = [second, b"more"].concat();
    assert_eq!(put_from(&vehicle, "a", CLIP_PART, &long).await, StatusCode::OK);
    assert!(bytes(&admin, "/v1/clips/a@car-7/file").await == (StatusCode::OK, content.clone()));
    server.stop().await;
}

#[tokio::test]
async fn an_announced_thumbnail_that_is_no_image_or_another_one_is_refused_once() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    for (name, image) in [
        ("empty", &jpeg(0, 0)[..]),
        ("huge", &jpeg(65535, 65535)),
        ("cut", &jpeg(8, 8)[..9]),
        ("text", b"\xff\xd8\xff and a text"),
        ("other", &jpeg(8, 8)),
    ] {
        let mut clip = facts(name, "dark", 1000, b"a");
        if name != "other" {
            clip["thumbnail"] = json!(sha256(image));
        }
        report(&vehicle, &[clip], json!([])).await;
        let path = format!("/v1/clips/{name}/thumbnail");
        let (status, text) = vehicle.request(Method::PUT, &path, image).await;
        assert_eq!(status, StatusCode::FORBIDDEN, "{name}");
        assert!(String::from_utf8_lossy(&text).contains("4096 pixels"), "{name}");
        assert_eq!(orders(&vehicle).await.thumbnails, [], "{name} is not wanted again");
        let path = format!("/v1/clips/{name}@car-7/thumbnail");
        assert_eq!(bytes(&admin, &path).await.0, StatusCode::NOT_FOUND);
    }
    server.stop().await;
}

#[tokio::test]
async fn hostile_uploads_are_refused_and_change_nothing() {
    let (_folder, server, admin) = start().await;
    let (good, _) = admin.enrol("good").await;
    let (bad, _) = admin.enrol("bad").await;
    for vehicle in [&good, &bad] {
        let clips = [facts("a", "dark", 1000, b"content"), facts("liar", "dark", 1000, b"1234567")];
        assert_eq!(report(vehicle, &clips, json!([])).await.0, StatusCode::OK);
    }
    for id in ["a@good", "liar@bad"] {
        assert_eq!(pull(&admin, id).await, StatusCode::OK);
    }
    // Only its own vehicle can send a clip.
    assert_eq!(put(&bad, "a", 0, b"content").await.0, StatusCode::NOT_FOUND);
    assert_eq!(put(&bad, "a@good", 0, b"content").await.0, StatusCode::BAD_REQUEST);
    assert_eq!(put(&bad, "..%2f..%2fcloud.db", 0, b"x").await.0, StatusCode::BAD_REQUEST);
    assert_eq!(put(&good, "a", 1, b"content").await.0, StatusCode::BAD_REQUEST, "beyond the end");
    let (status, text) = put(&good, "a", 0, &[7; 9000]).await;
    assert!(status == StatusCode::FORBIDDEN && text.contains("SHA-256"), "{status} {text}");
    assert_eq!(put(&good, "a", 0, b"conten").await.0, StatusCode::OK);
    assert_eq!(orders(&good).await.wanted[0].from, Some(0), "so few bytes are not kept");
    // Files that it does not read take the place of no other vehicle's. Each is more than the
    // buffers of a connection.
    let large = Signed::new("large", 1, None, 16 << 20);
    admin.deploy(&large).await;
    let object = format!("/v1/objects/{}", sha256(&large.file));
    let mut unread = Vec::new();
    for _ in 0..8 {
        unread.push(bad.open(Method::GET, &object, b"").await);
        assert_eq!(unread.last().unwrap().status(), StatusCode::OK);
    }
    let refused = bad.open(Method::GET, &object, b"").await;
    assert!(refused.status() == BUSY && refused.headers()["retry-after"] == "10");
    let (status, text) = put(&bad, "liar", 0, b"76").await;
    assert!(status == BUSY && text.contains("vehicle bad has 8 transfers of files"), "{text}");
    assert_eq!(put(&good, "a", 0, b"conten").await.0, StatusCode::OK);
    assert!(good.get(&object).await == (StatusCode::OK, large.file));
    drop(unread);
    while put(&bad, "liar", 0, b"76").await.0 == BUSY {
        sleep(PAUSE).await;
    }
    // Another file than announced is not wanted any more after some times.
    for _ in 0..3 {
        let (status, text) = put(&bad, "liar", 0, b"7654321").await;
        assert!(status == StatusCode::FORBIDDEN && text.contains("SHA-256"), "{status} {text}");
    }
    let liar = clip(&admin, "liar@bad").await;
    assert_eq!((&liar["state"], &liar["received"]), (&json!("failed"), &json!(0)));
    assert_eq!(put(&bad, "liar", 0, b"1234567").await.0, StatusCode::NOT_FOUND);
    // Announcements are bounded.
    let named = |name: &str| facts(name, "dark", 1000, b"x");
    let mut long = named("long");
    long["moments"] = json!(vec![long["moments"][0].clone(); 300]);
    let many: Vec<_> = (0..65).map(|number| named(&format!("c{number}"))).collect();
    for clips in [&[named("../x")][..], &[named(".x")], &[named("")], &[long], &many] {
        assert_eq!(report(&bad, clips, json!([])).await.0, StatusCode::BAD_REQUEST);
    }
    let endless = vec![b' '; 2 << 20];
    let refused = bad.request(Method::POST, "/v1/clips", &endless).await.0;
    assert_eq!(refused, StatusCode::PAYLOAD_TOO_LARGE);
    assert_eq!(names(&admin, "?vehicle=bad").await.len(), 2);
    // Nothing comes from a vehicle that was revoked, also if its request came before.
    admin.call(Method::DELETE, "/v1/vehicles/good", Value::Null).await;
    assert_eq!(pull(&admin, "a@good").await, StatusCode::BAD_REQUEST);
    assert_eq!(put(&good, "a", 0, b"content").await.0, StatusCode::UNAUTHORIZED);
    assert_eq!(report(&good, &[], json!([])).await.0, StatusCode::UNAUTHORIZED);
    server.stop().await;
}

#[tokio::test]
async fn the_policy_the_budget_and_the_vehicle_decide_what_is_sent() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    let mut best = facts("best", "dark", 3000, b"best");
    best["moments"][0]["score"] = json!(0.9);
    let clips = [facts("late", "dark", 2000, b"late"), facts("early", "dark", 1, b"early"), best];
    report(&vehicle, &clips, json!([])).await;
    let wanted = async || {
        let all = orders(&vehicle).await.wanted;
        all.iter().map(|it| it.name.to_string()).collect::<Vec<_>>()
    };
    assert!(wanted().await.is_empty());
    let policy = |upload: &str, day_bytes: u64| json!({ "upload": upload, "day_bytes": day_bytes });
    let set = async |policy| {
        admin.call(Method::PUT, "/v1/clips/policy", policy).await;
    };
    set(policy("all", 4096)).await;
    assert_eq!(wanted().await, ["best", "early", "late"]);
    assert_eq!(pull(&admin, "late@car-7").await, StatusCode::OK);
    assert_eq!(wanted().await, ["late", "best", "early"], "what a person wants is first");
    assert_eq!(put(&vehicle, "late", 0, b"late").await.0, StatusCode::OK);
    assert!(wanted().await.is_empty(), "the bytes of today are used up");
    set(policy("none", 1 << 20)).await;
    assert!(wanted().await.is_empty());
    assert_eq!(pull(&admin, "best@car-7").await, StatusCode::BAD_REQUEST);
    set(policy("on-demand", 1 << 20)).await;
    assert_eq!(pull(&admin, "best@car-7").await, StatusCode::OK);
    assert_eq!(wanted().await, ["best"]);
    // The vehicle deletes clips by its own rules.
    let gone = json!([{ "name": "best", "is_thumbnail": false, "reason": "it was deleted" }]);
    report(&vehicle, &[], gone).await;
    let best = clip(&admin, "best@car-7").await;
    assert_eq!((&best["state"], &best["reason"]), (&json!("gone"), &json!("it was deleted")));
    assert_eq!(pull(&admin, "best@car-7").await, StatusCode::BAD_REQUEST);
    assert!(wanted().await.is_empty());
    server.stop().await;
}
