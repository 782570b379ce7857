//! Seeds: journals of a lambda with two inputs, with every kind of wake.

use gleaner_journal::{
    Encoder, InputView, JournalEnd, JournalEntry, JournalHeader, JournalInput, JournalWriter,
    LogDigest, WakeSource,
};
use gleaner_lambda::{Fault, FaultKind, Trigger, TriggerKind};
use serde_json::{Map, json};

use crate::journal::mode;

/// Dictionary of headers and attributes.
pub const WORDS: &[&str] = &[
    "gleaner",
    "engine",
    "machine",
    "lambda",
    "version",
    "kind",
    "wasm",
    "python",
    "files",
    "models",
    "manifest",
    "inputs",
    "topic",
    "wire_topic",
    "type_name",
    "event_input",
    "config",
    "remaps",
    "clock",
    "wakes_before",
    "wakes",
    "samples",
    "drives",
    "{\"a\":1e15}",
    "null",
    "path",
    "bytes",
    "sha256",
    "crc32",
];

/// Kind of the blocks that hold wakes.
const WAKES: u8 = 2;

/// All seeds.
pub fn all() -> Vec<Vec<u8>> {
    let header = header();
    let mut writer =
        JournalWriter::begin(vec![mode::FILE], &header).expect("the header has two inputs");
    entries().iter().for_each(|entry| writer.wake(entry).expect("the wake has two inputs"));
    let file = writer.finish(&end()).expect("writing to memory succeeds");
    let json = |value: serde_json::Value| value.to_string().into_bytes();
    let blocks = [
        (1, json(serde_json::to_value(&header).expect("a header is JSON"))),
        (WAKES, [&[entries().len() as u8][..], &wakes()].concat()),
        (3, json(serde_json::to_value(end()).expect("an end is JSON"))),
    ];
    let mut sealed = vec![mode::BLOCKS];
    for (kind, payload) in blocks {
        sealed.push(kind);
        sealed.extend((payload.len() as u16).to_le_bytes());
        sealed.extend(payload);
    }
    let alone = [&[mode::WAKES, header.inputs.len() as u8][..], &wakes()].concat();
    vec![file, sealed, alone]
}

fn end() -> JournalEnd {
    JournalEnd { wakes: entries().len() as u64, samples: vec![4, 40], drives: Vec::new() }
}

fn wakes() -> Vec<u8> {
    let (mut encoder, mut bytes) = (Encoder::new(2), Vec::new());
    entries().iter().for_each(|entry| encoder.encode(entry, &mut bytes));
    bytes
}

pub(super) fn header() -> JournalHeader {
    let input = |name: &str| JournalInput {
        name: name.to_owned(),
        topic: format!("/{name}"),
        wire_topic: format!("/car/{name}"),
        type_name: "sensor_msgs/msg/Imu".to_owned(),
    };
    JournalHeader {
        gleaner: "0".to_owned(),
        engine: "none".to_owned(),
        machine: "x".to_owned(),
        lambda: "brake".to_owned(),
        version: "0.1.0".to_owned(),
        inputs: vec![input("camera"), input("imu")],
        event_input: Some(0),
        remaps: vec![("/imu".to_owned(), "/car/imu".to_owned())],
        clock: "x".to_owned(),
        ..JournalHeader::default()
    }
}

pub(super) fn entries() -> Vec<JournalEntry> {
    let seen = |seq: u64| InputView {
        new: seq % 40,
        digest: seq as u32,
        newest: Some(([7; 16], seq)),
        reach: 3,
    };
    let usual = |seq: u64| JournalEntry {
        at_ns: 1_500_000_000_000_000_000 + 100_000_000 * seq as i64,
        cause: WakeSource::Sample { writer: [7; 16], seq },
        seen: vec![seen(seq), seen(10 * seq)],
        fuel: Some(250_000 + seq),
        ..JournalEntry::default()
    };
    let mut attributes = Map::new();
    attributes.insert("speed".to_owned(), json!([1.5, -0.0, null, "text", { "a": 1e300 }]));
    let trigger = Trigger {
        kind: TriggerKind::Event,
        label: "brake".to_owned(),
        score: Some(0.5),
        attributes,
    };
    let fault = Fault {
        kind: FaultKind::Fuel,
        message: "too much".to_owned(),
        used: Some(9),
        allowed: Some(8),
    };
    vec![
        usual(1),
        JournalEntry { triggers: vec![trigger], ..usual(2) },
        JournalEntry { fault: Some(fault), fuel: None, ..usual(3) },
        JournalEntry {
            cause: WakeSource::Tick { missed: 2 },
            log: LogDigest { lines: 1, digest: 5 },
            ..usual(4)
        },
        JournalEntry { seen: vec![InputView::default(); 2], ..usual(90) },
    ]
}
