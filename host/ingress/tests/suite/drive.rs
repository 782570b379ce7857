//! A drive that is played as a live source.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use gleaner_drives::{DriveOptions, DrivePlayer};
use gleaner_messages::transport::StoredMeta;
use gleaner_messages::transport::clock::Clock;
use gleaner_protocol::ingress::{IngressReport, PublishGrant, RefusedTopic, TopicGrant};
use mcap::WriteOptions;
use mcap::records::MessageHeader;
use tempfile::TempDir;

use crate::support::{Reading, RunningIngress, TEXT, TIMEOUT, TYPE, grant};

const MESSAGES: u32 = 300;
const STEP_NS: u64 = 1_000_000;
const FIRST_NS: u64 = 1_700_000_000_000_000_000;

/// Writes a drive with two topics; the sequence number of `/even` has a gap.
fn drive(folder: &Path) -> PathBuf {
    let options = WriteOptions::new().profile("ros2").chunk_size(Some(2000));
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    let schema = writer.add_schema(TYPE, "ros2msg", TEXT.as_bytes()).unwrap();
    let qos = BTreeMap::from([("offered_qos_profiles".to_owned(), "- depth: 3".to_owned())]);
    let channels =
        ["/even", "/odd"].map(|topic| writer.add_channel(schema, topic, "cdr", &qos).unwrap());
    for n in 0..MESSAGES {
        let at = FIRST_NS + u64::from(n) * STEP_NS;
        let header = MessageHeader {
            channel_id: channels[n as usize % 2],
            sequence: n / 2 + if n > 20 { 5 } else { 1 },
            log_time: at,
            publish_time: at - 400,
        };
        let mut data = vec![0, 1, 0, 0];
        data.extend(i64::from(n).to_le_bytes());
        writer.write_to_known_channel(&header, &data).unwrap();
    }
    writer.finish().unwrap();
    let path = folder.join("drive.mcap");
    std::fs::write(&path, writer.into_inner().into_inner()).unwrap();
    path
}

fn player(folder: &TempDir, rate: f64) -> DrivePlayer {
    let clock = Clock::from_time_of_day();
    DrivePlayer::open(&[drive(folder.path())], &DriveOptions::default(), clock, rate).unwrap()
}

fn all(topic: &str) -> TopicGrant {
    TopicGrant { depth: 1024, ..grant(0, topic) }
}

fn ended(ingress: &RunningIngress) {
    ingress.report(|report| matches!(report, IngressReport::DriveEnded).then_some(()));
}

/// Returns sequence number and value of all samples.
fn values(reading: &mut Reading) -> Vec<(u64, i64)> {
    let value = |bytes: Vec<u8>| i64::from_le_bytes(bytes.try_into().unwrap());
    reading.new_samples().into_iter().map(|(seq, bytes)| (seq, value(bytes))).collect()
}

#[test]
fn every_message_is_delivered_once_in_order() {
    let folder = TempDir::new().unwrap();
    let mut ingress = RunningIngress::over(player(&folder, 1.0));
    let mut even = ingress.reading("even", all("/even"));
    assert_eq!(even.topic.info.definitions.as_deref(), Some(TEXT.trim()));
    assert_eq!(even.topic.info.offered_qos.as_deref(), Some("- depth: 3"));
    let untyped = TopicGrant { type_name: None, max_bytes: None, ..all("/odd") };
    let mut odd = ingress.reading("odd", untyped);
    assert_eq!(odd.topic.info.type_name, TYPE);
    assert_eq!(even.topic.reader.head(), 0, "it waits for the start");
    let before = Clock::from_time_of_day().now();
    ingress.control().begin().unwrap();
    ended(&ingress);
    let took = Clock::from_time_of_day().now() - before;
    assert!(took >= i64::from(MESSAGES - 1) * STEP_NS as i64, "in real time: {took} ns");
    let expected = |first: u32| -> Vec<(u64, i64)> {
        let of_it = (0..MESSAGES).filter(|n| n % 2 == first);
        of_it.map(|n| (u64::from(n / 2 + if n > 20 { 5 } else { 1 }), n.into())).collect()
    };
    let stamps: Vec<_> = (0..u64::from(MESSAGES / 2))
        .map(|at| StoredMeta::of_words(even.topic.reader.get(at).unwrap().unwrap().meta()).sample)
        .collect();
    assert!(stamps.is_sorted_by_key(|sample| sample.at_ns));
    assert!(stamps.iter().all(|sample| sample.at_ns - sample.publish_ns == 400));
    assert!(stamps[0].at_ns >= before && stamps[0].at_ns < before + TIMEOUT.as_nanos() as i64);
    assert!(stamps.iter().all(|sample| sample.writer == stamps[0].writer));
    assert_eq!(values(&mut even), expected(0));
    assert_eq!(values(&mut odd), expected(1));
}

