//! Fuzzes journals: whole files, and encoded wakes.
//!
//! An input is a byte for the mode, then data that depends on the mode. Checksums would stop a
//! fuzzer early, so one mode computes them.

use gleaner_journal::{
    ATTRIBUTES_MAX, Decoder, Encoder, JournalEnd, JournalEntry, JournalReader, JournalWriter,
    TRIGGERS_MAX, VERSION,
};

use crate::budget;
use crate::input::FuzzInput;

/// Modes of an input.
pub mod mode {
    /// A file follows.
    pub const FILE: u8 = 0;
    /// Blocks follow: kind, length in two bytes, payload. Their checksums are computed.
    pub const BLOCKS: u8 = 1;
    /// The number of inputs follows, then wakes encoded as in a block.
    pub const WAKES: u8 = 2;
}

/// A reader holds one block at a time, and JSON takes a multiple of its text.
const MEMORY: usize = 8 << 20;

/// Reads the input, writes the result and reads it again. Returns whether it has wakes and is
/// undamaged.
pub fn check(data: &[u8]) -> bool {
    let mut input = FuzzInput(data);
    match input.u8() {
        mode::WAKES => {
            let inputs = usize::from(input.u8());
            wakes(inputs, input.0)
        }
        mode::BLOCKS => file(&sealed(input)),
        _ => file(input.0),
    }
}

/// A file of the blocks in `input`; `docs/journal.md` describes the format.
pub(crate) fn sealed(mut input: FuzzInput) -> Vec<u8> {
    let mut file = b"\x89GLJRN\r\n".to_vec();
    file.extend(VERSION.to_le_bytes());
    file.resize(16, 0);
    let mut index = 0_u64;
    while !input.0.is_empty() {
        let (kind, len) = (input.u8(), input.u16());
        let payload = input.bytes(len.into());
        let mut head = vec![kind];
        head.extend((payload.len() as u32).to_le_bytes());
        head.extend(crc32fast::hash(payload).to_le_bytes());
        let crc = crc32fast::hash(&[&index.to_le_bytes()[..], &head].concat());
        file.extend(head);
        file.extend(crc.to_le_bytes());
        file.extend(payload);
        index += 1;
    }
    file
}

fn file(bytes: &[u8]) -> bool {
    let Ok(mut reader) = budget::within(MEMORY, || JournalReader::open(bytes)) else {
        return false;
    };
    let header = reader.header().clone();
    let mut entries = Vec::new();
    let failed = loop {
        match budget::within(MEMORY, || reader.next()) {
            Ok(Some(entry)) => entries.push(entry),
            Ok(None) => break None,
            Err(error) => break Some(error.to_string()),
        }
        assert!(entries.len() <= bytes.len(), "more wakes than bytes");
    };
    match &failed {
        None => assert!(reader.next().is_ok_and(|entry| entry.is_none()), "a wake after the end"),
        Some(first) => {
            let again = reader.next().expect_err("a damaged journal stays damaged").to_string();
            assert_eq!(*first, again);
        }
    }
    assert!(failed.is_none() || !reader.truncated() && reader.end().is_none());
    assert!(failed.is_some() || reader.truncated() != reader.end().is_some());
    assert!(reader.torn_bytes() <= bytes.len() as u64);
    let end = reader
        .end()
        .cloned()
        .unwrap_or(JournalEnd { wakes: entries.len() as u64, ..JournalEnd::default() });
    let mut writer = JournalWriter::begin(Vec::new(), &header).expect("the header was read");
    entries.retain(fits);
    entries.iter().for_each(|entry| writer.wake(entry).expect("the wake was read"));
    let written = writer.finish(&end).expect("the end was read");
    let mut reader = JournalReader::open(written.as_slice()).expect("it was written");
    assert_eq!(*reader.header(), header);
    for entry in &entries {
        assert_eq!(reader.next().expect("it was written").as_ref(), Some(entry));
    }
    assert!(reader.next().expect("it was written").is_none());
    assert_eq!(reader.end(), Some(&end));
    failed.is_none() && !entries.is_empty()
}

/// Returns whether the attributes fit when they are written again: numbers may become longer, such
/// as `1e15`, which becomes 1000000000000000.0.
fn fits(entry: &JournalEntry) -> bool {
    let long = |attributes| {
        serde_json::to_string(attributes).is_ok_and(|json| json.len() > ATTRIBUTES_MAX)
    };
    !entry.triggers.iter().any(|trigger| long(&trigger.attributes))
}

/// Decodes, encodes and decodes again: both results are equal to the last bit.
fn wakes(inputs: usize, bytes: &[u8]) -> bool {
    let mut decoder = Decoder::new(inputs);
    let mut rest = bytes;
    let (mut entries, mut valid) = (Vec::new(), true);
    while !rest.is_empty() {
        let before = rest.len();
        let Ok(entry) = budget::within(MEMORY, || decoder.decode(&mut rest)) else {
            valid = false;
            break;
        };
        assert!(rest.len() < before, "a wake of no bytes");
        assert_eq!(entry.seen.len(), inputs);
        assert!(entry.triggers.len() <= TRIGGERS_MAX);
        entries.push(entry);
    }
    entries.retain(fits);
    round_trip(inputs, &entries);
    valid && !entries.is_empty()
}

/// Encodes `entries`, decodes the result, and compares.
pub(crate) fn round_trip(inputs: usize, entries: &[JournalEntry]) {
    let encode = |entries: &[JournalEntry]| {
        let (mut encoder, mut bytes) = (Encoder::new(inputs), Vec::new());
        entries.iter().for_each(|entry| encoder.encode(entry, &mut bytes));
        bytes
    };
    let bytes = encode(entries);
    let (mut decoder, mut rest, mut read) = (Decoder::new(inputs), bytes.as_slice(), Vec::new());
    for entry in entries {
        let now = decoder.decode(&mut rest).expect("it was encoded");
        assert_eq!(entry.differs_from(&now, &[], true), None);
        read.push(now);
    }
    assert!(rest.is_empty(), "bytes after the last wake");
    assert!(encode(&read) == bytes, "the same wakes encode to different bytes");
}
