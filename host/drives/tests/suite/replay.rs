//! Tests undamaged drives: every message once, in order, for every layout of the file.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::Arc;

use gleaner_drives::{DriveLimits, Progress, Replay, ReplayError};
use gleaner_messages::{CompressedView, Endian, FieldPath, header_stamp};
use gleaner_transport::{Subscription, TopicSpec, Transport, TransportError};
use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions};

use crate::support::{
    MemorySink, TYPE, Written, drive, expected, file, listen, replayed, run, sample_drive,
    small_chunks, spec, ticking, write,
};

const SAMPLE: [(&str, &str, u64); 3] = [
    ("/imu/data", "sensor_msgs/Imu", 4170),
    ("/camera/front/compressed", "sensor_msgs/msg/CompressedImage", 400),
    ("/vehicle/speed", "geometry_msgs/msg/TwistStamped", 3316),
];

#[test]
fn the_sample_drive_matches_its_description() {
    let mut replay = Replay::open(&[sample_drive()]).unwrap();
    let memories = SAMPLE.map(|(topic, type_name, _)| {
        let memory = Arc::new(MemorySink::default());
        let (topic, type_name) = (topic.to_owned(), type_name.to_owned());
        let spec = TopicSpec { topic, type_name, queue: 0, max_bytes: 0, qos: Default::default() };
        replay.subscribe(&spec, memory.clone()).unwrap();
        memory
    });
    let (steps, error) = run(&mut replay);
    assert!(error.is_none(), "{error:?}");
    assert!(steps.is_sorted_by_key(|step| step.at_ns));
    assert_eq!(replay.progress(), Progress { done: 7886, total: Some(7886) });
    assert_eq!(replay.start_ns(), steps.first().map(|step| step.at_ns));
    assert_eq!(replay.end_ns(), steps.last().map(|step| step.at_ns));
    for ((topic, _, count), memory) in SAMPLE.iter().zip(&memories) {
        let samples = memory.0.lock().unwrap();
        assert_eq!(samples.len() as u64, *count, "{topic}");
        assert!(samples.is_sorted_by(|a, b| a.0.at_ns < b.0.at_ns && a.0.seq < b.0.seq));
        // According to the description, log time = header.stamp.
        let stamp = header_stamp(&replay.definitions(topic).unwrap()).unwrap();
        for (meta, cdr) in samples.iter() {
            assert_eq!(stamp.read(cdr, meta.endian), Ok(meta.at_ns));
        }
    }
    let imu = replay.definitions("/imu/data").unwrap();
    let up = FieldPath::compile(&imu, "linear_acceleration.z").unwrap();
    let samples = memories[0].0.lock().unwrap();
    let sum: f64 = samples.iter().map(|(m, cdr)| up.number(cdr, m.endian).unwrap()).sum();
    assert!((9.5..10.0).contains(&(sum / samples.len() as f64)), "gravity points up");
    for (meta, cdr) in memories[1].0.lock().unwrap().iter() {
        let view = CompressedView::read(cdr, meta.endian).unwrap();
        assert!(view.format.contains("jpeg") && view.data.starts_with(&[0xff, 0xd8]));
    }
}

#[test]
fn topics_are_described_before_anything_is_read() {
    let replay = Replay::open(&[sample_drive()]).unwrap();
    let topics = replay.topics();
    assert_eq!(topics.len(), 3);
    assert!(topics.is_sorted_by_key(|topic| topic.topic.clone()));
    for (name, _, count) in SAMPLE {
        let topic = topics.iter().find(|topic| topic.topic == name).unwrap();
        assert_eq!(topic.messages, Some(count));
        assert!(topic.definitions_text.as_ref().unwrap().contains("std_msgs/Header"));
    }
}

