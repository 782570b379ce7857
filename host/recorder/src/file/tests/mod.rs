//! Tests of clips: written, read back by two readers, torn at every byte, and recovered.

mod folder;
mod recover;
mod sign;
mod write;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

use gleaner_journal::{JournalHeader, JournalInput};
use gleaner_lambda::manifest::LambdaKind;
use gleaner_lambda::{Clip, ClipLambda, Moment, Recovered, TriggerKind};
use gleaner_messages::transport::{Guid, SampleMeta};

use super::{
    ClipHeader, ClipTopicCounts, ClipTrailer, RecordingFolder, TopicSchema, UnfinishedClip,
};

/// Returns a folder of clips, and the test's folder that has it.
fn opened() -> (TestDir, RecordingFolder) {
    let scratch = TestDir::new();
    let (folder, _) = scratch.open();
    (scratch, folder)
}

/// Begins a clip, with messages `0..messages` of the IMU.
fn begun(folder: &mut RecordingFolder, base: &str, messages: u64) -> UnfinishedClip {
    let mut clip = folder.begin(base, &clip_header()).unwrap();
    add(&mut clip, 0, messages);
    clip
}

fn record(folder: &mut RecordingFolder, base: &str) -> Clip {
    begun(folder, base, 6).finish(trailer()).unwrap()
}

/// A folder for one test, removed when the test ends.
pub struct TestDir(pub PathBuf);

impl TestDir {
    pub fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let name = format!("gleaner-recorder-{}-{count}", std::process::id());
        let folder = std::env::temp_dir().join(name);
        fs::create_dir_all(&folder).unwrap();
        Self(folder)
    }

    fn path(&self, relative: &str) -> PathBuf {
        self.0.join(relative)
    }

    fn open(&self) -> (RecordingFolder, Vec<Clip>) {
        RecordingFolder::open(&self.0).unwrap()
    }

    fn listed(&self) -> Vec<Clip> {
        let text = fs::read_to_string(self.path("clips.jsonl")).unwrap_or_default();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    /// Returns the names in the folder of clips, sorted, without the lock.
    fn files(&self) -> Vec<String> {
        let entries = fs::read_dir(self.path("clips")).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<_> = names.filter(|name| name != ".lock").collect();
        names.sort();
        names
    }
}

