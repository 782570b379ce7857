//! The reports of `gleaner-recorder` to its starter: clips, losses, status.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::RecordingCounts;
use crate::counts::{DurationStats, NetworkStatus, ReceptionGaps, add};
use gleaner_lambda::Clip;

/// One line of JSON that `gleaner-recorder` writes on its standard output for the program that
/// started it.
///
/// The key `recorder` has the kind.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "recorder", rename_all = "snake_case")]
pub enum RecorderReport {
    /// The recorder accepts lambdas from now on.
    Ready,
    /// A clip of an earlier recorder, which died, was recovered.
    Recovered(Box<Clip>),
    /// A clip is complete.
    Clip(Box<Clip>),
    /// Data was lost.
    Loss(Loss),
    /// Sent once a second.
    Status(Box<RecorderStatus>),
    /// Sent once, last.
    Ended(Box<RecorderStatus>),
}

/// A loss of data: one line of `losses.jsonl`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "loss", rename_all = "snake_case")]
pub enum Loss {
    /// A clip was deleted before it was fetched.
    Deleted {
        /// Time, in ns since 1970.
        at_ns: i64,
        /// The clip, as in `clips.jsonl`.
        file: PathBuf,
        /// Length in bytes.
        bytes: u64,
        /// The reason.
        reason: String,
    },
    /// A clip that should have been deleted to make room, and could not be: it still exists,
    /// complete or without its thumbnail, although an earlier line may report its deletion.
    NotDeleted {
        /// Time, in ns since 1970.
        at_ns: i64,
        /// The clip, as in `clips.jsonl`.
        file: PathBuf,
        /// Length in bytes.
        bytes: u64,
        /// The reason.
        reason: String,
    },
    /// A clip could not be written. The next recorder recovers its remains.
    Failed {
        /// Time, in ns on the clock of the clips.
        at_ns: i64,
        /// The reason.
        reason: String,
    },
    /// Triggers that opened no window, as recording was suspended.
    DiskSuppressed {
        /// Time, in ns on the clock of the clips.
        at_ns: i64,
        /// Number of triggers.
        triggers: u64,
        /// The reason.
        reason: String,
    },
}

/// The status of the recorder. Counts are since its start; durations are since the previous report,
/// and in the last report since the start.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct RecorderStatus {
    /// Number of connected lambdas.
    pub lambdas: usize,
    /// Counts of the recorder.
    #[serde(flatten)]
    pub recording: RecordingCounts,
    /// True if a clip is open.
    #[serde(rename = "recording")]
    pub is_recording: bool,
    /// Size of the preroll, in bytes.
    pub preroll_bytes: u64,
    /// Maximum size of the preroll, in bytes.
    pub preroll_bound: u64,
    /// Number of bytes being written to disk.
    pub in_flight: u64,
    /// Time from a decision with triggers to the opening of its windows. `None` without such
    /// decisions.
    pub trigger_to_open: Option<DurationStats>,
    /// Commands; `None` if they are off.
    #[serde(default)]
    pub commands: Option<CommandStatus>,
    /// Recorded topics.
    pub topics: Vec<RecordedTopic>,
    /// Status of the network; `None` without one.
    pub network: Option<NetworkStatus>,
    /// Times without reception, as the ingress had ended.
    #[serde(default)]
    pub reception_gaps: ReceptionGaps,
    /// Free bytes on the disk of the clips.
    pub disk_free: Option<u64>,
    /// Resident memory, in bytes.
    pub rss_bytes: u64,
    /// CPU time of the process, in s.
    pub cpu_s: f64,
}

impl RecorderStatus {
    /// Adds the counts of `before`, an earlier recorder of the same run. Durations and
    /// instantaneous values stay those of this recorder.
    #[must_use]
    pub fn after(mut self, before: &RecorderStatus) -> RecorderStatus {
        self.recording.add(&before.recording);
        self.cpu_s += before.cpu_s;
        add([
            (&mut self.reception_gaps.count, before.reception_gaps.count),
            (&mut self.reception_gaps.ms, before.reception_gaps.ms),
        ]);
        if let (Some(now), Some(before)) = (&mut self.commands, &before.commands) {
            add([(&mut now.accepted, before.accepted), (&mut now.refused, before.refused)]);
        }
        for topic in &mut self.topics {
            let Some(before) = before.topics.iter().find(|before| before.topic == topic.topic)
            else {
                continue;
            };
            // Unknown in one of them means unknown in the sum.
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

/// Counts of commands.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct CommandStatus {
    /// Topic of the commands.
    pub topic: String,
    /// Number of accepted commands.
    pub accepted: u64,
    /// Number of commands that were invalid, too frequent or too long.
    pub refused: u64,
    /// Number of connected writers.
    pub writers: Option<usize>,
    /// Reasons why writers do not match, in whole sentences.
    pub qos_warnings: Vec<String>,
}

/// A recorded topic. `None` means unknown.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct RecordedTopic {
    /// The topic.
    pub topic: String,
    /// Message type; `None` until it is found.
    pub type_name: Option<String>,
    /// Number of connected writers.
    pub writers: Option<usize>,
    /// Number of samples that reached the recorder.
    pub received: u64,
    /// Number of samples lost before they reached it.
    pub lost: Option<u64>,
    /// Number of samples that left the shared memory before the recorder took them.
    pub no_slot: u64,
    /// Number of samples that were too large.
    pub too_big: u64,
    /// Number of samples that could not be parsed.
    pub malformed: u64,
    /// The requested QoS, as text.
    pub qos: Option<String>,
    /// Reasons why writers do not match, in whole sentences.
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
            reception_gaps: ReceptionGaps { count, ms: count },
            network: Some(NetworkStatus {
                socket_drops: count,
                filtered: count,
                ..NetworkStatus::default()
            }),
            ..RecorderStatus::default()
        }
    }

    #[test]
    fn counts_of_both_recorders_are_added() {
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
    fn a_status_is_flat_and_is_parsed_back() {
        let status = RecorderStatus { is_recording: true, ..status(2, &["/a"], None) };
        let json = serde_json::to_value(&status).unwrap();
        assert_eq!((&json["disk_suppressed"], &json["recording"]), (&2.into(), &true.into()));
        assert_eq!(serde_json::from_value::<RecorderStatus>(json).unwrap(), status);
    }
}
