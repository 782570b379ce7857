//! Connections of a vehicle: newer ones, several at a time, and what one may fetch.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use gleaner_fleet::{Body, RenewRequest};
use gleaner_test_support::cloud::fake::{Person, csr, soon};
use http_body_util::BodyExt;
use hyper::{Method, StatusCode};
use serde_json::{Value, json};

use crate::{reported, signed, start, start_with_vehicle};

#[tokio::test]
async fn a_newer_connection_takes_the_place_of_an_older_one() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    let (mut older, ..) = vehicle.connect().await;
    let (mut newer, welcome, _) = vehicle.connect().await;
    assert_eq!(welcome.epoch, 2);
    assert_eq!(older.end().await.as_deref(), Some("the vehicle has a newer connection"));
    drop(older);
    newer.settle().await;
    assert_eq!(admin.vehicle("car-7").await["state"], "online");
    // Vehicles are asked to come back at different times.
    let (stopped, reason) = tokio::join!(server.stop(), newer.end());
    assert_eq!((stopped, reason.as_deref()), ((), Some("the cloud stops")));
}

#[tokio::test]
async fn two_connections_of_a_vehicle_leave_it_online() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    let mut link = vehicle.connect().await.0;
    let is_done = Arc::new(AtomicBool::new(false));
    let (watcher, done) = (admin.at(server.people), Arc::clone(&is_done));
    let watched = tokio::spawn(async move {
        while !done.load(Ordering::Relaxed) {
            assert_eq!(watcher.vehicle("car-7").await["state"], "online");
        }
    });
    for _ in 0..10 {
        // The older one ends after the newer one has begun.
        let newer = vehicle.connect().await.0;
        assert!(link.end().await.is_some());
        link = newer;
        link.settle().await;
    }
    is_done.store(true, Ordering::Relaxed);
    watched.await.unwrap();
    server.stop().await;
}

#[tokio::test]
async fn a_vehicle_that_is_enrolled_again_stays_connected_until_it_uses_that() {
    let (_folder, server, admin) = start().await;
    let (former, _) = admin.enrol("car-7").await;
    let (mut link, ..) = former.connect().await;
    let (next, _) = admin.enrol("car-7").await;
    link.settle().await;
    let (mut newer, ..) = next.connect().await;
    assert_eq!(link.end().await.as_deref(), Some("the vehicle has a newer connection"));
    assert!(former.link().await.is_err());
    newer.settle().await;
    server.stop().await;
}

#[tokio::test]
async fn no_change_is_missed_while_frames_are_handled() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    admin.deploy(&signed(1)).await;
    let (mut link, ..) = vehicle.connect().await;
    link.send(reported(1)).await;
    assert!(matches!(link.next().await, Some(Body::Desired(_))));
    for number in 0..20 {
        // Each report differs, and is being stored while the change comes.
        for report in 0..5 {
            link.send(reported(10 * number + report)).await;
        }
        let change = if number % 2 == 0 { "stop" } else { "start" };
        let path = format!("/v1/deployments/brake-dark/{change}");
        admin.call(Method::POST, &path, Value::Null).await;
        let Some(Body::Desired(desired)) = link.next().await else { panic!("no desired state") };
        assert_eq!(desired.deployments[0].is_wanted, number % 2 == 1);
    }
    server.stop().await;
}

#[tokio::test]
async fn a_vehicle_fetches_only_deployments_that_are_for_it() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    let (other, _) = admin.enrol("car-8").await;
    let envelope = admin.deploy(&signed(1)).await;
    let (mut link, ..) = vehicle.connect().await;
    link.send(reported(1)).await;
    assert!(matches!(link.next().await, Some(Body::Desired(_))));
    let path = format!("/v1/deployments/{envelope}");
    assert_eq!(vehicle.get(&path).await.0, StatusCode::OK);
    assert_eq!(other.get(&path).await.0, StatusCode::NOT_FOUND);
    server.stop().await;
}

#[tokio::test]
async fn a_vehicle_in_a_loop_gets_few_certificates_and_connections() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    let renew = RenewRequest { csr: csr(&rcgen::KeyPair::generate().unwrap()) };
    for number in 0..5 {
        let expected = if number < 3 { StatusCode::OK } else { StatusCode::TOO_MANY_REQUESTS };
        assert_eq!(vehicle.post("/v1/renew", &renew).await, expected);
    }
    let audit = admin.call(Method::GET, "/v1/audit", Value::Null).await;
    let renewals = audit["items"].as_array().unwrap().iter().filter(|it| it["action"] == "renew");
    assert_eq!(renewals.count(), 3);
    let mut refused = 0;
    for _ in 0..30 {
        refused += usize::from(vehicle.link().await.is_err());
    }
    assert!(refused > 0);
    let (good, _) = admin.enrol("car-8").await;
    good.connect().await.0.settle().await;
    server.stop().await;
}

#[tokio::test]
async fn a_stream_ends_with_its_user() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    let (mut link, ..) = vehicle.connect().await;
    link.record(0..1).await;
    let new = json!({ "name": "ann", "role": "viewer" });
    let invited = admin.call(Method::POST, "/v1/users", new).await;
    let ann = Person::login(server.people, invited["code"].as_str().unwrap()).await;
    let path = "/v1/vehicles/car-7/events?follow=true";
    let mut followed = ann.open(Method::GET, path, b"").await.into_body();
    assert!(soon(followed.frame()).await.is_some());
    admin.call(Method::DELETE, "/v1/users/ann", Value::Null).await;
    assert!(soon(followed.frame()).await.is_none());
    server.stop().await;
}

#[tokio::test]
async fn a_vehicle_learns_at_once_which_of_its_streams_are_followed() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    let (mut link, ..) = vehicle.connect().await;
    let follow = async |path: &str| admin.open(Method::GET, path, b"").await.into_body();
    // A person who reads what is there, and no more, needs nothing of the vehicle.
    admin.lines("/v1/vehicles/car-7/lambdas/dark/records").await;
    let first = follow("/v1/vehicles/car-7/events?follow=true").await;
    assert_eq!(link.tail().await, ["events", "orchestrator"]);
    let second = follow("/v1/vehicles/car-7/lambdas/brake/records?follow=true").await;
    assert_eq!(link.tail().await, ["events", "lambdas/brake", "orchestrator"]);
    // Also after a lost connection.
    let (mut next, ..) = vehicle.connect().await;
    assert_eq!(next.tail().await, ["events", "lambdas/brake", "orchestrator"]);
    drop((first, second));
    server.stop().await;
}
