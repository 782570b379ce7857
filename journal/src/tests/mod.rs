//! Tests of journals, with shared headers and wakes.

use serde_json::{Map, json};

use super::block::{HEAD_LEN, Head, MAGIC, PREAMBLE_LEN, kind};
use super::*;
use gleaner_base::{Exit, Explain};
use gleaner_lambda::{Fault, Trigger, TriggerKind};

mod differences;
mod file;
mod hostile;
mod wakes;

/// Pseudo-random numbers, the same in every run (xorshift64*).
struct Xorshift(u64);

impl Xorshift {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    fn below(&mut self, end: u64) -> u64 {
        (self.next() >> 16) % end
    }

    fn one_in(&mut self, n: u64) -> bool {
        self.below(n) == 0
    }

    /// Returns a number that is mostly small.
    fn number(&mut self) -> u64 {
        let bits = self.below(64) as u32;
        if self.one_in(3) { self.next() >> bits } else { self.below(40) }
    }
}

fn header(inputs: usize) -> JournalHeader {
    let file = |path: &str| FileDigest {
        path: path.to_owned(),
        bytes: 7,
        sha256: "0123456789abcdef".repeat(4),
    };
    JournalHeader {
        gleaner: "0.1.0".to_owned(),
        engine: "wasmtime 48.0.8".to_owned(),
        machine: "x86_64".to_owned(),
        lambda: "brake-dark".to_owned(),
        version: "0.1.0".to_owned(),
        files: vec![file("brake_dark.wasm"), file("lambda.toml")],
        models: vec![file("models/d.onnx")],
        inputs: (0..inputs)
            .map(|n| JournalInput {
                name: format!("in{n}"),
                topic: format!("/in{n}"),
                wire_topic: format!("/wire{n}"),
                type_name: "sensor_msgs/msg/Imu".to_owned(),
            })
            .collect(),
        event_input: (inputs > 0).then_some(0),
        config: Map::from_iter([
            ("brake_mps2".to_owned(), json!(-3.0)),
            ("dark".to_owned(), json!("x")),
        ]),
        remaps: vec![("/in0".to_owned(), "/wire0".to_owned())],
        clock: "log time of the drive".to_owned(),
        ..JournalHeader::default()
    }
}

fn end(wakes: usize) -> JournalEnd {
    JournalEnd { wakes: wakes as u64, samples: vec![5, 6], drives: Vec::new() }
}

fn any_entry(random: &mut Xorshift, inputs: usize) -> JournalEntry {
    let writer = |random: &mut Xorshift| [random.below(3) as u8; 16];
    let cause = match random.one_in(3) {
        true => WakeSource::Tick { missed: if random.one_in(2) { 0 } else { random.number() } },
        false => WakeSource::Sample { writer: writer(random), seq: random.number() },
    };
    let seen = (0..inputs)
        .map(|_| InputView {
            new: random.number(),
            digest: if random.one_in(4) { 0 } else { random.next() as u32 },
            newest: (!random.one_in(4)).then(|| (writer(random), random.number())),
            reach: random.number(),
        })
        .collect();
    let triggers = (0..random.below(12).saturating_sub(8)).map(|_| any_trigger(random)).collect();
    let fault = random.one_in(8).then(|| Fault {
        kind: FAULTS[random.below(8) as usize].0,
        message: "ä\n".repeat(random.below(200) as usize),
        used: random.one_in(2).then(|| random.number()),
        allowed: random.one_in(2).then(|| random.number()),
    });
    let log = match random.one_in(4) {
        true => LogDigest { lines: random.number() as u32, digest: random.next() as u32 },
        false => LogDigest::default(),
    };
    let fuel = random.one_in(2).then(|| random.number());
    JournalEntry { at_ns: random.number() as i64, cause, seen, triggers, fault, fuel, log }
}

