//! Clips of vehicles that are not real: a true recording, with an image of the sample drive.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use gleaner_fleet::clips::ClipOrders;
use gleaner_test_support::cloud::fake::FakeVehicle;
use gleaner_trust::sha256;
use hyper::{Method, StatusCode};
use mcap::records::MessageHeader;
use serde_json::{Value, json};

/// Begin of the first clip, in ns since 1970.
const BEGIN: i64 = 1_790_000_000_000_000_000;

/// Announces two clips, and sends their thumbnails. With `bad`, all texts are that one, and the
/// thumbnail only begins as a JPEG.
pub(crate) async fn announce(vehicle: &FakeVehicle, bad: Option<&str>) {
    let image = image(bad.is_some());
    let clips = [("hard-brake", 0), ("dark", 60_000_000_000)].map(|(label, later)| {
        let (label, from_ns) = (bad.unwrap_or(label), BEGIN + later);
        let file = recording(from_ns);
        let moment = |offset: i64, score: f64| {
            json!({ "lambda": bad.unwrap_or("brake-dark"), "kind": "event", "label": label,
                    "score": score, "attributes": { "speed_ms": 13.9, "note": bad },
                    "at_ns": from_ns + offset })
        };
        let moments = [moment(5_000_000_000, 0.9123), moment(7_250_000_000, 0.5)];
        let lambda = json!({ "name": bad.unwrap_or("brake-dark"), "version": "1.1.0",
            "digest": "d", "deployment": "brake-dark", "revision": "r" });
        let incomplete: Vec<_> = bad.into_iter().collect();
        json!({ "name": format!("brake-dark-{later}"), "from_ns": from_ns,
                "to_ns": from_ns + 12_000_000_000, "bytes": file.len(), "sha256": sha256(&file),
                "thumbnail": sha256(&image), "lambdas": [lambda], "triggers": 2,
                "moments": moments, "incomplete": incomplete })
    });
    let orders = report(vehicle, &json!({ "cursor": "1", "clips": clips, "gone": [] })).await;
    let expected = if bad.is_some() { StatusCode::FORBIDDEN } else { StatusCode::OK };
    for name in orders.thumbnails {
        let path = format!("/v1/clips/{name}/thumbnail");
        assert_eq!(vehicle.request(Method::PUT, &path, &image).await.0, expected);
    }
}

pub(crate) async fn send_wanted(vehicle: &FakeVehicle) {
    let orders = report(vehicle, &json!({ "cursor": null, "clips": [], "gone": [] })).await;
    for wanted in orders.wanted {
        let later: i64 = wanted.name.as_str().rsplit('-').next().unwrap().parse().unwrap();
        let file = recording(BEGIN + later);
        let path = format!("/v1/clips/{}/parts/0/{}", wanted.name, sha256(&file));
        assert_eq!(vehicle.request(Method::PUT, &path, &file).await.0, StatusCode::OK);
    }
}

async fn report(vehicle: &FakeVehicle, report: &Value) -> ClipOrders {
    let body = report.to_string();
    let (status, text) = vehicle.request(Method::POST, "/v1/clips", body.as_bytes()).await;
    assert_eq!(status, StatusCode::OK, "{}", String::from_utf8_lossy(&text));
    serde_json::from_slice(&text).unwrap()
}

/// Returns the first image of the sample drive, or something that is none.
fn image(is_damaged: bool) -> Vec<u8> {
    if is_damaged {
        return [&[0xff, 0xd8, 0xff][..], &[7; 1000]].concat();
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let drive = std::fs::read(root.join("../examples/data/highway_drive.mcap")).unwrap();
    let mut messages = mcap::MessageStream::new(&drive).unwrap().map(Result::unwrap);
    let message = messages.find(|it| it.channel.topic.starts_with("/camera/")).unwrap();
    let start = message.data.windows(2).position(|it| it == [0xff, 0xd8]).unwrap();
    message.data[start..].to_vec()
}

fn recording(from_ns: i64) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let mut writer = mcap::WriteOptions::new().create(&mut file).unwrap();
    for (topic, type_name, count) in [
        ("/vehicle/imu", "sensor_msgs/msg/Imu", 1200),
        ("/camera/front/compressed", "sensor_msgs/msg/CompressedImage", 120),
    ] {
        let schema = writer.add_schema(type_name, "ros2msg", b"float64 x").unwrap();
        let channel_id = writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).unwrap();
        for sequence in 0..count {
            let log_time = from_ns as u64 + u64::from(sequence) * 12_000_000_000 / u64::from(count);
            let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
            writer.write_to_known_channel(&header, &[0; 16]).unwrap();
        }
    }
    writer.finish().unwrap();
    drop(writer);
    file.into_inner()
}
