//! Tests undamaged drives: every message once, in order, for every layout of the file.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use gleaner_drives::{DriveLimits, DriveOptions, Progress, Replay, ReplayError};
use gleaner_messages::transport::{Subscription, TopicSpec, Transport, TransportError};
use gleaner_messages::{CompressedView, Endian, FieldPath, header_stamp};
use mcap::{Compression, WriteOptions};

use crate::support::{
    MemorySink, TEXT, TYPE, Written, add_channel, begin, begun, delivered, drive, expected, file,
    finish, listen, replayed, run, run_whole, sample_drive, small_chunks, spec, ticking, write,
    write_data,
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
    let steps = run_whole(&mut replay);
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
    run_whole(&mut replay);
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
    assert_eq!(delivered(&paths, &["/a", "/b", "/c"]), expected(&both));
    let (mut replay, memory) = begun(&paths, &["/a"]);
    assert_eq!(replay.progress().total, Some(200));
    run(&mut replay);
    let writers: BTreeSet<String> =
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
    let (mut replay, memory) = begun(&[path], &["/a"]);
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
    let (mut replay, memory) = begun(&[path], &["/a", "/a"]);
    let steps = run_whole(&mut replay);
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
    let (mut replay, _) = begun(&[file(&drive(small_chunks(), &messages))], &["/a"]);
    let (steps, _) = run(&mut replay);
    assert!(steps.iter().map(|step| step.meta.seq).eq([1, 2, 7, 8, 9, 20]));
    assert!(steps.iter().all(|step| step.meta.publish_ns == step.at_ns + 1));
}

#[test]
fn big_endian_messages_are_marked_as_such() {
    let mut writer = begin();
    let channel = add_channel(&mut writer, "/a", TEXT);
    write_data(&mut writer, channel, 1, &[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 9]);
    let (mut replay, memory) = begun(&[file(&finish(writer))], &["/a"]);
    run(&mut replay);
    let taken = memory.0.lock().unwrap();
    let value = FieldPath::compile(&replay.definitions("/a").unwrap(), "value").unwrap();
    assert_eq!(taken[0].0.endian, Endian::Big);
    assert_eq!(value.number(&taken[0].1, Endian::Big), Ok(9.0));
}

#[test]
fn foreign_encodings_matter_only_on_subscribed_topics() {
    let mut writer = begin();
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
    let path = file(&finish(writer));
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
    let steps = run_whole(&mut replay);
    assert_eq!(steps.len(), 10);
}

#[test]
fn errors_name_the_topic_and_the_alternatives() {
    let path = file(&drive(small_chunks(), &ticking(&["/camera", "/imu"], 10, 100)));
    let mut replay = Replay::open(&[path]).unwrap();
    let memory = Arc::new(MemorySink::default());
    let absent = replay.subscribe(&spec("/camra"), memory.clone()).unwrap_err();
    let expected = "no topic `/camra` (did you mean `/camera`?); there are: /camera, /imu";
    assert_eq!(absent.to_string(), expected);
    let other = TopicSpec { type_name: "sensor_msgs/msg/Imu".to_owned(), ..spec("/imu") };
    let wrong = replay.subscribe(&other, memory.clone()).unwrap_err();
    assert!(matches!(wrong, TransportError::WrongType { .. }));
    replay.subscribe(&spec("/imu"), memory.clone()).unwrap();
    replay.step().unwrap();
    let late = replay.subscribe(&spec("/imu"), memory).unwrap_err();
    assert!(matches!(late, TransportError::AlreadyStarted { .. }));
}

#[test]
fn each_type_of_a_topic_is_read_alone() {
    let good = drive(small_chunks(), &ticking(&["/a"], 10, 100));
    let mut writer = begin();
    let schema = writer.add_schema("test_msgs/msg/Other", "ros2msg", b"int8 x").unwrap();
    let channel = writer.add_channel(schema, "/a", "cdr", &BTreeMap::new()).unwrap();
    write_data(&mut writer, channel, 105, &[0, 1, 0, 0, 77]);
    let both = [file(&finish(writer)), file(&good)];
    let mut replay = Replay::open(&both).unwrap();
    let topics = replay.topics();
    // That with the most messages comes first.
    let found: Vec<_> = topics.iter().map(|topic| (&*topic.type_name, topic.messages)).collect();
    assert_eq!(found, [(TYPE, Some(10)), ("test_msgs/msg/Other", Some(1))]);
    let (number, other) = (listen(&mut replay, &["/a"]), Arc::new(MemorySink::default()));
    let spec = TopicSpec { type_name: "test_msgs/msg/Other".to_owned(), ..spec("/a") };
    replay.subscribe(&spec, other.clone()).unwrap();
    assert!(run(&mut replay).1.is_none());
    assert_eq!(number.values().len(), 10);
    assert_eq!(other.0.lock().unwrap().iter().map(|(_, cdr)| cdr[0]).collect::<Vec<_>>(), [77]);
    let absent = TopicSpec { type_name: "test_msgs/msg/Third".to_owned(), ..spec };
    let refused = Replay::open(&both).unwrap().can_subscribe(&absent).unwrap_err();
    assert!(matches!(refused, TransportError::WrongType { found, .. } if found == TYPE));
}