/// All layouts that a writer can choose for the same messages.
fn layouts() -> Vec<(&'static str, WriteOptions)> {
    vec![
        ("zstd", small_chunks().compression(Some(Compression::Zstd))),
        ("lz4", small_chunks().compression(Some(Compression::Lz4))),
        ("uncompressed", small_chunks().compression(None)),
        ("without chunks", small_chunks().use_chunks(false)),
        ("one chunk", WriteOptions::new()),
        ("without summary", small_chunks().emit_summary_records(false).emit_summary_offsets(false)),
        ("without chunk indexes", small_chunks().emit_chunk_indexes(false)),
        ("without message indexes", small_chunks().emit_message_indexes(false)),
        ("without statistics", small_chunks().emit_statistics(false)),
        ("without repeated channels", small_chunks().repeat_channels(false).repeat_schemas(false)),
        (
            "without checksums",
            small_chunks()
                .calculate_chunk_crcs(false)
                .calculate_data_section_crc(false)
                .calculate_summary_section_crc(false),
        ),
    ]
}

#[test]
fn every_layout_of_a_file_gives_the_same_messages() {
    let messages = ticking(&["/a", "/b", "/c"], 300, 1000);
    for (name, options) in layouts() {
        let path = file(&drive(options, &messages));
        let (all, error) = replayed(std::slice::from_ref(&path), &["/a", "/b", "/c"]);
        assert!(error.is_none(), "{name}: {error:?}");
        assert_eq!(all, expected(&messages), "{name}");
        let (some, error) = replayed(&[path], &["/b"]);
        assert!(error.is_none(), "{name}: {error:?}");
        let wanted: Vec<_> = messages.iter().filter(|m| m.topic == "/b").cloned().collect();
        assert_eq!(some, expected(&wanted), "{name}");
    }
}

#[test]
fn messages_written_out_of_order_come_in_order() {
    let mut messages = ticking(&["/a", "/b"], 400, 1000);
    // A fixed shuffle: 7 and 400 have no common factor.
    messages = (0..400).map(|n| messages[n * 7 % 400].clone()).collect();
    for (name, options) in layouts() {
        let path = file(&drive(options, &messages));
        let (all, error) = replayed(&[path], &["/a", "/b"]);
        assert!(error.is_none(), "{name}: {error:?}");
        assert_eq!(all, expected(&messages), "{name}");
    }
}

#[test]
fn past_the_memory_limit_order_is_lost_and_counted_but_no_message_is() {
    let messages = ticking(&["/a"], 400, 1000);
    let shuffled: Vec<_> = (0..400).map(|n| messages[n * 7 % 400].clone()).collect();
    let path = file(&drive(small_chunks(), &shuffled));
    let limits = DriveLimits { open_bytes: 1000, ..DriveLimits::default() };
    let mut replay = Replay::open_with(&[path], limits).unwrap();
    let memory = listen(&mut replay, &["/a"]);
    let (_, error) = run(&mut replay);
    assert!(error.is_none(), "{error:?}");
    assert!(replay.out_of_order() > 0);
    let mut all = memory.values();
    all.sort();
    assert_eq!(all, expected(&messages));
}

#[test]
fn two_files_are_one_drive_and_equal_times_follow_the_order_of_the_files() {
    let first = ticking(&["/a", "/b"], 200, 1000);
    let mut second = ticking(&["/a", "/c"], 200, 1500);
    for message in &mut second {
        message.value += 10_000;
    }
    let paths = [file(&drive(small_chunks(), &first)), file(&drive(small_chunks(), &second))];
    let both: Vec<Written> = first.iter().chain(&second).cloned().collect();
    let (all, error) = replayed(&paths, &["/a", "/b", "/c"]);
    assert!(error.is_none(), "{error:?}");
    assert_eq!(all, expected(&both));
    let mut replay = Replay::open(&paths).unwrap();
    let memory = listen(&mut replay, &["/a"]);
    assert_eq!(replay.progress().total, Some(200));
    run(&mut replay);
    let writers: std::collections::BTreeSet<String> =
        memory.0.lock().unwrap().iter().map(|(meta, _)| meta.writer.to_string()).collect();
    let expected_writers = ["6d636170000000000000000100000000", "6d636170000000010000000100000000"];
    assert!(writers.into_iter().eq(expected_writers));
}