impl Drop for TestDir {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// Returns all metadata records of a finished clip, read by the `mcap` crate.
pub fn metadata(file: &[u8]) -> Vec<(String, BTreeMap<String, String>)> {
    let records = mcap::read::LinearReader::new(file).unwrap();
    let metadata = records.filter_map(|record| match record.unwrap() {
        mcap::records::Record::Metadata(metadata) => Some((metadata.name, metadata.metadata)),
        _ => None,
    });
    metadata.collect()
}

/// The header of a lambda that records.
pub fn journal_header(name: &str) -> JournalHeader {
    let input = JournalInput {
        name: "numbers".to_owned(),
        topic: "/a".to_owned(),
        wire_topic: "/a".to_owned(),
        type_name: "test_msgs/msg/Number".to_owned(),
    };
    JournalHeader {
        gleaner: "0.1.0".to_owned(),
        engine: "Python".to_owned(),
        machine: "x".to_owned(),
        lambda: name.to_owned(),
        version: "1.2.3".to_owned(),
        kind: LambdaKind::Python,
        inputs: vec![input],
        event_input: Some(0),
        clock: "log time of the drive".to_owned(),
        ..JournalHeader::default()
    }
}

const SECOND: i64 = 1_000_000_000;

fn lambda() -> ClipLambda {
    let (name, version, digest) = ("hello".to_owned(), "0.1.0".to_owned(), "ab".repeat(32));
    ClipLambda { name, version, kind: LambdaKind::Wasm, digest, windows: 1 }
}

fn moment(at_ns: i64) -> Moment {
    let (lambda, label) = ("hello".to_owned(), "hard-brake".to_owned());
    Moment {
        lambda,
        kind: TriggerKind::Event,
        label,
        score: Some(0.5),
        attributes: Some(serde_json::Map::new()),
        at_ns,
        source: None,
    }
}

fn clip_header() -> ClipHeader {
    let clock = "log time of the drive".to_owned();
    ClipHeader { clock, from_ns: 10 * SECOND, lambdas: vec![lambda()], moment: moment(12 * SECOND) }
}

fn imu() -> TopicSchema {
    TopicSchema {
        name: "/imu/data".to_owned(),
        type_name: "sensor_msgs/msg/Imu".to_owned(),
        definitions: Some("float64 x".into()),
        offered_qos: Some("- history: 3".to_owned()),
        ..TopicSchema::default()
    }
}

fn camera() -> TopicSchema {
    let (name, type_name) = ("/camera".to_owned(), "sensor_msgs/msg/Image".to_owned());
    TopicSchema { name, type_name, ..TopicSchema::default() }
}

fn meta(at_ns: i64, seq: u64) -> SampleMeta {
    let writer = Guid(*b"a writer of imus");
    SampleMeta { publish_ns: at_ns - 7, ..SampleMeta::new(at_ns, writer, seq) }
}

/// Returns the payload of message `n`; no two are equal.
fn payload(n: u64) -> Vec<u8> {
    [&n.to_le_bytes()[..], &[n as u8; 13]].concat()
}

fn trailer() -> ClipTrailer {
    ClipTrailer {
        from_ns: 10 * SECOND,
        to_ns: 20 * SECOND,
        lambdas: vec![lambda()],
        triggers: 2,
        moments: vec![moment(12 * SECOND), Moment { score: None, ..moment(13 * SECOND) }],
        topics: vec![
            ClipTopicCounts {
                topic: "/imu/data".to_owned(),
                type_name: Some("sensor_msgs/msg/Imu".to_owned()),
                received: Some(9),
                lost: None,
                overwritten: Some(1),
                too_big: Some(0),
            },
            ClipTopicCounts {
                topic: "/gone".to_owned(),
                received: Some(0),
                ..ClipTopicCounts::default()
            },
        ],
        incomplete: vec!["the drive ended 2.1 s before the window did".to_owned()],
        thumbnail: Some(b"a picture".to_vec()),
        journals: vec![("hello".to_owned(), b"a journal".to_vec())],
        headers: Vec::new(),
    }
}

/// Returns the clip as the next start lists it, if its recorder died before listing it.
fn unlisted(clip: &Clip) -> Clip {
    let note = "the recorder died before it listed this clip; nothing of it is lost".to_owned();
    Clip { recovered: Some(Recovered { lost_bytes: 0, note }), ..clip.clone() }
}

/// Adds messages `from..to` of the IMU, four a second from second 10 on.
fn add(clip: &mut UnfinishedClip, from: u64, to: u64) {
    for n in from..to {
        clip.message(&imu(), &meta(stamp(n), n + 1), &payload(n)).unwrap();
    }
}

fn stamp(n: u64) -> i64 {
    10 * SECOND + n as i64 * SECOND / 4
}

/// Returns the messages of a replay of `path`, in order; the file must be complete.
fn replayed(path: &Path) -> Vec<(TopicSchema, SampleMeta, Vec<u8>)> {
    let mut all = Vec::new();
    let end = super::read::each_message(path, |topic, meta, cdr| {
        all.push((topic.clone(), *meta, cdr.to_vec()));
        Ok(())
    });
    assert!(end.unwrap().is_none(), "{} is incomplete", path.display());
    all
}

/// Returns the numbers of the messages in `path`, as [`add`] wrote them.
fn numbers(path: &Path) -> Vec<u64> {
    let number = |(_, meta, cdr): (TopicSchema, SampleMeta, Vec<u8>)| {
        let n = u64::from_le_bytes(*cdr.first_chunk().unwrap());
        assert_eq!((cdr, meta.at_ns, meta.seq), (payload(n), stamp(n), n + 1));
        n
    };
    replayed(path).into_iter().map(number).collect()
}
