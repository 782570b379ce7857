//! Several processes over one PostgreSQL database and one bucket are one cloud.
//!
//! On SQLite, these tests have nothing to do: its database is of one process.

use std::fs;
use std::path::{Path, PathBuf};

use gleaner_cloud::{CloudServer, ServeOptions};
use gleaner_fleet::Body;
use gleaner_fleet::clips::CLIP_PART;
use gleaner_test_support::cloud::fake::{FakeLink, Person, cursor_after, soon};
use http_body_util::BodyExt;
use hyper::{Method, StatusCode};
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::time::{Duration, sleep};

use crate::clips::{bytes, facts, orders, pull, put, put_from, report, two_parts};
use crate::nats::NatsServer;
use crate::{options, reported, signed};

/// A bus that nothing serves.
const NO_BUS: &str = "nats://127.0.0.1:9";

/// Two processes with folders of their own.
struct Replicas {
    folder: TempDir,
    servers: [CloudServer; 2],
    admins: [Person; 2],
}

/// Returns the options of a process; `None` without PostgreSQL.
async fn options_of(folder: &Path, name: &str, bus: &str) -> Option<ServeOptions> {
    let options = options(folder).await;
    options.store.as_ref()?;
    let place = folder.file_name().unwrap().to_str().unwrap().replace('.', "");
    let (bus, objects) = (Some(bus.to_owned()), Some(format!("s3://test/{place}")));
    Some(ServeOptions { data: folder.join(name), bus, objects, ..options })
}

fn copy_authorities(from: &Path, to: &Path) {
    fs::create_dir_all(to.join("ca")).unwrap();
    for entry in fs::read_dir(from.join("ca")).unwrap() {
        let path = entry.unwrap().path();
        fs::copy(&path, to.join("ca").join(path.file_name().unwrap())).unwrap();
    }
}

impl Replicas {
    async fn start(bus: &str) -> Option<Self> {
        let folder = TempDir::new().unwrap();
        let path: PathBuf = folder.path().to_owned();
        let one = CloudServer::start(&options_of(&path, "one", bus).await?).await.unwrap();
        copy_authorities(&path.join("one"), &path.join("two"));
        let options = options_of(&path, "two", bus).await?;
        let two = CloudServer::start(&options).await.unwrap();
        // The newer code counts.
        let admin = Person::login(two.people, two.code.as_ref().unwrap()).await;
        let admins = [admin.at(one.people), admin];
        Some(Self { folder, servers: [one, two], admins })
    }

    async fn stop(self) {
        let [one, two] = self.servers;
        two.stop().await;
        one.stop().await;
    }
}

async fn wanted(link: &mut FakeLink) -> gleaner_fleet::Desired {
    match link.next().await {
        Some(Body::Desired(desired)) => desired,
        other => panic!("no desired state: {other:?}"),
    }
}

/// Waits until a vehicle has this state for a person.
async fn becomes(person: &Person, vehicle: &str, state: &str) {
    soon(async {
        while person.vehicle(vehicle).await["state"] != state {
            sleep(Duration::from_millis(100)).await;
        }
    })
    .await;
}

