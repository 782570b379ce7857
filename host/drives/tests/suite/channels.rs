//! Tests metadata of channels: the writer of their messages, and the offered QoS.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use gleaner_drives::{Damage, Replay, ReplayError, ReplayStep};
use gleaner_messages::transport::{DiscoveredTopic, Guid, Transport};

use crate::support::{
    MAGIC, TEXT, TYPE, Written, add_channel, begin, begun, file, finish, record, run, run_whole,
    spec, text, write, write_data,
};

const CLAIM: &str = "00112233445566778899aabbccddeeff";

/// A channel to write: its topic, and one pair of metadata.
type ChannelSpec<'a> = (&'static str, &'a str, &'a str);

/// Creates a drive with two messages on each of `channels`, in turn, all numbered 1 and 2.
fn drive_of(channels: &[ChannelSpec<'_>], first: u64) -> PathBuf {
    let mut writer = begin();
    let schema = writer.add_schema(TYPE, "ros2msg", TEXT.as_bytes()).unwrap();
    let ids: Vec<u16> = channels
        .iter()
        .enumerate()
        .map(|(n, (topic, key, value))| {
            // The MCAP writer merges equal channels; these must differ.
            let metadata =
                [("n".to_owned(), n.to_string()), (key.to_string(), value.to_string())].into();
            writer.add_channel(schema, topic, "cdr", &metadata).unwrap()
        })
        .collect();
    for sequence in [1, 2] {
        for (n, (id, (topic, ..))) in ids.iter().zip(channels).enumerate() {
            let at = first + u64::from(sequence) * 1000 + n as u64;
            write(&mut writer, *id, &Written { topic, at, sequence, value: n as i64 });
        }
    }
    file(&finish(writer))
}

fn steps(paths: &[PathBuf], topics: &[&str]) -> Vec<ReplayStep> {
    let (mut replay, _) = begun(paths, topics);
    run_whole(&mut replay)
}

/// Returns the writers in the order of their first message, and checks that the numbers of each
/// increase.
fn writers(steps: &[ReplayStep]) -> Vec<String> {
    let mut last = BTreeMap::new();
    let mut order = Vec::new();
    for step in steps {
        let seq = last.insert((step.subscription, step.meta.writer), step.meta.seq);
        assert!(seq.unwrap_or(0) < step.meta.seq, "{} fell back", step.meta.writer);
        let name = step.meta.writer.to_string();
        if !order.contains(&name) {
            order.push(name);
        }
    }
    order
}

fn made_up(file: u32, channel: u32) -> String {
    format!("6d636170{file:08x}{channel:08x}00000000")
}

#[test]
fn a_message_keeps_the_options_of_its_encapsulation() {
    let mut writer = begin();
    let channel = add_channel(&mut writer, "/a", TEXT);
    for (endian, log_time) in [(0, 1), (1, 2)] {
        write_data(&mut writer, channel, log_time, &[0, endian, 7, 9, 0, 0, 0, 0, 0, 0, 0, 0]);
    }
    let steps = steps(&[file(&finish(writer))], &["/a"]);
    assert!(steps.iter().map(|step| step.meta.options).eq([[7, 9]; 2]));
}

#[test]
fn a_channel_names_the_writer_of_its_messages() {
    let other = CLAIM.replace('0', "7");
    let key = "gleaner.writer";
    let path = drive_of(
        &[("/a", key, CLAIM), ("/a", key, &other), ("/a", "writer", CLAIM), ("/b", key, CLAIM)],
        0,
    );
    let steps = steps(&[path], &["/a", "/b"]);
    assert_eq!(writers(&steps), [CLAIM, &other, &made_up(0, 3)]);
    assert_eq!(Guid::from_hex(CLAIM), Some(steps[0].meta.writer));
    // A writer of two topics counts for each of them.
    assert!(steps.iter().map(|step| step.meta.seq).eq([1, 1, 1, 1, 2, 2, 2, 2]));
}

#[test]
fn a_name_that_is_not_32_lower_case_hex_digits_is_ignored() {
    let upper = CLAIM.to_uppercase();
    for name in
        ["", "0x112233", &CLAIM[1..], &format!("{CLAIM}0"), &format!(" {}", &CLAIM[1..]), &upper]
    {
        let path = drive_of(&[("/a", "gleaner.writer", name)], 0);
        assert_eq!(writers(&steps(&[path], &["/a"])), [made_up(0, 1)], "{name}");
    }
}

#[test]
fn a_second_channel_of_a_topic_cannot_claim_the_same_writer() {
    let claim = ("/a", "gleaner.writer", CLAIM);
    let steps = steps(&[drive_of(&[claim, claim, claim], 0)], &["/a"]);
    assert_eq!(writers(&steps), [CLAIM.to_owned(), made_up(0, 2), made_up(0, 3)]);
    assert!(steps.iter().map(|step| step.meta.seq).eq([1, 1, 1, 2, 2, 2]));
}

#[test]
fn a_generated_writer_differs_from_claimed_ones() {
    // Content of clips of drives without writers.
    let (one, two) = (made_up(0, 1), made_up(0, 2));
    let key = "gleaner.writer";
    let path =
        drive_of(&[("/a", "", ""), ("/a", key, &one), ("/a", key, &two), ("/a", key, &two)], 0);
    let found = writers(&steps(&[path], &["/a"]));
    assert_eq!(found.iter().collect::<BTreeSet<_>>().len(), 4);
    assert_eq!(found[1..3], [one.clone(), two]);
    assert_eq!(found[0], one.replace("100000000", "100000001"));
}

#[test]
fn a_writer_continues_its_numbers_in_the_next_file() {
    let claim = ("/a", "gleaner.writer", CLAIM);
    let (first, second) = (drive_of(&[claim], 0), drive_of(&[claim], 500));
    // The times of the two are interleaved.
    let steps = steps(&[first, second], &["/a"]);
    assert_eq!(writers(&steps), [CLAIM]);
    assert!(steps.iter().map(|step| step.meta.seq).eq([1, 2, 3, 4]));
}

#[test]
fn a_topic_has_the_qos_of_its_first_channel_that_has_one() {
    let qos = |paths: &[PathBuf]| {
        let topics = Replay::open(paths).unwrap().topics();
        topics.into_iter().map(|topic| topic.offered_qos).collect::<Vec<_>>()
    };
    let key = "offered_qos_profiles";
    let long = "x".repeat(65 << 10);
    let fits = "y".repeat(64 << 10);
    let first = drive_of(
        &[("/a", "", ""), ("/a", key, ""), ("/a", key, &long), ("/b", key, "- depth: 1\n")],
        0,
    );
    let second =
        drive_of(&[("/a", key, &fits), ("/a", key, "z"), ("/b", key, "z"), ("/c", "", "")], 0);
    assert_eq!(qos(std::slice::from_ref(&first)), [None, Some("- depth: 1\n".to_owned())]);
    assert_eq!(qos(&[first, second]), [Some(fits), Some("- depth: 1\n".to_owned()), None]);
}

#[test]
fn a_stated_hash_of_a_type_is_compared_only_if_it_has_the_form_of_one() {
    /// Of "int64 value", by rosbags.
    const DIGITS: &str = "376752aeb9e256c4e2313368a5a32645d62041d37777621433ea5e52e280b5ea";
    let other = DIGITS.replace('7', "a");
    for (stated, is_read) in [
        (format!("RIHS01_{DIGITS}"), true),
        (format!("RIHS01_{other}"), false),
        // ROS 2 writes small digits, and reads both (rosidl_parse_type_hash_string).
        (format!("RIHS01_{}", DIGITS.to_uppercase()), true),
        (format!("RIHS01_{}", other.to_uppercase()), false),
        // The rest is no hash of this kind, and has no meaning for the definition.
        (String::new(), true),
        (other.clone(), true),
        (format!("rihs01_{other}"), true),
        (format!("RIHS02_{other}"), true),
        (format!("RIHS01_{}", &other[1..]), true),
        (format!("RIHS01_{other}0"), true),
        (format!("RIHS01_{}", other.replace('6', "g")), true),
    ] {
        let drive = drive_of(&[("/a", "topic_type_hash", &stated)], 0);
        let found = Replay::open(&[drive]).unwrap().can_subscribe(&spec("/a"));
        assert_eq!(found.is_ok(), is_read, "{stated}: {found:?}");
    }
}

/// Returns the damage and the topics of a file that ends after one channel, whose record ends with
/// `metadata`.
fn ending(metadata: &[u8]) -> (Damage, Vec<DiscoveredTopic>) {
    let schema = [&1u16.to_le_bytes()[..], &text(TYPE), &text("ros2msg"), &text(TEXT)].concat();
    let channel =
        [&1u16.to_le_bytes()[..], &1u16.to_le_bytes(), &text("/a"), &text("cdr"), metadata]
            .concat();
    let bytes = [&MAGIC[..], &record(3, &schema), &record(4, &channel)].concat();
    let mut replay = Replay::open(&[file(&bytes)]).unwrap();
    let topics = replay.topics();
    match run(&mut replay).1 {
        Some(ReplayError::Damaged { what, .. }) => (what, topics),
        other => panic!("expected damage, got {other:?}"),
    }
}

fn map(pairs: &[u8]) -> Vec<u8> {
    [&(pairs.len() as u32).to_le_bytes()[..], pairs].concat()
}

#[test]
fn a_channel_whose_metadata_is_malformed_is_damage() {
    let pair = [text("key"), text("value")].concat();
    for bad in [
        vec![0; 3],
        u32::MAX.to_le_bytes().to_vec(),
        map(&pair)[..10].to_vec(),
        map(&pair[..pair.len() - 1]),
        map(&text("key")),
        map(&[text("key"), vec![0xff; 4]].concat()),
    ] {
        let (what, topics) = ending(&bad);
        assert!(
            matches!(what, Damage::Malformed("a channel record is malformed")),
            "{bad:?}: {what}"
        );
        assert!(topics.is_empty());
    }
}

#[test]
fn unneeded_metadata_is_skipped() {
    let qos = [text("offered_qos_profiles"), text("- depth: 1")].concat();
    let foreign = [&[2, 0, 0, 0, 0xff, 0xfe][..], &text("value")].concat();
    for (metadata, expected) in [
        (Vec::new(), None),
        (map(&[]), None),
        (map(&[foreign.clone(), qos.clone()].concat()), Some("- depth: 1")),
        ([map(&qos), vec![1, 2, 3]].concat(), Some("- depth: 1")),
        (map(&[qos, text("offered_qos_profiles"), text("second")].concat()), Some("- depth: 1")),
    ] {
        let (what, topics) = ending(&metadata);
        assert!(matches!(what, Damage::NoFooter), "{what}");
        assert_eq!(topics[0].offered_qos.as_deref(), expected);
    }
}
