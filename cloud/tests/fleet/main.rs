//! People and vehicles use a cloud together, over its two addresses.

mod clips;
mod hostile;
mod links;
#[cfg(feature = "scaled")]
mod nats;
#[cfg(feature = "scaled")]
mod replicas;
mod restarts;

use std::path::Path;

use gleaner_cloud::{CloudServer, ServeOptions};
use gleaner_fleet::{Body, RenewRequest, Reported, WantedProblem, compress};
use gleaner_test_support::cloud::fake::{FakeVehicle, Person, Signed, csr, soon};
use gleaner_test_support::cloud::{bucket, postgres};
use gleaner_trust::sha256;
use http_body_util::BodyExt;
use hyper::{Method, StatusCode};
use serde_json::{Value, json};
use tempfile::TempDir;

async fn options(folder: &Path) -> ServeOptions {
    let store = postgres::store_of(folder).await;
    ServeOptions { store, ..ServeOptions::local(folder.join("data")) }
}

/// Starts a cloud; returns its folder, its server and its administrator.
async fn start() -> (TempDir, CloudServer, Person) {
    let folder = TempDir::new().unwrap();
    let server = CloudServer::start(&options(folder.path()).await).await.unwrap();
    let admin = Person::login(server.people, server.code.as_ref().unwrap()).await;
    (folder, server, admin)
}

/// Starts a cloud, and enrols the vehicle `car-7`.
async fn start_with_vehicle() -> (TempDir, CloudServer, Person, FakeVehicle) {
    let (folder, server, admin) = start().await;
    let (vehicle, _) = admin.enrol("car-7").await;
    (folder, server, admin, vehicle)
}

fn signed(release: u64) -> Signed {
    Signed::new("brake-dark", release, None, 0)
}

fn reported(generation: u64) -> Body {
    let program = json!({ "version": "1.2", "pid": 1, "up_s": 1.0, "rss_bytes": 1, "cpu_s": 1.0 });
    let status = json!({
        "vehicle": "car-7", "key": "k", "labels": { "fleet": "test" }, "orchestrator": program,
        "trust": null, "generation": 1, "deployments": [], "capacity": [], "supervisor": null,
    });
    let status = compress(status.to_string().as_bytes());
    let problem = WantedProblem { title: "no room".to_owned(), ..WantedProblem::default() };
    Body::Reported(Reported { generation, status, problems: vec![problem] })
}

#[tokio::test]
async fn a_vehicle_enrols_gets_what_is_deployed_and_is_cut_off() {
    let (_folder, server, admin) = start().await;
    let (vehicle, enrolment) = admin.enrol("car-7").await;
    assert_eq!(admin.vehicle("car-7").await["state"], "invited");
    assert_eq!(FakeVehicle::enrol(&enrolment).await.0, StatusCode::UNAUTHORIZED, "it works once");
    let (mut link, welcome, desired) = vehicle.connect().await;
    assert_eq!((welcome.epoch, desired.generation, desired.deployments.len()), (1, 1, 0));

    // What its labels select comes once they are reported, and with each change afterwards.
    let first = signed(1);
    let envelope = admin.deploy(&first).await;
    link.send(reported(1)).await;
    let Some(Body::Desired(desired)) = link.next().await else { panic!("no desired state") };
    assert_eq!((desired.generation, &desired.deployments[0].envelope), (2, &envelope));
    for (path, expected) in [
        (format!("/v1/deployments/{envelope}"), first.deployment.as_bytes()),
        (format!("/v1/revisions/{}", first.digest), first.revision.as_bytes()),
        (format!("/v1/objects/{}", sha256(&first.file)), &first.file[..]),
    ] {
        assert_eq!(vehicle.get(&path).await, (StatusCode::OK, expected.to_vec()), "{path}");
    }
    admin.call(Method::POST, "/v1/deployments/brake-dark/stop", Value::Null).await;
    let Some(Body::Desired(desired)) = link.next().await else { panic!("no desired state") };
    assert!(desired.generation == 3 && !desired.deployments[0].is_wanted);
    link.send(reported(3)).await;
    link.settle().await;
    let summary = admin.vehicle("car-7").await;
    assert_eq!((&summary["state"], &summary["handled"]), (&json!("online"), &json!(3)));
    assert_eq!(summary["problems"][0]["title"], "no room");
    let status = admin.call(Method::GET, "/v1/vehicles/car-7/status", Value::Null).await;
    assert_eq!(status["labels"]["fleet"], "test");

    // Records that come twice are stored once, and readers that follow get them at once.
    link.record(0..2).await;
    let path = "/v1/vehicles/car-7/events?follow=true&last=1";
    let mut followed = admin.open(Method::GET, path, b"").await.into_body();
    let mut piece = async || soon(followed.frame()).await.unwrap().unwrap().into_data().unwrap();
    assert!(String::from_utf8_lossy(&piece().await).contains("\"seq\":1"));
    link.record(0..2).await;
    link.record(2..3).await;
    assert!(String::from_utf8_lossy(&piece().await).contains("\"seq\":2"));
    assert_eq!(admin.lines("/v1/vehicles/car-7/events").await.len(), 3);
    let events = admin.events("/v1/vehicles/car-7/events", None).await;
    assert!(events.starts_with("data: {") && events.ends_with("}\n\n"), "{events}");
    let last = events.lines().find_map(|line| line.strip_prefix("id: ")).unwrap().to_owned();
    link.record(3..5).await;
    let events = admin.events("/v1/vehicles/car-7/events", Some(&last)).await;
    assert_eq!(events.matches("data: ").count(), 2, "{events}");
    assert!(events.contains("\"seq\":3") && events.contains("\"seq\":4"), "{events}");

    // The next certificate, and the end of both.
    let renew = RenewRequest { csr: csr(&rcgen::KeyPair::generate().unwrap()) };
    assert_eq!(vehicle.post("/v1/renew", &renew).await, StatusCode::OK);
    admin.call(Method::DELETE, "/v1/vehicles/car-7", Value::Null).await;
    assert_eq!(link.end().await.as_deref(), Some("the vehicle was revoked"));
    assert!(vehicle.link().await.is_err());
    assert_eq!(vehicle.post("/v1/renew", &renew).await, StatusCode::UNAUTHORIZED);
    assert_eq!(admin.vehicle("car-7").await["state"], "revoked");
    let audit = admin.call(Method::GET, "/v1/audit", Value::Null).await;
    assert_eq!(
        (&audit["items"][0]["action"], &audit["items"][0]["actor"]),
        (&json!("revoke vehicle"), &json!("admin"))
    );
    server.stop().await;
}

#[test]
fn the_same_tests_pass_on_postgresql() {
    let url = format!("http://{}", bucket::serve());
    let variables = [
        ("AWS_ACCESS_KEY_ID", bucket::KEY),
        ("AWS_SECRET_ACCESS_KEY", "secret"),
        ("AWS_ENDPOINT_URL", &url),
    ];
    postgres::run_again(&[], "the_same_tests_pass_on_postgresql", &variables);
}
