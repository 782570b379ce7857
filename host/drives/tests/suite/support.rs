//! Shared by the tests: generated drives, and their replay.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use gleaner_drives::{Damage, DamageLocation, Replay, ReplayError, ReplayStep};
use gleaner_messages::transport::Transport;
pub use gleaner_test_support::drives::{MemorySink, TEXT, TYPE, sample_drive, spec};
use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};

pub const TOPICS: [&str; 2] = ["/a", "/b"];

#[derive(Clone, Debug)]
pub struct Written {
    pub topic: &'static str,
    pub at: u64,
    pub sequence: u32,
    pub value: i64,
}

/// Returns messages on `topics` in turn, one per 10 ns from `first` on.
pub fn ticking(topics: &[&'static str], count: usize, first: u64) -> Vec<Written> {
    (0..count)
        .map(|n| Written {
            topic: topics[n % topics.len()],
            at: first + 10 * n as u64,
            sequence: n as u32 + 1,
            value: n as i64,
        })
        .collect()
}

/// Chunks of about ten messages, so that small drives have many.
pub fn small_chunks() -> WriteOptions {
    WriteOptions::new().profile("ros2").chunk_size(Some(450))
}

/// Returns the bytes of a drive with `messages` in file order.
pub fn drive(options: WriteOptions, messages: &[Written]) -> Vec<u8> {
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    for message in messages {
        let channel = add_channel(&mut writer, message.topic, TEXT);
        write(&mut writer, channel, message);
    }
    finish(writer)
}

pub type DriveWriter = Writer<Cursor<Vec<u8>>>;

pub fn begin() -> DriveWriter {
    small_chunks().create(Cursor::new(Vec::new())).unwrap()
}

pub fn finish(mut writer: DriveWriter) -> Vec<u8> {
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}

/// Returns the channel of a topic of type [`TYPE`], which the first call adds.
pub fn add_channel(writer: &mut DriveWriter, topic: &str, definition: &str) -> u16 {
    let schema = writer.add_schema(TYPE, "ros2msg", definition.as_bytes()).unwrap();
    writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).unwrap()
}

/// Writes a message with these bytes, without a number.
pub fn write_data(writer: &mut DriveWriter, channel_id: u16, log_time: u64, data: &[u8]) {
    let header = MessageHeader { channel_id, sequence: 0, log_time, publish_time: log_time };
    writer.write_to_known_channel(&header, data).unwrap();
}

pub fn write(writer: &mut DriveWriter, channel_id: u16, message: &Written) {
    let header = MessageHeader {
        channel_id,
        sequence: message.sequence,
        log_time: message.at,
        publish_time: message.at.saturating_add(1),
    };
    let mut data = vec![0, 1, 0, 0];
    data.extend(message.value.to_le_bytes());
    writer.write_to_known_channel(&header, &data).unwrap();
}

/// Encodes a record, for those that no correct writer writes.
pub fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

pub const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";

pub fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

/// Returns a finished file of these records, without a summary.
pub fn finished(records: &[Vec<u8>]) -> Vec<u8> {
    [&MAGIC[..], &records.concat(), &record(15, &[0; 4]), &record(2, &[0; 20]), MAGIC].concat()
}

pub fn file(bytes: &[u8]) -> PathBuf {
    static NEXT: AtomicUsize = AtomicUsize::new(0);
    let name = format!("{}-{}.mcap", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

pub fn listen(replay: &mut Replay, topics: &[&str]) -> Arc<MemorySink> {
    let memory = Arc::new(MemorySink::default());
    for topic in topics {
        replay.subscribe(&spec(topic), memory.clone()).unwrap();
    }
    memory
}

/// Opens a drive, and subscribes to `topics`.
pub fn begun(paths: &[PathBuf], topics: &[&str]) -> (Replay, Arc<MemorySink>) {
    let mut replay = Replay::open(paths).unwrap();
    let memory = listen(&mut replay, topics);
    (replay, memory)
}

pub fn run(replay: &mut Replay) -> (Vec<ReplayStep>, Option<ReplayError>) {
    let mut steps = Vec::new();
    loop {
        match replay.step() {
            Ok(Some(step)) => steps.push(step),
            Ok(None) => return (steps, None),
            Err(error) => return (steps, Some(error)),
        }
    }
}

#[track_caller]
pub fn run_whole(replay: &mut Replay) -> Vec<ReplayStep> {
    let (steps, error) = run(replay);
    assert!(error.is_none(), "{error:?}");
    steps
}

#[track_caller]
pub fn damage(error: Option<ReplayError>) -> (u64, Damage) {
    match error {
        Some(ReplayError::Damaged { at: DamageLocation::Byte(offset), what, .. }) => (offset, what),
        other => panic!("expected damage, got {other:?}"),
    }
}

/// Replays undamaged drives of [`drive`]: returns the delivered (log time, value) pairs.
#[track_caller]
pub fn delivered(paths: &[PathBuf], topics: &[&str]) -> Vec<(i64, i64)> {
    let (all, error) = replayed(paths, topics);
    assert!(error.is_none(), "{error:?}");
    all
}

/// Replays drives of [`drive`]: returns the delivered (log time, value) pairs, and the error.
pub fn replayed(paths: &[PathBuf], topics: &[&str]) -> (Vec<(i64, i64)>, Option<ReplayError>) {
    let (mut replay, memory) = begun(paths, topics);
    let (_, error) = run(&mut replay);
    assert_eq!(replay.out_of_order(), 0);
    (memory.values(), error)
}

/// Returns the messages that a correct replay of `messages` delivers.
pub fn expected(messages: &[Written]) -> Vec<(i64, i64)> {
    let mut all: Vec<_> = messages.iter().map(|m| (m.at as i64, m.value)).collect();
    all.sort_by_key(|(at, _)| *at);
    all
}