fn any_trigger(random: &mut Xorshift) -> Trigger {
    let mut attributes = Map::new();
    for n in 0..random.below(4) {
        let value = match random.below(5) {
            0 => json!(random.number()),
            1 => json!(-(random.below(1 << 60) as i64)),
            // With few digits: `a_fraction_keeps_its_last_bit` tests the others.
            2 => json!(random.below(1 << 20) as f64 / -1024.0),
            3 => json!({ "x": [null, true, "ü\"\\"] }),
            _ => json!("text"),
        };
        attributes.insert(format!("key{n}"), value);
    }
    Trigger {
        kind: [TriggerKind::Event, TriggerKind::Start, TriggerKind::Stop][random.below(3) as usize],
        label: "hard-brake".repeat(random.below(3) as usize),
        score: random.one_in(2).then(|| random.next() as f64 / 1e19),
        attributes,
    }
}

/// Returns realistic wakes of a lambda with one or two inputs, woken by a camera at 10 Hz or an IMU
/// at 100 Hz.
fn usual_entries(inputs: usize, n: usize) -> Vec<JournalEntry> {
    let mut random = Xorshift(7);
    let mut seq = 100;
    let mut imu = 5000;
    let step_ns = if inputs == 1 { 10_000_000 } else { 100_000_000 };
    (0..n)
        .map(|index| {
            let jitter_ns = random.below(1_000_000) as i64;
            seq += 1;
            let mut seen = vec![InputView {
                new: 1,
                digest: random.next() as u32 | 1,
                newest: Some(([7; 16], seq)),
                reach: 1,
            }];
            if inputs == 2 {
                let new = 9 + random.below(3);
                imu += new;
                seen.push(InputView {
                    new,
                    digest: random.next() as u32 | 1,
                    newest: Some(([8; 16], imu)),
                    reach: 200,
                });
            }
            JournalEntry {
                at_ns: 1_533_199_000_000_000_000 + index as i64 * step_ns + jitter_ns,
                cause: WakeSource::Sample { writer: [7; 16], seq },
                seen,
                fuel: Some(250_000 + random.below(20_000)),
                ..JournalEntry::default()
            }
        })
        .collect()
}

/// Returns a complete journal with a block for every `per_block` wakes.
fn journal(header: &JournalHeader, entries: &[JournalEntry], per_block: usize) -> Vec<u8> {
    let mut writer = JournalWriter::begin(Vec::new(), header).unwrap();
    for (index, entry) in entries.iter().enumerate() {
        writer.wake(entry).unwrap();
        if (index + 1) % per_block == 0 {
            writer.flush().unwrap();
        }
    }
    writer.finish(&end(entries.len())).unwrap()
}

fn read_all<R: std::io::Read>(
    reader: &mut JournalReader<R>,
) -> (Vec<JournalEntry>, Option<JournalError>) {
    let mut entries = Vec::new();
    loop {
        match reader.next() {
            Ok(Some(entry)) => entries.push(entry),
            Ok(None) => return (entries, None),
            Err(error) => return (entries, Some(error)),
        }
    }
}

/// Returns a journal of these blocks, with correct checksums.
fn journal_of(blocks: &[(u8, Vec<u8>)]) -> Vec<u8> {
    let mut bytes = [&MAGIC[..], &VERSION.to_le_bytes()].concat();
    bytes.resize(PREAMBLE_LEN, 0);
    for (index, (kind, payload)) in blocks.iter().enumerate() {
        let head =
            Head { kind: *kind, len: payload.len() as u32, payload_crc: crc32fast::hash(payload) };
        bytes.extend_from_slice(&head.to_bytes(index as u64));
        bytes.extend_from_slice(payload);
    }
    bytes
}

/// Returns the offset of each block of a complete journal, and its length.
fn offsets(bytes: &[u8]) -> Vec<usize> {
    let mut offsets = vec![PREAMBLE_LEN];
    while let Some(head) = bytes[*offsets.last().unwrap()..].first_chunk() {
        let head = Head::from_bytes(head, offsets.len() as u64 - 1).unwrap();
        offsets.push(offsets.last().unwrap() + HEAD_LEN + head.len as usize);
    }
    assert_eq!(*offsets.last().unwrap(), bytes.len());
    offsets
}

fn header_block(header: &JournalHeader) -> (u8, Vec<u8>) {
    (kind::HEADER, serde_json::to_vec(header).unwrap())
}
