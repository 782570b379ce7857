//! Seeds: conversations with the ingress, and of a starter with a program that it starts.

use gleaner_protocol::ingress::{
    AddReader, AddTopics, AttachedTopic, PinGrant, PublishGrant, Qos, ReaderMessage, RefusedTopic,
    RegionLayout, TopicGrant,
};

use serde_json::to_vec;

use super::link::{as_bytes, as_frames};
use crate::ingress::mode;

/// Keys of JSON messages and names of connections.
pub const WORDS: &[&str] = &[
    "name",
    "topics",
    "publishes",
    "reader",
    "topic",
    "type_name",
    "qos",
    "auto",
    "fixed",
    "queue",
    "max_bytes",
    "depth",
    "holds",
    "windows",
    "window",
    "singles",
    "wakes",
    "digests",
    "welcome",
    "attached",
    "refused",
    "no_such_topic",
    "wrong_type",
    "definitions",
    "status",
    "layout",
    "slots",
    "slot_bytes",
    "first_word",
    "first",
    "offered_qos",
    "health",
    "control",
    "ingress",
    "recorder",
];

/// All seeds. The tag numbers are private to `gleaner_protocol::link`, so they are repeated here.
pub fn all() -> Vec<Vec<u8>> {
    let number = |number: u32, rest: &[u8]| [&number.to_le_bytes()[..], rest].concat();
    let reader = vec![(64, number(7, &[])), (65, number(1, b"message")), (65, number(0, &[]))];
    let publish = PublishGrant {
        topic: "/decisions".to_owned(),
        type_name: "std_msgs/msg/String".to_owned(),
        depth: 8,
        max_bytes: 1024,
    };
    let (name, publishes) = ("brake".to_owned(), vec![publish]);
    let add = AddReader { name: name.clone(), topics: vec![grant(0), grant(1)], publishes };
    let further = AddTopics { reader: name, topics: vec![grant(2)] };
    let starter = vec![
        (3, json(to_vec(&add))),
        (4, json(to_vec(&further))),
        (5, Vec::new()),
        (2, Vec::new()),
    ];
    let refused = RefusedTopic::NoSuchTopic { known: vec!["/imu".to_owned()], nearest: None };
    let ingress = [
        ReaderMessage::Attached(Box::new(attached())),
        ReaderMessage::Refused { id: 2, reason: refused },
        ReaderMessage::Definitions { id: 1, text: Some("float64 x".to_owned()) },
        ReaderMessage::Status(Box::default()),
    ];
    let ingress = ingress.iter().map(|message| (48, json(to_vec(message)))).collect();
    let handover = |connections: &str| {
        let version = env!("CARGO_PKG_VERSION");
        let text = format!(r#"{{"version":"{version}","connections":[{connections}]}}"#);
        (6, text.into_bytes())
    };
    let handover = vec![handover(r#""ingress""#), handover("")];
    let all = [
        (mode::READER, reader),
        (mode::STARTER, starter),
        (mode::INGRESS, ingress),
        (mode::INGRESS, vec![(48, json(to_vec(&ReaderMessage::Welcome)))]),
        (mode::HANDOVER, handover),
    ];
    all.into_iter()
        .flat_map(|(peers, frames)| [as_frames(peers, &frames), as_bytes(peers, &frames)])
        .collect()
}

fn json(text: serde_json::Result<Vec<u8>>) -> Vec<u8> {
    text.expect("it is JSON")
}

fn grant(id: u32) -> TopicGrant {
    TopicGrant {
        id,
        topic: "/imu".to_owned(),
        type_name: Some("sensor_msgs/msg/Imu".to_owned()),
        qos: Qos::Fixed { reliable: true, transient_local: false, depth: 5 },
        queue: 10,
        max_bytes: Some(4096),
        depth: 20,
        holds: PinGrant { windows: 1, window: 20, singles: 3 },
        wakes: true,
        ..TopicGrant::default()
    }
}

fn attached() -> AttachedTopic {
    AttachedTopic {
        id: 1,
        type_name: "sensor_msgs/msg/Imu".to_owned(),
        layout: RegionLayout { depth: 20, slots: 50, slot_bytes: 4096 },
        holds: PinGrant { windows: 1, window: 20, singles: 3 },
        first: 9,
        ..AttachedTopic::default()
    }
}
