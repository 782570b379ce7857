//! Seeds: a segment, and streams of several segments with gap records.

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
    ]
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
