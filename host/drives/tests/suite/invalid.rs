//! Tests files that contradict themselves without a lost byte: each is damage, reported with its
//! position.

use gleaner_drives::{Damage, Replay};
use mcap::WriteOptions;
use mcap::records::ChunkIndex;

use crate::support::{
    MAGIC, TEXT, TOPICS, TYPE, Written, begun, damage, delivered, drive, expected, file, finished,
    listen, record, replayed, run, small_chunks, text, ticking,
};

fn schema(id: u16, name: &str, encoding: &str, definitions: &str) -> Vec<u8> {
    record(3, &[&id.to_le_bytes()[..], &text(name), &text(encoding), &text(definitions)].concat())
}

fn channel(id: u16, schema: u16, topic: &str, encoding: &str) -> Vec<u8> {
    record(
        4,
        &[&id.to_le_bytes()[..], &schema.to_le_bytes(), &text(topic), &text(encoding), &[0; 4]]
            .concat(),
    )
}

fn message(channel: u16, at: u64) -> Vec<u8> {
    let head = [&channel.to_le_bytes()[..], &[0; 4], &at.to_le_bytes(), &at.to_le_bytes()].concat();
    record(5, &[head, vec![0, 1, 0, 0], (at as i64).to_le_bytes().to_vec()].concat())
}

fn chunk(records: &[Vec<u8>], first: u64, last: u64) -> Vec<u8> {
    let bytes = records.concat();
    let len = (bytes.len() as u64).to_le_bytes();
    record(
        6,
        &[&first.to_le_bytes()[..], &last.to_le_bytes(), &len, &[0; 4], &text(""), &len, &bytes]
            .concat(),
    )
}

#[test]
fn a_channel_or_schema_that_is_redefined_is_damage() {
    let (number, a) = (schema(1, TYPE, "ros2msg", TEXT), channel(1, 1, "/a", "cdr"));
    for (again, expected_error) in [
        (
            vec![channel(1, 1, "/b", "cdr")],
            "channel 1 is defined again with another topic: first `/a`, then `/b`",
        ),
        (
            vec![
                schema(2, "std_msgs/msg/String", "ros2msg", "string data"),
                channel(1, 2, "/a", "cdr"),
            ],
            "channel 1 is defined again with another type: first `test_msgs/msg/Number`, then \
             `std_msgs/msg/String`",
        ),
        (
            vec![channel(1, 1, "/a", "json")],
            "channel 1 is defined again with another message encoding: first `cdr`, then `json`",
        ),
        (
            vec![schema(2, TYPE, "ros2msg", "int64 other"), channel(1, 2, "/a", "cdr")],
            "channel 1 is defined again with another definition of its type",
        ),
        (vec![channel(1, 7, "/a", "cdr")], "a channel names a schema that is not defined"),
        (
            vec![schema(1, "test_msgs/msg/Other", "ros2msg", TEXT)],
            "schema 1 is defined again with another name: first `test_msgs/msg/Number`, then \
             `test_msgs/msg/Other`",
        ),
        (
            vec![schema(1, TYPE, "ros2idl", TEXT)],
            "schema 1 is defined again with another encoding: first `ros2msg`, then `ros2idl`",
        ),
        (
            vec![schema(1, TYPE, "ros2msg", "int64 other")],
            "schema 1 is defined again with another text",
        ),
    ] {
        let before = [number.clone(), a.clone(), message(1, 10), message(1, 20)];
        let behind = [again, vec![message(1, 30), message(1, 40)]].concat();
        let runs = finished(&[&before[..], &behind].concat());
        let at = MAGIC.len() + before.concat().len();
        let in_run = behind[..behind.len() - 3].concat().len();
        let chunks = finished(&[chunk(&before, 10, 20), chunk(&behind, 30, 40)]);
        let second = MAGIC.len() + chunk(&before, 10, 20).len();
        for (bytes, at) in [(runs, at + in_run), (chunks, second)] {
            let (all, error) = replayed(&[file(&bytes)], &["/a"]);
            assert_eq!(all, [(10, 10), (20, 20)], "{expected_error}");
            let (offset, what) = damage(error);
            assert_eq!((offset, what.to_string().as_str()), (at as u64, expected_error));
        }
    }
}

#[test]
fn a_channel_that_differs_between_chunk_and_summary_is_damage() {
    let options = small_chunks()
        .compression(None)
        .calculate_chunk_crcs(false)
        .calculate_data_section_crc(false);
    let mut bytes = drive(options, &ticking(&TOPICS, 300, 1000));
    // The first occurrence is in the first chunk, the second in the summary.
    let needle = channel(2, 1, "/b", "cdr");
    let at = bytes.windows(needle.len()).position(|window| window == needle).unwrap();
    bytes[at + 9] = 1;
    let (all, error) = replayed(&[file(&bytes)], &TOPICS);
    assert_eq!(all, []);
    let expected = "channel 1 is defined again with another topic: first `/a`, then `/b`";
    assert_eq!(damage(error).1.to_string(), expected);
}