#[test]
fn a_drive_has_only_its_own_topics() {
    let folder = TempDir::new().unwrap();
    let mut ingress = RunningIngress::over(player(&folder, 1.0));
    let other = TopicGrant { type_name: Some("a/msg/B".to_owned()), ..grant(1, "/odd") };
    let untyped = TopicGrant { type_name: None, ..grant(2, "/eve") };
    let mut feed = ingress.reader("one", vec![grant(0, "/eve"), other, untyped]);
    let known = vec!["/even".to_owned(), "/odd".to_owned()];
    let nearest = Some("/even".to_owned());
    let missing = RefusedTopic::NoSuchTopic { known, nearest };
    for (id, expected) in [
        (0, missing.clone()),
        (1, RefusedTopic::WrongType { found: TYPE.to_owned() }),
        (2, missing),
    ] {
        match feed.topic(id, TIMEOUT) {
            Err(gleaner_samples::FeedError::Refused { reason, .. }) => assert_eq!(reason, expected),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn a_reader_may_join_while_the_drive_plays() {
    let folder = TempDir::new().unwrap();
    let mut ingress = RunningIngress::over(player(&folder, 0.2));
    let mut first = ingress.reading("first", all("/even"));
    ingress.control().begin().unwrap();
    crate::support::wait_for(|| (first.topic.reader.head() > 5).then_some(()));
    let larger = TopicGrant { max_bytes: Some(5000), ..all("/even") };
    let mut late = ingress.reading("late", larger);
    let mut other = ingress.reader("other", vec![all("/odd")]);
    let refused = other.topic(0, TIMEOUT).unwrap_err().to_string();
    assert_eq!(refused, "topic `/odd` was subscribed after the replay started");
    ended(&ingress);
    let (first, late) = (values(&mut first), values(&mut late));
    assert_eq!(first.len() as u32, MESSAGES / 2);
    assert!(!late.is_empty() && first.ends_with(&late), "{} of {}", late.len(), first.len());
}

#[test]
fn what_a_reader_publishes_reaches_the_other_readers() {
    let folder = TempDir::new().unwrap();
    let mut ingress = RunningIngress::over(player(&folder, 1.0));
    let grants = ["/even", "/result"].map(|topic| PublishGrant {
        topic: topic.to_owned(),
        type_name: TYPE.to_owned(),
        depth: 1,
        max_bytes: 64,
    });
    let publisher = ingress.publisher("publishes", grants.into());
    let mut result = ingress.reading("reads", grant(0, "/result"));
    let mut even = ingress.reading("reads, too", grant(0, "/even"));
    publisher.publisher(1).publish(&[1; 4]).unwrap();
    publisher.publisher(0).publish(&[2; 4]).unwrap();
    let found = crate::support::collect(1, || result.new_samples());
    assert_eq!(found, [(1, vec![1; 4])]);
    assert_eq!(crate::support::collect(1, || even.new_samples()), [(1, vec![2; 4])]);
    ingress.control().begin().unwrap();
    ended(&ingress);
    assert_eq!(even.topic.reader.head(), 1 + u64::from(MESSAGES / 2));
}

#[test]
fn a_damaged_drive_ends_with_its_reason() {
    let folder = TempDir::new().unwrap();
    let path = drive(folder.path());
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let clock = Clock::from_time_of_day();
    let options = DriveOptions::default();
    let player = DrivePlayer::open(&[path], &options, clock, 1.0).unwrap();
    let mut ingress = RunningIngress::over(player);
    let mut even = ingress.reading("even", all("/even"));
    ingress.control().begin().unwrap();
    let status = ingress.status(|status| status.health.dead.is_some());
    ended(&ingress);
    assert!(status.health.dead.unwrap().contains("drive.mcap"));
    let found = values(&mut even);
    assert!(!found.is_empty() && (found.len() as u32) < MESSAGES / 2);
}

#[test]
fn an_ingress_ends_while_its_drive_plays() {
    let folder = TempDir::new().unwrap();
    let mut ingress = RunningIngress::over(player(&folder, 1e-9));
    let _reading = ingress.reading("even", all("/even"));
    ingress.control().begin().unwrap();
    ingress.end();
}
