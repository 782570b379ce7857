use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::live_status::add;
use crate::{DurationStats, NetworkStatus, RecordingCounts};
use gleaner_lambda::Clip;

/// One line of JSON that `gleaner-recorder` writes on its standard output for the program that
/// started it.
///
/// The key `recorder` says which it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "recorder", rename_all = "snake_case")]
pub enum RecorderReport {
    /// It hears lambdas from now on.
    Ready,
    /// A clip of an earlier recorder, which did not end well, was saved.
    Recovered(Box<Clip>),
    /// A clip is whole.
    Clip(Box<Clip>),
    /// Something that was wanted is not there, or will not be.
    Loss(Loss),
    /// Sent once a second.
    Status(Box<RecorderStatus>),
    /// Sent once, last.
    Ended(Box<RecorderStatus>),
}

/// Something that was wanted and is not there: one line of `losses.jsonl`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "loss", rename_all = "snake_case")]
pub enum Loss {
    /// A clip was deleted that nobody had fetched.
    Deleted {
        /// When, in ns since 1970.
        at_ns: i64,
        /// The clip, as in `clips.jsonl`.
        file: PathBuf,
        /// Its length.
        bytes: u64,
        /// Why, in words.
        reason: String,
    },
    /// A clip that should have been deleted to make room, and could not be: it is still there,
    /// whole or without its thumbnail, though a line before may say that it was deleted.
    NotDeleted {
        /// When, in ns since 1970.
        at_ns: i64,
        /// The clip, as in `clips.jsonl`.
        file: PathBuf,
        /// Its length.
        bytes: u64,
        /// Why, in words.
        reason: String,
    },
    /// A clip could not be written. What there is of it is recovered by the next recorder.
    Failed {
        /// When, in ns on the clock of the clips.
        at_ns: i64,
        /// Why, in words.
        reason: String,
    },
    /// Triggers that opened no window, as nothing was recorded.
    DiskSuppressed {
        /// When, in ns on the clock of the clips.
        at_ns: i64,
        /// How many.
        triggers: u64,
        /// Why, in words.
        reason: String,
    },
}

/// How the recorder is doing. Counts are since its start; the spread is since the report before,
/// and in the last report since the start.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RecorderStatus {
    /// Lambdas that it hears.
    pub lambdas: usize,
    /// What it counted.
    #[serde(flatten)]
    pub recording: RecordingCounts,
    /// Whether a clip is open.
    #[serde(rename = "recording")]
    pub is_recording: bool,
    /// Bytes that the preroll holds.
    pub preroll_bytes: u64,
    /// The most that it may hold.
    pub preroll_bound: u64,
    /// Bytes on their way to the disk.
    pub in_flight: u64,
    /// From a decision with triggers to the opening of its windows. `None` without such.
    pub trigger_to_open: Option<DurationStats>,
    /// Commands; `None` where none are heard.
    #[serde(default)]
    pub commands: Option<CommandStatus>,
    /// Topics that are recorded.
    pub topics: Vec<RecordedTopic>,
    /// The network; `None` where there is none.
    pub network: Option<NetworkStatus>,
    /// Bytes that are free on the disk of the clips.
    pub disk_free: Option<u64>,
    /// Resident memory, in bytes.
    pub rss_bytes: u64,
    /// CPU time of the process, in s.
    pub cpu_s: f64,
}