#[test]
fn equal_times_in_one_file_follow_the_channels_then_the_file() {
    let at = |topic, value| Written { topic, at: 5, sequence: 0, value };
    let first = [Written { topic: "/a", at: 1, sequence: 0, value: 0 }];
    let mut messages = first.to_vec();
    messages.extend([at("/b", 1), at("/a", 2), at("/b", 3), at("/a", 4)]);
    let (all, _) = replayed(&[file(&drive(small_chunks(), &messages))], &["/a", "/b"]);
    assert_eq!(all, [(1, 0), (5, 2), (5, 4), (5, 1), (5, 3)]);
}

#[test]
fn peeking_delivers_nothing_and_stepping_delivers_one() {
    let path = file(&drive(small_chunks(), &ticking(&["/a"], 3, 100)));
    let mut replay = Replay::open(&[path]).unwrap();
    let memory = listen(&mut replay, &["/a"]);
    for at in [100, 110, 120] {
        assert_eq!(replay.peek_at_ns().unwrap(), Some(at));
        assert_eq!(replay.peek_at_ns().unwrap(), Some(at));
        assert_eq!(replay.step().unwrap().unwrap().at_ns, at);
    }
    assert_eq!(replay.peek_at_ns().unwrap(), None);
    assert!(replay.step().unwrap().is_none());
    assert_eq!(memory.values().len(), 3);
}

#[test]
fn two_subscriptions_of_one_topic_both_get_every_message() {
    let path = file(&drive(small_chunks(), &ticking(&["/a"], 50, 100)));
    let mut replay = Replay::open(&[path]).unwrap();
    let memory = listen(&mut replay, &["/a", "/a"]);
    let (steps, error) = run(&mut replay);
    assert!(error.is_none(), "{error:?}");
    assert_eq!(replay.progress(), Progress { done: 100, total: Some(100) });
    for (n, pair) in steps.chunks(2).enumerate() {
        assert_eq!([pair[0].subscription, pair[1].subscription], [0, 1].map(Subscription));
        assert_eq!(pair[0].meta, pair[1].meta);
        assert_eq!(pair[0].meta.seq, n as u64 + 1);
        assert_eq!(pair[0].bytes, 8);
    }
    assert_eq!(memory.values().len(), 100);
}

#[test]
fn sequence_numbers_increase_even_if_the_recorder_did_not_count() {
    let mut messages = ticking(&["/a"], 6, 100);
    for (message, sequence) in messages.iter_mut().zip([0, 0, 7, 3, 8, 20]) {
        message.sequence = sequence;
    }
    let mut replay = Replay::open(&[file(&drive(small_chunks(), &messages))]).unwrap();
    listen(&mut replay, &["/a"]);
    let (steps, _) = run(&mut replay);
    assert!(steps.iter().map(|step| step.meta.seq).eq([1, 2, 7, 8, 9, 20]));
    assert!(steps.iter().all(|step| step.meta.publish_ns == step.at_ns + 1));
}

#[test]
fn big_endian_messages_are_marked_as_such() {
    let mut writer = small_chunks().create(Cursor::new(Vec::new())).unwrap();
    let schema = writer.add_schema(TYPE, "ros2msg", b"int64 value").unwrap();
    let channel_id = writer.add_channel(schema, "/a", "cdr", &BTreeMap::new()).unwrap();
    let header = MessageHeader { channel_id, sequence: 0, log_time: 1, publish_time: 1 };
    writer.write_to_known_channel(&header, &[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 9]).unwrap();
    writer.finish().unwrap();
    let mut replay = Replay::open(&[file(&writer.into_inner().into_inner())]).unwrap();
    let memory = listen(&mut replay, &["/a"]);
    run(&mut replay);
    let taken = memory.0.lock().unwrap();
    let value = FieldPath::compile(&replay.definitions("/a").unwrap(), "value").unwrap();
    assert_eq!(taken[0].0.endian, Endian::Big);
    assert_eq!(value.number(&taken[0].1, Endian::Big), Ok(9.0));
}

