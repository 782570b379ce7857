//! Support for tests of recorders: lambdas, a drive of samples and wakes, and access to clips.

use std::collections::BTreeMap;
use std::fs;
use std::time::Duration;

use gleaner_journal::{InputView, JournalEntry, JournalHeader, JournalReader};
use gleaner_lambda::manifest::{Manifest, Store};
use gleaner_lambda::{Clip, Trigger, TriggerKind};
use gleaner_messages::transport::{Guid, SampleMeta};

pub use crate::file::tests::TestDir;
use crate::file::tests::{journal_header, metadata};
pub use crate::window::tests::{ModelWindow, SeededRandom, model_groups};
use crate::{LambdaId, LambdaSpec, Recorder, RecordingFolder, Settings, TopicId, TopicSchema};

pub const EVENT: &[TriggerKind] = &[TriggerKind::Event];
pub const MS: i64 = 1_000_000;
pub const S: i64 = 1_000 * MS;
/// 2018-08-02 08:34:51 UTC.
pub const T0: i64 = 1_533_198_891 * S;

impl TestDir {
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
    let header = journal_header(name);
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