async fn are_one_cloud(bus: &str) {
    let Some(replicas) = Replicas::start(bus).await else { return };
    let ([_, two], [at_one, at_two]) = (&replicas.servers, &replicas.admins);
    let (vehicle, _) = at_one.enrol("car-7").await;
    let mut link = vehicle.connect().await.0;
    assert_eq!(at_two.vehicle("car-7").await["state"], "online");

    // A deployment and its file come to one, and the vehicle is connected to the other one.
    let deployed = signed(1);
    let reply = at_two.call(Method::POST, "/v1/deployments", deployed.request()).await;
    let object = format!("/v1/objects/{}", reply["objects"][0]["sha256"].as_str().unwrap());
    let sent = at_one.open(Method::PUT, &object, &deployed.file).await.status();
    assert_eq!(sent, StatusCode::NO_CONTENT);
    at_two.deploy(&deployed).await;
    link.send(reported(1)).await;
    assert_eq!(wanted(&mut link).await.deployments.len(), 1);
    let path = object.as_str();
    assert_eq!(vehicle.at(two.vehicles).get(path).await.1, deployed.file, "as sent to the other");
    at_two.call(Method::POST, "/v1/deployments/brake-dark/stop", Value::Null).await;
    assert!(!wanted(&mut link).await.deployments[0].is_wanted);

    // Readers at one follow what comes to the other one, until they are removed there.
    link.record(0..1).await;
    let new = json!({ "name": "ann", "role": "viewer" });
    let invited = at_one.call(Method::POST, "/v1/users", new).await;
    let ann = Person::login(two.people, invited["code"].as_str().unwrap()).await;
    let events = "/v1/vehicles/car-7/events?follow=true";
    let mut followed = ann.open(Method::GET, events, b"").await.into_body();
    let mut piece = async || {
        let frame = soon(followed.frame()).await?.unwrap();
        Some(String::from_utf8(frame.into_data().unwrap().to_vec()).unwrap())
    };
    assert!(piece().await.unwrap().contains("\"seq\":0"));
    assert_eq!(link.tail().await, ["events", "orchestrator"], "a reader at the other one");
    link.record(1..2).await;
    assert!(piece().await.unwrap().contains("\"seq\":1"));
    at_one.call(Method::DELETE, "/v1/users/ann", Value::Null).await;
    assert_eq!(piece().await, None);

    // A newer connection to the other one ends the older one, whose end changes nothing.
    let (mut newer, welcome, _) = vehicle.at(two.vehicles).connect().await;
    assert_eq!((welcome.epoch, welcome.cursors), (2, vec![cursor_after(2)]));
    let reason = link.end().await.unwrap();
    assert!(reason.contains("newer connection"), "{reason}");
    newer.record(2..3).await;
    for admin in [at_one, at_two] {
        assert_eq!(admin.vehicle("car-7").await["state"], "online");
    }

    // One that is revoked at one is disconnected by the other one.
    at_one.call(Method::DELETE, "/v1/vehicles/car-7", Value::Null).await;
    assert!(newer.end().await.unwrap().contains("revoked"));
    assert!(vehicle.at(two.vehicles).link().await.is_err());

    // The end of a process is that of its connections.
    let (other, _) = at_one.enrol("car-8").await;
    let mut link = other.at(two.vehicles).connect().await.0;
    assert_eq!(at_one.vehicle("car-8").await["state"], "online");
    link.settle().await;
    drop(link);
    becomes(at_one, "car-8", "offline").await;
    let _link = other.at(two.vehicles).connect().await.0;
    let Replicas { servers: [one, two], admins: [at_one, _], folder: _folder } = replicas;
    two.stop().await;
    assert_eq!(at_one.vehicle("car-8").await["state"], "offline");
    one.stop().await;
}

#[tokio::test]
async fn two_processes_without_a_bus_are_one_cloud() {
    are_one_cloud(NO_BUS).await;
}

#[tokio::test]
async fn two_processes_with_a_bus_are_one_cloud() {
    if options(TempDir::new().unwrap().path()).await.store.is_none() {
        return;
    }
    let Some(nats) = NatsServer::start() else { return };
    are_one_cloud(&nats.url).await;
}

#[tokio::test]
async fn a_bus_that_is_killed_or_sends_nonsense_stops_nothing() {
    if options(TempDir::new().unwrap().path()).await.store.is_none() {
        return;
    }
    let Some(mut nats) = NatsServer::start() else { return };
    let replicas = Replicas::start(&nats.url).await.unwrap();
    let [at_one, at_two] = &replicas.admins;
    let (vehicle, _) = at_one.enrol("car-7").await;
    let mut link = vehicle.connect().await.0;
    at_two.deploy(&signed(1)).await;
    link.send(reported(1)).await;
    wanted(&mut link).await;
    for number in 0..6 {
        nats.kill_and_start();
        nats.publish("gleaner.>", &["", "{\"vehicles\":[7]}", "{\"vehicles\":[\"car-7\"]}"]);
        let change = if number % 2 == 0 { "stop" } else { "start" };
        let path = format!("/v1/deployments/brake-dark/{change}");
        at_two.call(Method::POST, &path, Value::Null).await;
        assert_eq!(wanted(&mut link).await.deployments[0].is_wanted, number % 2 == 1);
        link.record(number..number + 1).await;
    }
    replicas.stop().await;
}