/// Creates a drive with one channel of `/a` for each definition, which has one message of two bytes
/// `n` and `10 + n`.
fn drive_of_layouts(definitions: &[&str]) -> std::path::PathBuf {
    let mut writer = begin();
    for (n, text) in definitions.iter().enumerate() {
        let schema = writer.add_schema(TYPE, "ros2msg", text.as_bytes()).unwrap();
        let metadata = [("n".to_owned(), n.to_string())].into();
        let channel = writer.add_channel(schema, "/a", "cdr", &metadata).unwrap();
        let (at, n) = (100 + n as u64, n as u8);
        write_data(&mut writer, channel, at, &[0, 1, 0, 0, n, 10 + n]);
    }
    file(&finish(writer))
}

#[test]
fn each_message_is_read_by_the_layout_of_its_channel() {
    let one = drive_of_layouts(&[
        "uint8 x\nuint8 y\n",
        "uint8 y\nuint8 x\n",
        "# other\nuint8 x\nuint8 y\n",
    ]);
    let two = [
        drive_of_layouts(&["uint8 x\nuint8 y\n"]),
        drive_of_layouts(&["uint8 X=5\nuint8 x 7\nuint8 y\n", "uint8 y\nuint8 x\n"]),
    ];
    for (paths, layouts, x) in
        [(&[one][..], vec![0, 1, 0], [0.0, 11.0, 2.0]), (&two, vec![0, 0, 1], [0.0, 0.0, 11.0])]
    {
        let (mut replay, memory) = begun(paths, &["/a"]);
        assert!(run(&mut replay).1.is_none());
        let path = FieldPath::compile(&replay.definitions("/a").unwrap(), "x").unwrap();
        let taken = memory.0.lock().unwrap();
        assert!(taken.iter().map(|(meta, _)| meta.layout).eq(layouts));
        let read = taken.iter().map(|(meta, cdr)| {
            path.in_layout(meta.layout).unwrap().number(cdr, meta.endian).unwrap()
        });
        assert!(read.eq(x));
        assert_eq!(replay.topics()[0].other_definitions.len(), 1);
    }
}

#[test]
fn a_path_that_differs_between_layouts_is_refused_with_both() {
    let layouts = ["uint8 x\nuint8 y\n", "uint8 y\nstring x\n", "uint8 y\nuint8 z\n"];
    let drive = drive_of_layouts(&layouts);
    let definitions = Replay::open(&[drive]).unwrap().definitions("/a").unwrap();
    let refused = |path| FieldPath::compile(&definitions, path).unwrap_err().to_string();
    assert_eq!(
        refused("x"),
        "`x` does not mean the same in all layouts of `test_msgs/msg/Number` on this topic: in \
         that with the fields `x`, `y`, it is an integer; in that with the fields `y`, `x`, it is \
         a string"
    );
    let z = refused("z");
    assert!(z.contains("has no field `z`") && z.contains("`y`, `z`, it is an integer"), "{z}");
    // A path that no layout has is refused as with one layout.
    assert!(refused("w").starts_with("type `test_msgs/msg/Number` has no field `w`"));
    FieldPath::compile(&definitions, "y").unwrap();
}

#[test]
fn messages_without_a_known_layout_are_refused_if_there_are_several() {
    let several = ["uint8 x\n", "uint16 x\n", ""];
    for (texts, is_known) in [(&several[..], false), (&several[..2], true), (&several[1..], true)] {
        let replay = Replay::open(&[drive_of_layouts(texts)]).unwrap();
        let found = replay.can_subscribe(&spec("/a"));
        assert_eq!(found.is_ok(), is_known, "{texts:?}: {found:?}");
    }
}