impl RecorderStatus {
    /// With what was counted of `before`, an earlier recorder of the same run. Spreads, and what is
    /// true of an instant, stay those of this one.
    #[must_use]
    pub fn after(mut self, before: &RecorderStatus) -> RecorderStatus {
        self.recording.add(&before.recording);
        self.cpu_s += before.cpu_s;
        if let (Some(now), Some(before)) = (&mut self.commands, &before.commands) {
            add([(&mut now.accepted, before.accepted), (&mut now.refused, before.refused)]);
        }
        for topic in &mut self.topics {
            let Some(before) = before.topics.iter().find(|before| before.topic == topic.topic)
            else {
                continue;
            };
            // Unknown in one of them is unknown in both.
            topic.lost =
                topic.lost.zip(before.lost).map(|(now, before)| now.saturating_add(before));
            add([
                (&mut topic.received, before.received),
                (&mut topic.no_slot, before.no_slot),
                (&mut topic.too_big, before.too_big),
                (&mut topic.malformed, before.malformed),
            ]);
        }
        let known: Vec<_> = self.topics.iter().map(|topic| topic.topic.clone()).collect();
        self.topics
            .extend(before.topics.iter().filter(|before| !known.contains(&before.topic)).cloned());
        if let (Some(now), Some(before)) = (&mut self.network, &before.network) {
            add([
                (&mut now.socket_drops, before.socket_drops),
                (&mut now.filtered, before.filtered),
            ]);
        }
        self
    }
}

/// What came of commands.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CommandStatus {
    /// The topic over which they come.
    pub topic: String,
    /// Those that did something.
    pub accepted: u64,
    /// Those that make no sense, came too often, or were too long.
    pub refused: u64,
    /// Writers that are connected now.
    pub writers: Option<usize>,
    /// What keeps writers from being heard, in whole sentences.
    pub qos_warnings: Vec<String>,
}

/// A topic that is recorded. `None` is unknown.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedTopic {
    /// The topic.
    pub topic: String,
    /// Its type; `None` until it is found.
    pub type_name: Option<String>,
    /// Writers that are connected now.
    pub writers: Option<usize>,
    /// Samples that reached the recorder.
    pub received: u64,
    /// Samples that were lost before they reached it.
    pub lost: Option<u64>,
    /// Samples that it had no room for, as it was busy.
    pub no_slot: u64,
    /// Samples that are larger than it can take.
    pub too_big: u64,
    /// Samples that could not be read at all.
    pub malformed: u64,
    /// What is asked of the writers, in words.
    pub qos: Option<String>,
    /// What keeps writers from being heard, in whole sentences.
    pub qos_warnings: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status(count: u64, topics: &[&str], lost: Option<u64>) -> RecorderStatus {
        let topic = |name: &&str| RecordedTopic {
            topic: (*name).to_owned(),
            received: count,
            lost,
            no_slot: count,
            too_big: count,
            malformed: count,
            ..RecordedTopic::default()
        };
        RecorderStatus {
            recording: RecordingCounts {
                clips: count,
                disk_suppressed: count,
                ..RecordingCounts::default()
            },
            commands: Some(CommandStatus {
                accepted: count,
                refused: count,
                ..CommandStatus::default()
            }),
            topics: topics.iter().map(topic).collect(),
            network: Some(NetworkStatus {
                socket_drops: count,
                filtered: count,
                ..NetworkStatus::default()
            }),
            ..RecorderStatus::default()
        }
    }

    #[test]
    fn counts_are_those_of_both_recorders() {
        let both = status(2, &["/a"], Some(3)).after(&status(40, &["/a", "/b"], Some(50)));
        let mut expected = status(42, &["/a"], Some(53));
        expected.topics.extend(status(40, &["/b"], Some(50)).topics);
        assert_eq!(both, expected);
        assert_eq!(
            status(2, &["/a"], Some(3)).after(&status(4, &["/a"], None)).topics[0].lost,
            None,
            "unknown is never 0"
        );
    }

    #[test]
    fn a_status_reads_back_and_is_flat() {
        let status = RecorderStatus { is_recording: true, ..status(2, &["/a"], None) };
        let json = serde_json::to_value(&status).unwrap();
        assert_eq!((&json["disk_suppressed"], &json["recording"]), (&2.into(), &true.into()));
        assert_eq!(serde_json::from_value::<RecorderStatus>(json).unwrap(), status);
    }
}
