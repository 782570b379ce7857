//! Fuzzes the segments of a stream.
//!
//! An input is a byte for the mode, then data that depends on the mode. Checksums would stop a
//! fuzzer early, so one mode computes them.

use gleaner_protocol::SpooledRecord;
use gleaner_spool::{PAYLOAD_MAX, SpoolError, SpoolItem, SpoolReader, SpoolRecord};
use gleaner_test_support::simulated_disk::SimulatedDisk;

use crate::budget;
use crate::input::FuzzInput;

/// Modes of an input.
pub mod mode {
    /// A segment follows.
    pub const FILE: u8 = 0;
    /// Records follow: kind, numbers skipped before it, length in two bytes, payload. Kind 255
    /// begins a segment, and has neither length nor payload. The checksums are computed.
    pub const RECORDS: u8 = 1;
}

/// Kind of a record that begins a segment instead.
pub(crate) const NEW_SEGMENT: u8 = 255;

/// Memory of a reader: a window, and a record.
const MEMORY: usize = 256 << 10;

const STREAM: &str = "s";
const SALT: [u8; 8] = [0x5a; 8];

/// Reads the input twice. Returns whether it has records and is undamaged.
pub fn check(data: &[u8]) -> bool {
    let mut input = FuzzInput(data);
    let segments = match input.u8() {
        mode::RECORDS => sealed(input),
        _ => vec![(0, input.0.to_vec())],
    };
    let bytes = segments.iter().map(|(_, bytes)| bytes.len()).sum();
    let disk = SimulatedDisk::new(0);
    for (first, bytes) in &segments {
        drop(disk.add(*first));
        disk.with_content(*first, |content| content.clone_from(bytes));
    }
    let (valid, records) = read(&disk, bytes, None);
    assert_eq!((valid, records), read(&disk, bytes, None), "the same segments, read twice");
    read(&disk, bytes, Some(3));
    let contents = disk.firsts().into_iter().map(|it| (it, disk.with_content(it, |it| it.clone())));
    assert_eq!(contents.collect::<Vec<_>>(), segments, "a reader writes nothing");
    valid && records > 0
}

/// Segments of the records in `input`, with their first numbers; `docs/spool.md` describes the
/// format.
pub(crate) fn sealed(mut input: FuzzInput) -> Vec<(u64, Vec<u8>)> {
    let mut segments = vec![(0, header(0))];
    let mut seq = 0_u64;
    while !input.0.is_empty() {
        let (kind, skipped) = (input.u8(), input.u8());
        seq += u64::from(skipped);
        if kind == NEW_SEGMENT {
            if segments.last().is_some_and(|(first, _)| *first < seq) {
                segments.push((seq, header(seq)));
            }
            continue;
        }
        let len = input.u16();
        let payload = input.bytes(len.into());
        let mut head = (payload.len() as u32).to_le_bytes().to_vec();
        head.extend(crc32fast::hash(payload).to_le_bytes());
        head.extend(seq.to_le_bytes());
        head.extend([0; 16]);
        head.extend([kind, 0, 0, 0]);
        let crc = crc32fast::hash(&[&SALT[..], &head].concat());
        let (_, segment) = segments.last_mut().expect("there is a first one");
        segment.extend(head);
        segment.extend(crc.to_le_bytes());
        segment.extend(payload);
        seq += 1;
    }
    segments
}

fn header(first: u64) -> Vec<u8> {
    let mut header = b"\x89GLSPL\r\n\x01\x00\x01".to_vec();
    header.resize(32, 0);
    header.extend(first.to_le_bytes());
    header.extend(SALT);
    header.extend(STREAM.as_bytes());
    header.resize(124, 0);
    header.extend(crc32fast::hash(&header).to_le_bytes());
    header
}

/// Reads all items of `bytes` bytes, and checks that each number is in exactly one. Returns whether
/// there is no damage, and the number of records.
fn read(disk: &SimulatedDisk, bytes: usize, from: Option<u64>) -> (bool, usize) {
    let mut reader = SpoolReader::with_storage(disk.clone(), STREAM, from);
    let mut expected = from.or(disk.firsts().first().copied()).unwrap_or(0);
    let (mut valid, mut records, mut items) = (true, 0, 0);
    while let Some(item) = budget::within(MEMORY, || reader.next()) {
        items += 1;
        assert!(items <= bytes, "more items than bytes");
        match item {
            Ok(SpoolItem::Record(record)) => {
                assert_eq!(record.seq, expected);
                assert!(record.payload.len() <= PAYLOAD_MAX);
                parse(&record);
                records += 1;
                expected += 1;
            }
            Ok(SpoolItem::Gap(gap)) => {
                assert!(gap.from <= gap.to);
                let explains = gap.record.is_some_and(|record| gap.to + 1 == record);
                match gap.record {
                    None => assert_eq!(gap.from, expected),
                    Some(_) if explains => assert!(gap.from <= expected),
                    Some(record) => assert_eq!(record, expected),
                }
                valid &= gap.record.is_some();
                expected = gap.record.unwrap_or(gap.to) + 1;
            }
            Ok(SpoolItem::Torn(torn)) => {
                assert_eq!(torn.from, expected);
                assert!(reader.next().is_none(), "a torn tail is the end");
                return (false, records);
            }
            Err(SpoolError::Version { found, .. }) => {
                assert_ne!(found, 1);
                return (false, records);
            }
            Err(error) => panic!("{error}"),
        }
    }
    (valid, records)
}

/// Parses the payload as a record of a lambda: one that is accepted reads back.
fn parse(record: &SpoolRecord) {
    // A list of numbers takes 16 times its text, and as much again while it grows.
    let memory = (64 << 10) + 64 * record.payload.len();
    let parsed = budget::within(memory, || SpooledRecord::parse(record.kind, &record.payload).ok());
    let Some(parsed) = parsed else { return };
    assert_eq!(parsed.kind(), record.kind);
    assert_eq!(SpooledRecord::parse(record.kind, &parsed.to_payload()).unwrap(), parsed);
}