#[test]
fn foreign_encodings_matter_only_on_subscribed_topics() {
    let mut writer = small_chunks().create(Cursor::new(Vec::new())).unwrap();
    let none = BTreeMap::new();
    let good = writer.add_schema(TYPE, "ros2msg", b"int64 value").unwrap();
    let idl = writer.add_schema(TYPE, "ros2idl", b"struct Number {};").unwrap();
    let channel = writer.add_channel(good, "/good", "cdr", &none).unwrap();
    writer.add_channel(good, "/json", "json", &none).unwrap();
    writer.add_channel(idl, "/idl", "cdr", &none).unwrap();
    let json = writer.add_channel(good, "/json2", "json", &none).unwrap();
    for message in ticking(&["/good"], 10, 100) {
        write(&mut writer, channel, &message);
        write(&mut writer, json, &message);
    }
    writer.finish().unwrap();
    let path = file(&writer.into_inner().into_inner());
    let mut replay = Replay::open(&[path]).unwrap();
    let memory = Arc::new(MemorySink::default());
    for (topic, text) in [
        ("/json", "topic `/json` has message encoding `json`; only `cdr` can be read"),
        ("/idl", "topic `/idl` has schema encoding `ros2idl`; only `ros2msg` can be read"),
    ] {
        let refused = replay.subscribe(&spec(topic), memory.clone()).unwrap_err();
        assert_eq!(refused.to_string(), text);
    }
    replay.subscribe(&spec("/good"), memory.clone()).unwrap();
    let (steps, error) = run(&mut replay);
    assert!(error.is_none(), "{error:?}");
    assert_eq!(steps.len(), 10);
}

#[test]
fn errors_name_the_topic_and_the_alternatives() {
    let path = file(&drive(small_chunks(), &ticking(&["/camera", "/imu"], 10, 100)));
    let mut replay = Replay::open(&[path]).unwrap();
    let memory = Arc::new(MemorySink::default());
    let absent = replay.subscribe(&spec("/camra"), memory.clone()).unwrap_err();
    assert_eq!(
        absent.to_string(),
        "no topic `/camra` (did you mean `/camera`?); there are: /camera, /imu"
    );
    let other = TopicSpec { type_name: "sensor_msgs/msg/Imu".to_owned(), ..spec("/imu") };
    let wrong = replay.subscribe(&other, memory.clone()).unwrap_err();
    assert!(matches!(wrong, TransportError::WrongType { .. }));
    replay.subscribe(&spec("/imu"), memory.clone()).unwrap();
    replay.step().unwrap();
    let late = replay.subscribe(&spec("/imu"), memory).unwrap_err();
    assert!(matches!(late, TransportError::AlreadyStarted { .. }));
}

#[test]
fn files_that_disagree_on_a_type_are_refused() {
    let good = drive(small_chunks(), &ticking(&["/a"], 10, 100));
    let mut writer = small_chunks().create(Cursor::new(Vec::new())).unwrap();
    let schema = writer.add_schema("test_msgs/msg/Other", "ros2msg", b"int8 x").unwrap();
    writer.add_channel(schema, "/a", "cdr", &BTreeMap::new()).unwrap();
    writer.finish().unwrap();
    let other = writer.into_inner().into_inner();
    let refused = Replay::open(&[file(&good), file(&other)]).err().unwrap();
    let text = refused.to_string();
    assert!(matches!(refused, ReplayError::TypeConflict { .. }));
    assert!(text.contains(TYPE) && text.contains("test_msgs/msg/Other"), "{text}");
}

#[test]
fn a_file_that_is_not_a_drive_is_refused_on_open() {
    let refuse = |path| Replay::open(&[path]).err().unwrap();
    assert!(matches!(Replay::open(&[]).err().unwrap(), ReplayError::NoFiles));
    assert!(matches!(refuse("no/such/file".into()), ReplayError::Open { .. }));
    assert!(matches!(refuse(file(b"")), ReplayError::NotMcap { .. }));
    // With and without the feature `bags`.
    let database = refuse(file(b"SQLite format 3\0"));
    assert!(
        matches!(database, ReplayError::Database { .. } | ReplayError::NotBuiltIn { .. }),
        "{database}"
    );
    let directory = refuse(std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src"));
    assert!(
        matches!(directory, ReplayError::NoBag { .. } | ReplayError::NotBuiltIn { .. }),
        "{directory}"
    );
}

#[test]
fn a_replay_can_move_to_another_thread() {
    fn is_send<T: Send>() {}
    is_send::<Replay>();
}