#[test]
fn repeated_channels_and_schemas_are_not_damage() {
    let definitions = [schema(1, TYPE, "ros2msg", TEXT), channel(1, 1, "/a", "cdr")];
    let one = |at| [definitions.to_vec(), vec![message(1, at)]].concat();
    for bytes in [
        finished(&[one(10), one(20)].concat()),
        finished(&[chunk(&one(10), 10, 10), chunk(&one(20), 20, 20)]),
    ] {
        assert_eq!(delivered(&[file(&bytes)], &["/a"]), [(10, 10), (20, 20)]);
    }
}

#[test]
fn a_message_with_a_stamp_out_of_range_is_left_out_and_counted() {
    for late in [i64::MAX as u64 + 1, u64::MAX] {
        let mut messages = ticking(&["/a", "/b"], 300, 1000);
        messages[200].at = late;
        for options in [small_chunks(), small_chunks().use_chunks(false)] {
            let (mut replay, memory) = begun(&[file(&drive(options, &messages))], &["/a", "/b"]);
            assert_eq!(replay.end_ns(), None);
            assert!(run(&mut replay).1.is_none());
            let others = [&messages[..200], &messages[201..]].concat();
            assert_eq!(memory.values(), expected(&others));
            assert_eq!(replay.malformed(), &[("/a".to_owned(), 1)].into());
        }
    }
    let messages = [Written { topic: "/a", at: i64::MAX as u64, sequence: 1, value: 7 }];
    assert_eq!(delivered(&[file(&drive(small_chunks(), &messages))], &["/a"]), [(i64::MAX, 7)]);
}

/// Returns a drive whose index has wrong times of some chunks, and the position of the first of
/// these.
fn with_wrong_times(
    options: WriteOptions,
    messages: &[Written],
    wrong_times: impl Fn(usize, &ChunkIndex) -> (u64, u64),
) -> (Vec<u8>, u64) {
    let mut bytes = drive(options.calculate_summary_section_crc(false), messages);
    let mut chunks = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
    chunks.sort_by_key(|chunk| chunk.chunk_start_offset);
    let mut first = None;
    for (n, chunk) in chunks.iter().enumerate() {
        let words = |start: u64, end: u64| {
            [start, end, chunk.chunk_start_offset].map(u64::to_le_bytes).concat()
        };
        let needle = words(chunk.message_start_time, chunk.message_end_time);
        let (start, end) = wrong_times(n, chunk);
        let wrong = words(start, end);
        if wrong != needle {
            let at = bytes.windows(needle.len()).rposition(|window| window == needle).unwrap();
            bytes[at..at + wrong.len()].copy_from_slice(&wrong);
            first.get_or_insert(chunk.chunk_start_offset);
        }
    }
    (bytes, first.unwrap())
}

#[test]
fn an_index_with_wrong_times_is_not_trusted_and_costs_no_message() {
    let messages = ticking(&TOPICS, 300, 1000);
    type WrongTimes = fn(usize, &ChunkIndex) -> (u64, u64);
    let wrong_times: [WrongTimes; 4] = [
        |_, chunk| (chunk.message_start_time + 1_000_000, chunk.message_end_time + 1_000_000),
        |n, chunk| if n == 0 { (7, 7) } else { (chunk.message_start_time, chunk.message_end_time) },
        |n, chunk| {
            if n == 9 { (1000, 1000) } else { (chunk.message_start_time, chunk.message_end_time) }
        },
        |n, chunk| {
            if n == 9 { (0, u64::MAX) } else { (chunk.message_start_time, chunk.message_end_time) }
        },
    ];
    for wrong in wrong_times {
        let (bytes, _) = with_wrong_times(small_chunks(), &messages, wrong);
        let path = file(&bytes);
        let (all, error) = replayed(std::slice::from_ref(&path), &TOPICS);
        assert_eq!(all, expected(&messages));
        let what = damage(error).1.to_string();
        assert!(what.contains("its times of a chunk differ from those in the chunk"));
        let mut part = Replay::open(&[path]).unwrap();
        assert_eq!((part.start_ns(), part.end_ns()), (Some(1000), Some(3990)));
        part.restrict(1500, 2500);
        let memory = listen(&mut part, &TOPICS);
        assert!(run(&mut part).1.is_none());
        assert_eq!(memory.values(), expected(&messages[50..150]));
    }
}

#[test]
fn a_message_outside_of_the_times_of_its_chunk_is_damage() {
    // Enough chunks that not all are compared with the index in advance.
    let messages = ticking(&TOPICS, 3000, 1000);
    let (bytes, at) = with_wrong_times(small_chunks(), &messages, |n, chunk| {
        (chunk.message_start_time + 20 * u64::from(n == 101), chunk.message_end_time)
    });
    let (all, error) = replayed(&[file(&bytes)], &TOPICS);
    let (offset, what) = damage(error);
    assert_eq!(offset, at);
    let Damage::OutsideChunk { found, first, .. } = what else { panic!("{what}") };
    assert_eq!(found + 20, first);
    assert_eq!(all, expected(&messages[..all.len()]));
    assert!(all.len() > 1000 && all.last().unwrap().0 < found as i64, "{}", all.len());
}
