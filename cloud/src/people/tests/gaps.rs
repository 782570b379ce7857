use std::ops::Range;

use axum::body::BodyDataStream;
use futures_util::StreamExt;
use gleaner_fleet::Cursor;

use super::*;
use crate::store::StreamBatch;
use crate::store::tests::connected;

const CAR: &str = "car-7";

/// Appends records, of which at most `kept` stay.
async fn append(cloud: &Cloud, epoch: u64, seqs: Range<u64>, kept: u64) {
    let cursor = Cursor {
        stream: "events".to_owned(),
        life: 1,
        next: seqs.end,
        seq: seqs.end - 1,
        ..Cursor::default()
    };
    let line = |seq| {
        json!({ "stream": "events", "seq": seq, "time_ns": 1, "boot_ns": seq, "boot": "b",
            "kind": "event", "record": { "text": "x" } })
    };
    let lines = seqs.map(|seq| (seq, String::new(), line(seq).to_string())).collect();
    let bounds = Retention { records: kept, ..Retention::DEFAULT };
    cloud.store.append(CAR, epoch, StreamBatch { lines, cursor }, bounds).await.unwrap();
    cloud.hub.arrived(CAR);
}

async fn piece(body: &mut BodyDataStream) -> Vec<Value> {
    let bytes = body.next().await.unwrap().unwrap();
    let lines = bytes.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
    lines.map(|line| serde_json::from_slice(line).unwrap()).collect()
}

#[tokio::test]
async fn events_of_two_streams_come_in_the_order_of_their_times() {
    let (_folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "ann", Role::Viewer).await;
    let epoch = connected(&cloud.store, CAR).await;
    for (stream, time) in [("events", 5), ("orchestrator", 4)] {
        let cursor = Cursor { stream: stream.to_owned(), life: 1, next: 1, ..Cursor::default() };
        let line = json!({ "stream": stream, "seq": 0, "time_ns": time, "boot_ns": time,
                           "boot": "b", "kind": "event" });
        let lines = vec![(0, String::new(), line.to_string())];
        let batch = StreamBatch { lines, cursor };
        cloud.store.append(CAR, epoch, batch, Retention::DEFAULT).await.unwrap();
    }
    let path = (Method::GET, "/v1/vehicles/car-7/events");
    let text = String::from_utf8(send(&cloud, path, Some(&token), &[], "").await.body).unwrap();
    let line = |line| serde_json::from_str::<Value>(line).unwrap();
    let times: Vec<_> = text.lines().map(|text| line(text)["time_ns"].clone()).collect();
    assert_eq!(times, [4, 5]);
    // As server-sent events, only the last one has a position: another one may come before it.
    let sse: &[_] = &[("accept", "text/event-stream")];
    let path = (Method::GET, "/v1/vehicles/car-7/events");
    let text = String::from_utf8(send(&cloud, path, Some(&token), sse, "").await.body).unwrap();
    assert_eq!(text.matches("id: ").count(), 1, "{text}");
    assert!(text.find("\"time_ns\":4") < text.find("id: 2\n"), "{text}");
}

#[tokio::test]
async fn a_carriage_return_splits_no_event() {
    let (_folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "ann", Role::Viewer).await;
    let epoch = connected(&cloud.store, CAR).await;
    append(&cloud, epoch, 0..2, 9).await;
    // As an earlier version has stored it.
    let update = "UPDATE records SET line = REPLACE(line, ',', $1)";
    cloud.store.execute_with(update, &[",\r"]).await;
    let accepts: &[_] = &[("accept", "text/event-stream")];
    let path = format!("/v1/vehicles/{CAR}/events");
    let answer = send(&cloud, (Method::GET, &path), Some(&token), accepts, "").await;
    let text = String::from_utf8(answer.body).unwrap();
    // A client splits lines at each of both characters.
    let data = text.split(['\r', '\n']).filter_map(|line| line.strip_prefix("data: "));
    let seqs = data.map(|it| serde_json::from_str::<Value>(it).unwrap()["seq"].clone());
    assert_eq!(seqs.collect::<Vec<_>>(), [0, 1]);
}

#[tokio::test]
async fn what_is_removed_ahead_of_a_reader_is_counted_by_a_gap() {
    let (_folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "ann", Role::Viewer).await;
    let epoch = connected(&cloud.store, CAR).await;
    append(&cloud, epoch, 0..600, 1000).await;
    let request = Request::get(format!("/v1/vehicles/{CAR}/events?follow=true"))
        .extension(ClientNetwork::of([127, 0, 0, 1].into()))
        .header(header::AUTHORIZATION, format!("Bearer {token}"));
    let reply = answer(&cloud, request.body(Body::empty()).unwrap()).await;
    let mut body = reply.into_body().into_data_stream();
    let first = piece(&mut body).await;
    let read = first.len() as u64;
    assert!(first.iter().enumerate().all(|(seq, line)| line["seq"] == seq) && read < 600);

    append(&cloud, epoch, 600..601, 100).await;
    let next = piece(&mut body).await;
    assert_eq!(next[0]["kind"], "gap", "{}", next[0]);
    let removed = next[0]["record"]["records"].as_u64().unwrap();
    assert!(removed > read, "{removed} of which {read} were read");
    let seqs: Vec<_> = next[1..].iter().map(|line| line["seq"].as_u64().unwrap()).collect();
    assert_eq!(seqs, (removed..601).collect::<Vec<_>>(), "all others follow");

    // What was read before its removal is missing for no reader.
    append(&cloud, epoch, 601..602, 10).await;
    let last = piece(&mut body).await;
    assert_eq!(last.iter().map(|line| &line["seq"]).collect::<Vec<_>>(), [601]);
}
