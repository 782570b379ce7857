//! Seeds: a segment, streams of several segments with gap records, and records of a lambda.

use crate::input::FuzzInput;
use crate::spool::{NEW_SEGMENT, mode, sealed};

/// Dictionary of headers.
pub const WORDS: &[&str] = &["GLSPL\r\n"];

/// All seeds.
pub fn all() -> Vec<Vec<u8>> {
    let one = records(&[(1, 0, b"one"), (2, 0, b""), (9, 0, &[7; 300])]);
    let (_, segment) = sealed(FuzzInput(&one)).remove(0);
    // Numbers 1 to 5 are missing, then a record states that the disk was full.
    let gap = [&1_u64.to_le_bytes()[..], &5_u64.to_le_bytes(), &[2]].concat();
    let second = [NEW_SEGMENT, 0];
    let several = [
        records(&[(1, 0, b"zero")]),
        second.to_vec(),
        records(&[(0, 5, &gap), (3, 0, b"seven")]),
        second.to_vec(),
        records(&[(3, 0, b"eight")]),
    ];
    let with_mode = |mode: u8, data: &[u8]| [&[mode], data].concat();
    vec![
        with_mode(mode::FILE, &segment),
        with_mode(mode::RECORDS, &one),
        with_mode(mode::RECORDS, &several.concat()),
        with_mode(mode::RECORDS, &of_a_lambda()),
    ]
}

/// Records of each kind that a lambda has, but for the summary.
fn of_a_lambda() -> Vec<u8> {
    let start = br#"{"lambda":"l","revision":"0a","generation":1,"start":0,"pid":7,
        "software":"1"}"#;
    let decision = br#"{"at_ns":1,"cause":"tick","run_ns":2,"fault":{"kind":"trap","message":"m"},
        "triggers":[{"kind":"event","label":"a","score":0.5,"attributes":{"b":[1,null]}}]}"#;
    let log = br#"{"at_ns":-3,"level":"info","message":"m"}"#;
    let end = br#"{"pid":8,"started_ns":1,"ended_ns":2,"code":0,"signal":null,"killed":null,
        "out_of_memory":false,"max_rss_bytes":4,"cpu_ns":5,"orphans":0}"#;
    let lost = br#"{"invalid":1,"refused":2,"too_long":3}"#;
    let omitted = br#"{"kind":2,"at_ns":1,"triggers":1,"bytes":5000,"allowed":2048}"#;
    let all: [(u8, u8, &[u8]); 6] =
        [(1, 0, start), (2, 0, decision), (3, 0, log), (5, 0, end), (6, 0, lost), (7, 0, omitted)];
    records(&all)
}

/// Encodes kind, skipped numbers and payload of each record.
fn records(records: &[(u8, u8, &[u8])]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (kind, skipped, payload) in records {
        bytes.extend([*kind, *skipped]);
        bytes.extend((payload.len() as u16).to_le_bytes());
        bytes.extend(*payload);
    }
    bytes
}
