//! Shared test support: a folder, lambdas, a drive of samples and wakes, and access to clips.
// Each test program uses its own part.
#![allow(dead_code)]

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use gleaner_journal::{InputView, JournalEntry, JournalHeader, JournalInput, JournalReader};
use gleaner_lambda::manifest::{LambdaKind, Manifest, Store};
use gleaner_lambda::{Clip, Trigger, TriggerKind};
use gleaner_recorder::{
    LambdaId, LambdaSpec, Recorder, RecordingFolder, Settings, TopicId, TopicSchema,
};
use gleaner_transport::{Guid, SampleMeta};

pub const MS: i64 = 1_000_000;
pub const S: i64 = 1_000 * MS;
/// 2018-08-02 08:34:51 UTC.
pub const T0: i64 = 1_533_198_891 * S;

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

    pub fn settings(&self) -> Settings {
        Settings {
            store: Store::Ram,
            preroll_bytes: 16 << 20,
            max_length: Duration::from_secs(600),
            folder: self.0.clone(),
            clock: "log time of the drive".to_owned(),
            prefault: false,
        }
    }

    /// Creates a folder, and a recorder in it.
    pub fn recording() -> (Self, Recorder) {
        let scratch = Self::new();
        let recorder = scratch.recorder(|_| {});
        (scratch, recorder)
    }

    pub fn recorder(&self, settings: impl FnOnce(&mut Settings)) -> Recorder {
        let mut given = self.settings();
        settings(&mut given);
        Recorder::new(RecordingFolder::open(&self.0).unwrap().0, given).unwrap()
    }

    /// The messages of a clip in the order of its file.
    pub fn messages(&self, clip: &Clip) -> Vec<ClipMessage> {
        let bytes = fs::read(self.0.join(&clip.file)).unwrap();
        mcap::MessageStream::new(&bytes)
            .unwrap()
            .map(|message| {
                let message = message.unwrap();
                let data = message.data.into_owned();
                (message.channel.topic.clone(), message.log_time as i64, message.sequence, data)
            })
            .collect()
    }

    /// Topic, stamp and number of the messages of a clip, sorted.
    pub fn contents(&self, clip: &Clip) -> Vec<(String, i64, u32)> {
        let mut contents: Vec<_> =
            self.messages(clip).into_iter().map(|(topic, at, seq, _)| (topic, at, seq)).collect();
        contents.sort();
        contents
    }

    pub fn attachments(&self, clip: &Clip) -> BTreeMap<String, Vec<u8>> {
        let bytes = fs::read(self.0.join(&clip.file)).unwrap();
        let records = mcap::read::LinearReader::new(&bytes).unwrap();
        let mut found = BTreeMap::new();
        for record in records {
            if let mcap::records::Record::Attachment { header, data, .. } = record.unwrap() {
                found.insert(header.name, data.into_owned());
            }
        }
        found
    }

    pub fn metadata(&self, clip: &Clip) -> Vec<(String, BTreeMap<String, String>)> {
        metadata(&fs::read(self.0.join(&clip.file)).unwrap())
    }

    /// The channels of a clip: topics, each as often as it has one, sorted.
    pub fn channels(&self, clip: &Clip) -> Vec<String> {
        let bytes = fs::read(self.0.join(&clip.file)).unwrap();
        let channels = mcap::Summary::read(&bytes).unwrap().unwrap().channels;
        let mut topics: Vec<_> = channels.values().map(|channel| channel.topic.clone()).collect();
        topics.sort();
        topics
    }

    /// The journal of a lambda in a clip: its header, and the stamps of its wakes.
    pub fn journal(&self, clip: &Clip, lambda: &str) -> (JournalHeader, Vec<i64>) {
        let bytes = &self.attachments(clip)[&format!("journal/{lambda}.journal")];
        let mut reader = JournalReader::open(bytes.as_slice()).unwrap();
        let header = reader.header().clone();
        let mut stamps = Vec::new();
        while let Some(entry) = reader.next().unwrap() {
            stamps.push(entry.at_ns);
        }
        assert_eq!(reader.end().unwrap().wakes, stamps.len() as u64);
        (header, stamps)
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

/// Topic, stamp, number and bytes.
pub type ClipMessage = (String, i64, u32, Vec<u8>);

pub fn topic(name: &str) -> TopicSchema {
    let type_name =
        if name.starts_with("/camera") { "sensor_msgs/msg/Image" } else { "test_msgs/msg/Number" };
    TopicSchema {
        name: name.to_owned(),
        type_name: type_name.to_owned(),
        definitions: Some("int64 value\n".into()),
        ..TopicSchema::default()
    }
}

/// A lambda that records, with windows in ms.
pub fn member(name: &str, rolls_ms: (i64, i64, i64), topics: &[TopicId]) -> LambdaSpec {
    let (preroll, postroll, cooldown) = rolls_ms;
    let text = format!(
        r#"
[lambda]
name = "{name}"
version = "1.2.3"
kind = "python"
entry = "main.py"
[schedule]
event = "numbers"
[[input]]
name = "numbers"
topic = "/a"
type = "test_msgs/msg/Number"
[record]
topics = ["/a"]
preroll = "{preroll}ms"
postroll = "{postroll}ms"
cooldown = "{cooldown}ms"
"#
    );
    let rules = Manifest::parse(&text, "lambda.toml").unwrap().record.unwrap();
    let input = JournalInput {
        name: "numbers".to_owned(),
        topic: "/a".to_owned(),
        wire_topic: "/a".to_owned(),
        type_name: "test_msgs/msg/Number".to_owned(),
    };
    let header = JournalHeader {
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
    };
    LambdaSpec { header, rules, digest: "d1e5".to_owned(), topics: topics.to_vec() }
}

pub fn add_hello(recorder: &mut Recorder, rolls_ms: (i64, i64, i64)) -> (TopicId, LambdaId) {
    let a = recorder.add_topic(topic("/a")).unwrap();
    (a, recorder.add_lambda(member("hello", rolls_ms, &[a])))
}

pub fn meta(at_ns: i64, seq: u64) -> SampleMeta {
    SampleMeta::new(at_ns, Guid([7; 16]), seq)
}

pub fn entry(at_ns: i64, kinds: &[TriggerKind]) -> JournalEntry {
    let trigger = |kind: &TriggerKind| Trigger {
        kind: *kind,
        label: "here".to_owned(),
        score: Some(0.5),
        attributes: serde_json::Map::new(),
    };
    JournalEntry {
        at_ns,
        seen: vec![InputView::default()],
        triggers: kinds.iter().map(trigger).collect(),
        ..JournalEntry::default()
    }
}

/// A sample every `every_ms` on each topic, from `T0 + from_ms` to before `T0 + to_ms`; numbered by
/// its ms. Each of `wakes` wakes a lambda after the samples of its ms.
pub fn drive(
    recorder: &mut Recorder,
    topics: &[TopicId],
    (from_ms, to_ms, every_ms): (i64, i64, i64),
    wakes: &[(i64, LambdaId, &[TriggerKind])],
) {
    for ms in from_ms..to_ms {
        if ms % every_ms == 0 {
            for topic in topics {
                recorder.sample(*topic, &meta(T0 + ms * MS, ms as u64), &ms.to_le_bytes()).unwrap();
            }
        }
        for (_, lambda, kinds) in wakes.iter().filter(|(at, _, _)| *at == ms) {
            recorder.wake(*lambda, &entry(T0 + ms * MS, kinds)).unwrap();
        }
    }
}

/// The stamps of a topic's messages in a clip, in ms after [`T0`].
pub fn stamps(scratch: &TestDir, clip: &Clip, topic: &str) -> Vec<i64> {
    let contents = scratch.contents(clip);
    contents.iter().filter(|(name, _, _)| name == topic).map(|(_, at, _)| (at - T0) / MS).collect()
}

/// Every `every`-th number from `from` to `to`, both included.
pub fn every(from: i64, to: i64, every: i64) -> Vec<i64> {
    (from..=to).filter(|ms| ms % every == 0).collect()
}

pub fn lambda_names(clip: &Clip) -> Vec<&str> {
    clip.lambdas.iter().map(|lambda| lambda.name.as_str()).collect()
}

pub fn follow_each_other(numbers: &[u32]) -> bool {
    numbers.windows(2).all(|pair| pair[1] == pair[0] + 1)
}

/// A window of a model: lambda, first and last instant.
pub type ModelWindow = (usize, i64, i64);

/// Computes groups of windows by brute force: all windows at once, then the connected ones. It has
/// no state, and ignores the order of arrival.
///
/// `rolls` are preroll, postroll and cooldown of each lambda. A trigger is a stamp, the lambda and
/// the kind.
pub fn model_groups(
    rolls: &[(i64, i64, i64)],
    triggers: &[(i64, usize, TriggerKind)],
) -> Vec<Vec<ModelWindow>> {
    use TriggerKind::{Event, Start, Stop};
    let mut windows = Vec::new();
    for (lambda, (preroll, postroll, cooldown)) in rolls.iter().enumerate() {
        let (mut opened, mut started) = (None, None);
        for (at, _, kind) in triggers.iter().filter(|(_, owner, _)| *owner == lambda) {
            let cool = opened.is_none_or(|opened: i64| *at >= opened + cooldown);
            match (kind, started) {
                (Stop, Some(from)) => {
                    windows.push((lambda, from, at + postroll));
                    started = None;
                }
                (Event, _) if cool => {
                    windows.push((lambda, at - preroll, at + postroll));
                    opened = Some(*at);
                }
                (Start, None) if cool => {
                    started = Some(at - preroll);
                    opened = Some(*at);
                }
                _ => {}
            }
        }
        windows.extend(started.map(|from| (lambda, from, i64::MAX)));
    }
    windows.sort_by_key(|(_, from, _)| *from);
    let mut groups: Vec<Vec<ModelWindow>> = Vec::new();
    let mut end = i64::MIN;
    for window in windows {
        match groups.last_mut() {
            Some(group) if window.1 <= end => group.push(window),
            _ => groups.push(vec![window]),
        }
        end = end.max(window.2);
    }
    groups
}

/// Pseudo-random numbers, the same in each run (SplitMix64).
pub struct SeededRandom(pub u64);

impl SeededRandom {
    pub fn below(&mut self, n: u64) -> i64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) % n) as i64
    }
}
