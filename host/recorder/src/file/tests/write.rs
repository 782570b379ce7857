use std::collections::BTreeMap;
use std::fs::{self, OpenOptions};

use gleaner_base::Explain;
use gleaner_journal::FileDigest;
use gleaner_lambda::Clip;
use gleaner_messages::Endian;
use gleaner_messages::transport::{Guid, SampleMeta, Transport};

use super::super::clip_dir::PART;
use super::super::sink::FileSink;
use super::super::unfinished::METADATA_MAX;
use super::super::{ClipTrailer, MESSAGE_MAX, UnfinishedClip};
use super::*;
use crate::error::RecordError;

fn named<'a>(
    records: &'a [(String, BTreeMap<String, String>)],
    name: &'a str,
) -> impl Iterator<Item = &'a BTreeMap<String, String>> {
    records.iter().filter(move |(of, _)| of == name).map(|(_, metadata)| metadata)
}

#[test]
fn a_clip_reads_back_byte_for_byte() {
    let scratch = TestDir::new();
    let (mut folder, found) = scratch.open();
    assert!(found.is_empty());
    let mut clip = folder.begin("hello-1", &clip_header()).unwrap();
    let other = Guid(*b"a second writer!");
    let messages = [
        (imu(), meta(10 * SECOND, 1), payload(1)),
        (
            camera(),
            SampleMeta { endian: Endian::Big, options: [3, 4], ..meta(11 * SECOND, 5) },
            vec![7; 3 << 20],
        ),
        (imu(), SampleMeta { writer: other, ..meta(12 * SECOND, 1) }, payload(2)),
        (imu(), meta(13 * SECOND, 2), Vec::new()),
    ];
    for (topic, meta, cdr) in &messages {
        clip.message(topic, meta, cdr).unwrap();
    }
    let clip = clip.finish(trailer()).unwrap();
    let path = scratch.path("clips/hello-1.mcap");
    let file = fs::read(&path).unwrap();
    assert_eq!(clip.bytes, file.len() as u64);

    let back = replayed(&path);
    assert_eq!(back.len(), messages.len());
    for ((topic, meta, cdr), (found_topic, found_meta, found_cdr)) in messages.iter().zip(&back) {
        assert_eq!(topic, found_topic);
        assert_eq!(cdr, found_cdr);
        assert_eq!(meta, found_meta);
    }

    let read: Vec<_> = mcap::MessageStream::new(&file).unwrap().map(Result::unwrap).collect();
    assert_eq!(read.len(), messages.len());
    for ((topic, meta, cdr), found) in messages.iter().zip(&read) {
        let endian = u8::from(meta.endian == Endian::Little);
        let [first, second] = meta.options;
        assert_eq!(*found.data, [&[0, endian, first, second], cdr.as_slice()].concat());
        assert_eq!(found.log_time, meta.at_ns as u64);
        assert_eq!(found.publish_time, meta.publish_ns as u64);
        assert_eq!(u64::from(found.sequence), meta.seq);
        assert_eq!(found.channel.topic, topic.name);
        assert_eq!(found.channel.message_encoding, "cdr");
        assert_eq!(found.channel.metadata["gleaner.writer"], meta.writer.to_string());
        assert_eq!(found.channel.metadata.get("offered_qos_profiles"), topic.offered_qos.as_ref());
        let schema = found.channel.schema.as_ref().unwrap();
        assert_eq!((&schema.name, schema.encoding.as_str()), (&topic.type_name, "ros2msg"));
        assert_eq!(*schema.data, *topic.definitions.as_deref().unwrap_or_default().as_bytes());
    }
}