#[test]
fn a_file_that_is_not_a_drive_is_refused_on_open() {
    let refuse = |path| Replay::open(&[path]).err().unwrap();
    assert!(matches!(Replay::open(&[]).err().unwrap(), ReplayError::NoFiles));
    assert!(matches!(refuse("no/such/file".into()), ReplayError::Open { .. }));
    assert!(matches!(refuse(file(b"no drive")), ReplayError::NotMcap { .. }));
    assert!(matches!(refuse(file(b"")), ReplayError::Empty { .. }));
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

#[test]
fn a_part_begins_with_the_latched_samples_that_were_valid() {
    let mut writer = begin();
    let schema = writer.add_schema(TYPE, "ros2msg", b"int64 value\n").unwrap();
    let qos = "- depth: 1\n  durability: transient_local\n".to_owned();
    let qos = [("offered_qos_profiles".to_owned(), qos)].into();
    let map = writer.add_channel(schema, "/map", "cdr", &qos).unwrap();
    let imu = add_channel(&mut writer, "/imu", TEXT);
    // A recorder that does not number its messages.
    for (value, channel) in [map, imu, map, imu, imu, map, imu].into_iter().enumerate() {
        let (at, value) = (100 + 10 * value as u64, value as i64);
        write(&mut writer, channel, &Written { topic: "", at, sequence: 0, value });
    }
    let paths = [file(&finish(writer))];
    let part = |from, latched: bool| {
        let mut replay = Replay::open(&paths).unwrap();
        replay.restrict(from, i64::MAX);
        if latched {
            replay.begin_with_latched(&paths, &DriveOptions::default());
        }
        let memory = listen(&mut replay, &["/imu", "/map"]);
        let first = replay.peek_at_ns().unwrap();
        assert!(run(&mut replay).1.is_none());
        let taken = memory.0.lock().unwrap();
        let times: Vec<_> = taken.iter().map(|(meta, _)| meta.publish_ns).collect();
        let map = taken.iter().filter(|(_, cdr)| [0, 2, 5].contains(&cdr[0]));
        let numbers: Vec<_> = map.map(|(meta, _)| (meta.at_ns, meta.seq)).collect();
        (first, times, numbers)
    };
    let expected = (Some(135), vec![101, 121, 141, 151, 161], vec![(135, 1), (135, 2), (150, 3)]);
    assert_eq!(part(135, true), expected);
    assert_eq!(part(135, false), (Some(140), vec![141, 151, 161], vec![(150, 1)]));
    assert_eq!(part(100, true).1, [101, 111, 121, 131, 141, 151, 161]);
    assert_eq!(part(0, true).1.len(), 7);
}

#[test]
fn a_definition_with_another_hash_than_the_channel_states_is_refused() {
    // Published by ROS 2 for `std_msgs/msg/String`.
    let hash = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
    let string = "std_msgs/msg/String";
    for (text, is_right) in [("# a text\nstring data", true), ("string data\nint8 more", false)] {
        let mut writer = begin();
        let schema = writer.add_schema(string, "ros2msg", text.as_bytes()).unwrap();
        let stated = [("topic_type_hash".to_owned(), hash.to_owned())].into();
        let channel = writer.add_channel(schema, "/a", "cdr", &stated).unwrap();
        write(&mut writer, channel, &ticking(&["/a"], 1, 100)[0]);
        let replay = Replay::open(&[file(&finish(writer))]).unwrap();
        let spec = TopicSpec { type_name: string.to_owned(), ..spec("/a") };
        match replay.can_subscribe(&spec) {
            Ok(()) => assert!(is_right, "{text}"),
            Err(refused) => assert!(!is_right && refused.to_string().contains("type hash")),
        }
    }
}

#[test]
fn a_channel_without_messages_costs_its_topic_nothing() {
    let mut writer = begin();
    let idl = writer.add_schema(TYPE, "ros2idl", b"struct Number {};").unwrap();
    writer.add_channel(idl, "/a", "json", &BTreeMap::new()).unwrap();
    add_channel(&mut writer, "/a", "string value\n");
    let channel = add_channel(&mut writer, "/a", TEXT);
    write(&mut writer, channel, &ticking(&["/a"], 1, 100)[0]);
    let (mut replay, _) = begun(&[file(&finish(writer))], &["/a"]);
    assert_eq!(run(&mut replay).0.len(), 1);
    FieldPath::compile(&replay.definitions("/a").unwrap(), "value").unwrap();
    assert!(replay.topics()[0].other_definitions.is_empty());
}
