//! A vehicle with a valid certificate sends what it should not.

use gleaner_fleet::{Body, FRAME_MAX, Frame, Hello, LINES_MAX, Records, Reported, compress};
use hyper::{Method, StatusCode};
use serde_json::Value;

use crate::{start, start_with_vehicle};

#[tokio::test]
async fn a_hostile_frame_ends_its_own_connection_only() {
    let (_folder, server, admin) = start().await;
    let (good, _) = admin.enrol("good").await;
    let (bad, _) = admin.enrol("bad").await;
    let (mut other, ..) = good.connect().await;
    let bomb = compress(&vec![b' '; LINES_MAX as usize + 1]);
    let records = |stream: &str, lines| {
        let stream = stream.to_owned();
        Frame::encoded(Body::Records(Records { stream, life: 1, next: 1, lines }))
    };
    let status =
        |status| Frame::encoded(Body::Reported(Reported { status, ..Reported::default() }));
    let (stream, lines) = ("events".to_owned(), compress(b""));
    let life = Frame::encoded(Body::Records(Records { stream, life: u64::MAX, next: 1, lines }));
    let frames = [
        (life, "`life` of stream `events` cannot be 18446744073709551615"),
        (vec![0x0a, 0xff], "a frame cannot be decoded"),
        (records("events", bomb.clone()), "it has more than 8388608 bytes"),
        (records("../events", compress(b"")), "is not a stream"),
        (records("events", b"no zstd".to_vec()), "cannot be used"),
        (status(bomb), "it has more than 8388608 bytes"),
        (status(compress(b"{}")), "not a valid status"),
        (Frame::encoded(Body::Hello(Hello::default())), "a vehicle does not send"),
    ];
    for (frame, expected) in frames {
        let (mut link, ..) = bad.connect().await;
        link.send_bytes(frame).await;
        let reason = link.end().await.unwrap();
        assert!(reason.contains(expected), "{reason}");
    }
    let (mut link, ..) = bad.connect().await;
    link.send_bytes(vec![0; FRAME_MAX + 1]).await;
    link.end().await;
    let mut link = bad.link().await.unwrap();
    link.send(Body::Hello(Hello { protocol: 99, ..Hello::default() })).await;
    let reason = link.end().await.unwrap();
    assert_eq!(reason, "the channel has version 1, not 99");
    other.settle().await;
    server.stop().await;
}

#[tokio::test]
async fn only_a_handshake_of_the_standard_opens_the_control_channel() {
    let (_folder, server, _, vehicle) = start_with_vehicle().await;
    // Key and answer are the example of RFC 6455, section 1.3.
    let headers = [
        ("connection", "Upgrade"),
        ("upgrade", "websocket"),
        ("sec-websocket-version", "13"),
        ("sec-websocket-key", "dGhlIHNhbXBsZSBub25jZQ=="),
    ];
    let answer = vehicle.handshake(&headers).await;
    assert_eq!(answer.status(), StatusCode::SWITCHING_PROTOCOLS);
    assert_eq!(answer.headers()["sec-websocket-accept"], "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=");
    drop(answer);
    let wrong = ["close", "h2c", "8", "dGhlIHNhbXBsZQ=="];
    for (at, value) in wrong.into_iter().enumerate() {
        let mut headers = headers.to_vec();
        headers[at].1 = value;
        let refused = vehicle.handshake(&headers).await.status();
        assert_eq!(refused, StatusCode::BAD_REQUEST, "{:?}", headers[at]);
        headers.remove(at);
        let refused = vehicle.handshake(&headers).await.status();
        assert_eq!(refused, StatusCode::BAD_REQUEST, "without {}", value);
    }
    // The channel still opens.
    vehicle.connect().await.0.settle().await;
    server.stop().await;
}

#[tokio::test]
async fn requests_without_a_right_are_refused() {
    let (_folder, server, admin, vehicle) = start_with_vehicle().await;
    let (status, _) = vehicle.get("/v1/objects/..%2f..%2fcloud.db").await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    let (status, _) = vehicle.get(&format!("/v1/objects/{}", "0".repeat(64))).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    // No deployment needs it.
    let object = format!("/v1/objects/{}", "0".repeat(64));
    let refused = admin.open(Method::PUT, &object, b"x").await.status();
    assert_eq!(refused, StatusCode::BAD_REQUEST);
    let all = admin.call(Method::GET, "/v1/users", Value::Null).await;
    assert_eq!(all["items"].as_array().map(Vec::len), Some(1));
    server.stop().await;
}