#[test]
fn a_clip_describes_itself() {
    let (scratch, mut folder) = opened();
    let mut writing = begun(&mut folder, "hello-1", 8);
    writing.message(&camera(), &meta(12 * SECOND, 1), &[1]).unwrap();
    let clip = writing.finish(trailer()).unwrap();
    assert_eq!(scratch.listed(), std::slice::from_ref(&clip));
    assert_eq!(scratch.files(), ["hello-1.jpg", "hello-1.mcap"]);
    assert_eq!(fs::read(scratch.path("clips/hello-1.jpg")).unwrap(), b"a picture");
    assert_eq!(clip.file.to_str(), Some("clips/hello-1.mcap"));
    assert_eq!(clip.thumbnail.as_deref().and_then(|path| path.to_str()), Some("clips/hello-1.jpg"));
    assert_eq!((clip.from_ns, clip.to_ns), (10 * SECOND, 20 * SECOND));
    assert_eq!((clip.first_ns, clip.last_ns), (Some(10 * SECOND), Some(12 * SECOND)));
    assert_eq!((clip.triggers, clip.moments.len(), &clip.recovered), (2, 2, &None));
    let topics: Vec<_> =
        clip.topics.iter().map(|t| (t.topic.as_str(), t.messages, t.received, t.lost)).collect();
    assert_eq!(
        topics,
        [("/imu/data", 8, Some(9), None), ("/gone", 0, Some(0), None), ("/camera", 1, None, None)]
    );
    assert_eq!(clip.topics[1].type_name, None);

    let file = fs::read(scratch.path("clips/hello-1.mcap")).unwrap();
    let records = metadata(&file);
    assert_eq!(records[0].0, "gleaner.begin");
    assert_eq!(records[0].1["clock"], "log time of the drive");
    let clip_header = named(&records, "gleaner.clip").next().unwrap();
    assert_eq!(clip_header["incomplete"], "the drive ended 2.1 s before the window did");
    assert_eq!(clip_header["file"], "clips/hello-1.mcap");
    let line: Clip = serde_json::from_str(&clip_header["line"]).unwrap();
    assert_eq!(Clip { bytes: clip.bytes, ..line }, clip);
    let topics: Vec<_> = named(&records, "gleaner.topic").collect();
    assert_eq!((topics[0]["topic"].as_str(), topics[0]["lost"].as_str()), ("/imu/data", "unknown"));
    assert_eq!((topics[1]["type"].as_str(), topics[1]["messages"].as_str()), ("unknown", "0"));
    let lambda = named(&records, "gleaner.lambda").next().unwrap();
    assert_eq!((lambda["name"].as_str(), lambda["kind"].as_str()), ("hello", "wasm"));
    let decisions: Vec<_> = named(&records, "gleaner.decision").collect();
    assert_eq!(decisions[0]["score"], "0.5");
    assert!(!decisions[1].contains_key("score"));

    let summary = mcap::Summary::read(&file).unwrap().unwrap();
    let attachments = summary
        .attachment_indexes
        .iter()
        .map(|index| mcap::read::attachment(&file, index).unwrap());
    let attachments: Vec<_> =
        attachments.map(|a| (a.name, a.media_type, a.data.into_owned())).collect();
    let journal = (
        "journal/hello.journal".to_owned(),
        "application/octet-stream".to_owned(),
        b"a journal".to_vec(),
    );
    let thumbnail = ("thumbnail.jpg".to_owned(), "image/jpeg".to_owned(), b"a picture".to_vec());
    assert_eq!(attachments, [journal, thumbnail]);
}

#[test]
fn the_line_of_a_clip_keeps_a_hundred_moments_and_the_file_all() {
    let (scratch, mut folder) = opened();
    let moments = (0..300).map(moment).collect();
    let long = ClipTrailer { moments, triggers: 500, ..trailer() };
    let clip = begun(&mut folder, "many", 0).finish(long).unwrap();
    assert_eq!((clip.moments.len(), clip.triggers), (Clip::MOMENTS_MAX, 500));
    let records = metadata(&fs::read(scratch.path("clips/many.mcap")).unwrap());
    assert_eq!(named(&records, "gleaner.decision").count(), 300);
}