#[tokio::test]
async fn parts_of_a_clip_come_to_several_processes() {
    let Some(replicas) = Replicas::start(NO_BUS).await else { return };
    let ([_, two], [at_one, at_two]) = (&replicas.servers, &replicas.admins);
    let (vehicle, _) = at_one.enrol("car-7").await;
    let other = vehicle.at(two.vehicles);
    let _link = vehicle.connect().await.0;
    let content = two_parts();
    let (first, second) = content.split_at(CLIP_PART as usize);
    report(&vehicle, &[facts("a", "dark", 1000, &content)], json!([])).await;
    assert_eq!(pull(at_two, "a@car-7").await, StatusCode::OK);
    // Another content than announced is refused, and begun again; so few bytes are not kept.
    assert_eq!(put(&vehicle, "a", 0, second).await.0, StatusCode::OK);
    let mut wrong = first.to_vec();
    wrong[0] ^= 1;
    assert_eq!(put(&vehicle, "a", 0, &wrong).await.0, StatusCode::OK);
    let (status, reason) = put(&other, "a", 1, second).await;
    assert_eq!(status, StatusCode::FORBIDDEN, "{reason}");
    assert_eq!(orders(&other).await.wanted[0].part, 0);
    let path = "/v1/clips/a@car-7/file";
    assert_eq!(bytes(at_one, path).await.0, StatusCode::NOT_FOUND, "nothing of it is shown");

    // Pieces come to any process; the part of an older vehicle brings what is left of it.
    assert_eq!(put_from(&vehicle, "a", 0, &first[..70_000]).await, StatusCode::OK);
    assert_eq!(put_from(&other, "a", 60_000, &first[60_000..90_000]).await, StatusCode::OK);
    assert_eq!(orders(&vehicle).await.wanted[0].from, Some(90_000));
    assert_eq!(put(&vehicle, "a", 0, first).await.0, StatusCode::OK);
    assert_eq!(put(&other, "a", 1, second).await.0, StatusCode::OK);
    for admin in [at_one, at_two] {
        assert!(bytes(admin, path).await == (StatusCode::OK, content.clone()));
    }
    for begin in [1, 69_999, 70_000, 90_001, CLIP_PART - 1, CLIP_PART, CLIP_PART + 4] {
        let range = format!("bytes={begin}-");
        let answer = at_two.open_with(Method::GET, path, &[("range", &*range)], b"").await;
        assert_eq!(answer.status(), StatusCode::PARTIAL_CONTENT);
        let rest = soon(answer.into_body().collect()).await.unwrap().to_bytes();
        assert!(rest == content[begin as usize..], "{range}");
    }
    replicas.stop().await;
}

#[tokio::test]
async fn processes_that_do_not_fit_together_are_refused() {
    let Some(replicas) = Replicas::start(NO_BUS).await else { return };
    let path = replicas.folder.path();
    let fits = options_of(path, "three", NO_BUS).await.unwrap();
    let refused = async |options: ServeOptions| {
        CloudServer::start(&options).await.err().expect("it does not start").to_string()
    };
    let reason = refused(fits.clone()).await;
    assert!(reason.contains("belongs to another data folder"), "{reason}");
    assert!(!path.join("three/ca/server.pem").exists(), "a copy of `ca` still fits in");
    copy_authorities(&path.join("one"), &path.join("three"));
    let reason = refused(ServeOptions { objects: None, ..fits.clone() }).await;
    assert!(reason.contains("are in s3://test/"), "{reason}");
    let reason = refused(ServeOptions { data: path.join("one"), ..fits.clone() }).await;
    assert!(reason.contains("another gleaner-cloud uses"), "{reason}");
    CloudServer::start(&fits).await.unwrap().stop().await;

    // Without a bucket, a process is the only one.
    let alone = TempDir::new().unwrap();
    let first = options(alone.path()).await;
    let server = CloudServer::start(&first).await.unwrap();
    copy_authorities(&alone.path().join("data"), &alone.path().join("other"));
    let second = ServeOptions { data: alone.path().join("other"), ..first.clone() };
    let reason = refused(second.clone()).await;
    assert!(reason.contains("another gleaner-cloud serves the database"), "{reason}");
    server.stop().await;
    let moved = ServeOptions { data: alone.path().join("moved"), ..second };
    copy_authorities(&alone.path().join("data"), &alone.path().join("moved"));
    CloudServer::start(&moved).await.unwrap().stop().await;
    replicas.stop().await;
}