#[test]
fn a_clip_describes_a_lambda_by_its_journal() {
    let (scratch, mut folder) = opened();
    let mut header = journal_header("hello");
    header.config.insert("limit".to_owned(), 3.into());
    let model =
        |path: &str| FileDigest { path: path.to_owned(), bytes: 5, sha256: "ff".to_owned() };
    header.models = vec![model("a.onnx"), model("b.onnx")];
    let known = ClipTrailer { headers: vec![header.into()], ..trailer() };
    begun(&mut folder, "a", 0).finish(known).unwrap();
    begun(&mut folder, "b", 0).finish(trailer()).unwrap();
    let values = |name: &str| {
        let records = metadata(&fs::read(scratch.path(name)).unwrap());
        let lambdas: Vec<_> = named(&records, "gleaner.lambda").cloned().collect();
        let [lambda] = &lambdas[..] else { panic!("{lambdas:?}") };
        ["config", "engine", "gleaner", "models", "kind", "windows"].map(|key| lambda[key].clone())
    };
    let known = [r#"{"limit":3}"#, "Python", "0.1.0", "a.onnx=ff, b.onnx=ff", "wasm", "1"];
    assert_eq!(values("clips/a.mcap"), known);
    assert_eq!(values("clips/b.mcap"), ["unknown", "unknown", "unknown", "unknown", "wasm", "1"]);
}

#[test]
fn a_topic_without_a_message_still_has_a_channel() {
    let (scratch, mut folder) = opened();
    let mut clip = begun(&mut folder, "a", 3);
    let large = TopicSchema { definitions: Some("#".repeat(1 << 20).into()), ..camera() };
    for topic in [imu(), large.clone(), TopicSchema { name: "/second".to_owned(), ..imu() }] {
        clip.declare(&topic).unwrap();
    }
    let clip = clip.finish(trailer()).unwrap();
    assert_eq!(clip.topics.iter().map(|topic| topic.messages).collect::<Vec<_>>(), [3, 0, 0, 0]);
    let path = scratch.path("clips/a.mcap");
    let file = fs::read(&path).unwrap();
    let channels = mcap::Summary::read(&file).unwrap().unwrap().channels;
    let mut found: Vec<_> = channels
        .values()
        .map(|c| (c.topic.as_str(), c.metadata.keys().cloned().collect()))
        .collect();
    found.sort();
    let qos = || vec!["offered_qos_profiles".to_owned()];
    let writer = || vec!["gleaner.writer".to_owned()];
    assert_eq!(
        found,
        [("/camera", vec![]), ("/imu/data", [writer(), qos()].concat()), ("/second", qos())]
    );
    let seen = channels.values().find(|channel| channel.topic == "/camera").unwrap();
    assert_eq!(seen.schema.as_ref().unwrap().data.len(), 1 << 20);
    assert_eq!(replayed(&path).len(), 3);
    let replay = gleaner_drives::Replay::open(std::slice::from_ref(&path)).unwrap();
    let mut names: Vec<_> = replay.topics().into_iter().map(|topic| topic.topic).collect();
    names.sort();
    assert_eq!(names, ["/camera", "/imu/data", "/second"]);
}

#[test]
fn a_message_or_record_that_is_too_large_is_refused() {
    let (_scratch, mut folder) = opened();
    let mut clip = folder.begin("a", &clip_header()).unwrap();
    // Zeroed pages that are never touched take no memory.
    let huge = vec![0; MESSAGE_MAX + 1];
    let error = clip.message(&imu(), &meta(stamp(0), 1), &huge).unwrap_err();
    assert!(matches!(&error, RecordError::TooLarge { what: "a message", .. }), "{error:?}");
    add(&mut clip, 0, 3);
    assert_eq!(clip.finish(trailer()).unwrap().topics[0].messages, 3);
    let header = |bytes: usize| {
        let mut header = journal_header("hello");
        header.config.insert("text".to_owned(), "x".repeat(bytes).into());
        ClipTrailer { headers: vec![header.into()], ..trailer() }
    };
    begun(&mut folder, "b", 0).finish(header(1 << 20)).unwrap();
    let error = begun(&mut folder, "c", 0).finish(header(METADATA_MAX)).unwrap_err();
    assert!(matches!(&error, RecordError::TooLarge { what: "a metadata record", .. }), "{error:?}");
}

#[test]
fn a_chunk_spans_a_second_at_most() {
    let (scratch, mut folder) = opened();
    begun(&mut folder, "a", 41).finish(trailer()).unwrap();
    let file = fs::read(scratch.path("clips/a.mcap")).unwrap();
    let chunks = mcap::Summary::read(&file).unwrap().unwrap().chunk_indexes;
    // Five messages fit in a second, both ends included.
    assert_eq!(chunks.len(), 9);
    let spans = chunks.iter().map(|chunk| chunk.message_end_time - chunk.message_start_time);
    assert!(spans.max() <= Some(SECOND as u64));
}

#[test]
fn stamps_before_the_epoch_become_the_epoch() {
    let (scratch, mut folder) = opened();
    let mut clip = folder.begin("a", &clip_header()).unwrap();
    clip.message(&imu(), &SampleMeta { publish_ns: -5, ..meta(3, 1) }, &[]).unwrap();
    clip.finish(trailer()).unwrap();
    assert_eq!(replayed(&scratch.path("clips/a.mcap"))[0].1.publish_ns, 0);
}

#[test]
fn more_writers_than_channels_share_one_and_no_message_is_lost() {
    let (scratch, mut folder) = opened();
    let mut clip = folder.begin("a", &clip_header()).unwrap();
    let writers = super::super::unfinished::CHANNELS_MAX as u64 + 3;
    for n in 0..writers {
        let mut writer = Guid([0; 16]);
        writer.0[..8].copy_from_slice(&n.to_le_bytes());
        clip.message(&imu(), &SampleMeta { writer, ..meta(10 * SECOND, 1) }, &payload(n)).unwrap();
    }
    assert_eq!(clip.finish(trailer()).unwrap().topics[0].messages, writers);
    let file = fs::read(scratch.path("clips/a.mcap")).unwrap();
    let channels = mcap::Summary::read(&file).unwrap().unwrap().channels;
    let nameless: Vec<_> =
        channels.values().filter(|c| !c.metadata.contains_key("gleaner.writer")).collect();
    assert_eq!((channels.len() as u64, nameless.len()), (writers - 2, 1));
    assert_eq!(replayed(&scratch.path("clips/a.mcap")).len() as u64, writers);
}

/// `/dev/full` rejects every write.
#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_is_reported_and_nothing_is_written_after_it() {
    let (scratch, folder) = opened();
    let path = scratch.path("clips/a.mcap.part");
    let full = || FileSink::new(OpenOptions::new().write(true).open("/dev/full").unwrap(), false);
    let dir = std::sync::Arc::clone(&folder.dir);
    let begun =
        UnfinishedClip::begin(dir, "a".to_owned(), path.clone(), full(), Some(&clip_header()));
    let error = begun.err().expect("the disk is full");
    let help = "make room on the disk, or choose another folder: --out DIR";
    assert_eq!(error.help().as_deref(), Some(help));
    let RecordError::Write { path: named, .. } = error else { panic!("{error:?}") };
    assert_eq!(named, path);

    let mut sink = full();
    std::io::Write::write_all(&mut sink, b"some").unwrap();
    let full = std::io::Write::flush(&mut sink).unwrap_err();
    assert_eq!(full.kind(), std::io::ErrorKind::StorageFull);
    let again = std::io::Write::write_all(&mut sink, b"more").unwrap_err();
    assert_eq!(again.to_string(), "an earlier write to this file failed");
    assert!(scratch.listed().is_empty());
    assert!(!scratch.path(&format!("clips/a{PART}")).exists());
}
