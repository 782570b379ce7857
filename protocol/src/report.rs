//! The reports of `gleaner-runtime` to its starter: progress, decisions, results.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::{CheckReport, DriveInfo, Layer, LiveStatus, RecordingCounts};
use gleaner_journal::TimeRange;
use gleaner_lambda::Decision;
use gleaner_lambda::manifest::LambdaKind;

/// One line of JSON that `gleaner-runtime` writes on its standard output for the program that
/// started it.
///
/// The key `report` has the kind. Every floating-point value is finite, as in JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "report", rename_all = "snake_case")]
pub enum Report {
    /// Sent a few times per second during a replay.
    Progress {
        /// Number of messages of the drive handled so far.
        done: u64,
        /// Number of messages of the drive, if its index has it.
        total: Option<u64>,
        /// Log time reached, in ns since the epoch.
        at_ns: i64,
    },
    /// Sent after each pass over the drive, where a replay makes several.
    Round(Round),
    /// Sent once, last.
    Summary(Box<ReplaySummary>),
    /// Sent once, before the lambda is entered for the first time.
    Isolation {
        /// The layers around its process, as tested.
        layers: Vec<Layer>,
    },
    /// Live: the lambda is ready for its first wake.
    Ready,
    /// Live: a wake with a trigger or a fault. If the reader is too slow, some are dropped here;
    /// all are in the file.
    Decision(Box<Decision>),
    /// Live: sent once a second.
    Live(Box<LiveStatus>),
    /// Live: sent once, last.
    Ended(Box<LiveStatus>),
    /// Sent once, last: the result of a check.
    Checked(Box<CheckReport>),
    /// Sent once, last: the content of a recorded drive.
    Drive(DriveInfo),
    /// Sent once, last, instead of a summary or a content: the files are separate drives, and
    /// nothing was done.
    Separate {
        /// The files and directories of each drive.
        drives: Vec<Vec<PathBuf>>,
    },
    /// Sent once, last, instead of a summary: a journal was compared, and every decision was the
    /// same.
    Verified(Verified),
}

/// The result of verifying a journal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Verified {
    /// Name of the lambda.
    pub lambda: String,
    /// Number of wakes in the journal.
    pub wakes: u64,
    /// Number of triggers in the journal.
    pub triggers: u64,
    /// Number of wakes that were not compared, as the lambda had read samples from before the clip.
    pub uncovered: u64,
    /// Number of triggers in these wakes.
    pub uncovered_triggers: u64,
    /// True if the journal has no end, as its writer died or its drive was damaged. All of its
    /// wakes were compared.
    pub truncated: bool,
    /// Duration, in s.
    pub wall_s: f64,
    /// Differences in the environment, such as another version of the engine.
    pub notes: Vec<String>,
}

/// One pass over a drive, of several; comparing passes shows a leak or a slowdown.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Round {
    /// The pass, from 1.
    pub n: u32,
    /// Wakes of this pass.
    pub wakes: u64,
    /// Wakes of this pass that ended in a fault.
    pub faults: u64,
    /// Duration of this pass after `init` has returned, in s.
    pub wall_s: f64,
    /// Wakes of this pass per second of `wall_s`.
    pub wakes_per_s: f64,
    /// Resident memory of the process after this pass, in bytes.
    pub rss_bytes: u64,
}

/// The summary of a replay.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ReplaySummary {
    /// Name of the lambda.
    pub lambda: String,
    /// Version of the lambda.
    pub version: String,
    /// Kind of the lambda.
    pub kind: LambdaKind,
    /// The drive: MCAP files and rosbag2 directories, as given.
    pub drive: Vec<PathBuf>,
    /// The folder of the results.
    pub out: PathBuf,
    /// Number of wakes.
    pub wakes: u64,
    /// Triggers of all kinds.
    pub triggers: u64,
    /// Wakes that ended in a fault.
    pub faults: u64,
    /// Number of event samples that did not wake the lambda, by `backlog = "latest"` or because the
    /// ring was full.
    pub skipped: u64,
    /// Number of ticks of a periodic lambda that came during a wake, and were skipped.
    pub missed_ticks: u64,
    /// Number of messages after one with a later log time, as the index of a file is wrong or
    /// missing.
    pub out_of_order: u64,
    /// Number of messages that were left out, by topic: they are no plain CDR, or have no possible
    /// time.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub malformed: BTreeMap<String, u64>,
    /// Number of log lines of the lambda that were kept.
    pub log_lines: u64,
    /// Number of log lines over the rate limit, which were dropped.
    pub log_dropped: u64,
    /// Number of triggers over `events_per_minute` of `[limits]`, which were refused.
    pub triggers_refused: u64,
    /// Number of wakes skipped by the back-off after repeated faults.
    pub backed_off: u64,
    /// Log time of the drive's first message, in ns since the epoch.
    pub start_ns: i64,
    /// Log time of the drive's last message, in ns since the epoch.
    pub end_ns: i64,
    /// The replayed part of the drive.
    #[serde(default, skip_serializing_if = "TimeRange::is_all")]
    pub part: TimeRange,
    /// Duration of the replay after `init` has returned, in s.
    pub wall_s: f64,
    /// Time in the lambda's code, in s.
    pub run_s: f64,
    /// Time spent decoding images, in s; part of `run_s`, as it happens on the lambda's thread.
    pub decode_s: f64,
    /// `wakes / wall_s`.
    pub wakes_per_s: f64,
    /// Largest resident memory of the process, in bytes.
    pub peak_rss_bytes: u64,
    /// One entry per input, in the manifest's order.
    pub topics: Vec<TopicReport>,
    /// Each model with its runtime and provider, such as "model `det`: rten 0.24".
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub models: Vec<String>,
    /// Counts of the recorder; `clips.jsonl` has a line for each clip, including recovered ones.
    #[serde(flatten)]
    pub recording: RecordingCounts,
    /// Number of clips of an earlier replay that were deleted from the same folder.
    pub clips_replaced: u64,
    /// The damage of the drive, if any, and what was read.
    pub damaged: Option<String>,
    /// The reason why the lambda's process stopped before the end of the drive, if it did; the
    /// results end there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopped: Option<String>,
}

/// The samples of one input: received and lost.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicReport {
    /// Name of the input.
    pub name: String,
    /// Topic of the input, after remapping.
    pub topic: String,
    /// Message type, for example `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// Number of samples that reached the ring.
    pub received: u64,
    /// Number of samples lost before they reached this process; `None` without sequence numbers.
    /// Unknown is never 0.
    pub lost: Option<u64>,
    /// Number of samples that newer ones replaced in the ring.
    pub overwritten: u64,
    /// Number of samples without a free slot, as the lambda held too many.
    pub no_slot: u64,
    /// Number of samples larger than the input's `max_size`.
    pub too_big: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn reads_back(report: &Report, line: &str) {
        assert_eq!(serde_json::to_string(report).unwrap(), line);
        assert_eq!(serde_json::from_str::<Report>(line).unwrap(), *report);
    }

    #[test]
    fn progress_and_rounds_are_tagged_lines() {
        let progress = Report::Progress { done: 10, total: None, at_ns: 5 };
        reads_back(&progress, r#"{"report":"progress","done":10,"total":null,"at_ns":5}"#);
        let round =
            Round { n: 2, wakes: 100, faults: 0, wall_s: 0.5, wakes_per_s: 200.0, rss_bytes: 4096 };
        reads_back(
            &Report::Round(round),
            concat!(
                r#"{"report":"round","n":2,"wakes":100,"faults":0,"wall_s":0.5,"#,
                r#""wakes_per_s":200.0,"rss_bytes":4096}"#
            ),
        );
    }

    #[test]
    fn a_summary_has_null_for_unknown_values() {
        let topic = TopicReport {
            name: "imu".to_owned(),
            topic: "/imu/data".to_owned(),
            type_name: "sensor_msgs/msg/Imu".to_owned(),
            received: 50,
            overwritten: 1,
            ..TopicReport::default()
        };
        let summary = ReplaySummary {
            lambda: "brake-dark".to_owned(),
            version: "0.1.0".to_owned(),
            drive: vec!["a.mcap".into(), "b".into()],
            out: "out".into(),
            wakes: 50,
            triggers: 2,
            out_of_order: 4,
            log_lines: 3,
            triggers_refused: 5,
            backed_off: 6,
            start_ns: 1,
            end_ns: 2,
            wall_s: 0.25,
            run_s: 0.125,
            wakes_per_s: 200.0,
            peak_rss_bytes: 1 << 20,
            topics: vec![topic],
            recording: RecordingCounts { clips: 2, in_cooldown: 3, ..RecordingCounts::default() },
            clips_replaced: 1,
            ..ReplaySummary::default()
        };
        // The counts of the recorder are at the top level.
        let counts = serde_json::to_string(&summary.recording).unwrap();
        assert!(
            counts.starts_with(r#"{"clips":2,"windows":0,"in_cooldown":3,"ignored":0,"#),
            "{counts}"
        );
        reads_back(
            &Report::Summary(Box::new(summary)),
            &concat!(
                r#"{"report":"summary","lambda":"brake-dark","version":"0.1.0","kind":"wasm","#,
                r#""drive":["a.mcap","b"],"#,
                r#""out":"out","wakes":50,"triggers":2,"faults":0,"skipped":0,"missed_ticks":0,"#,
                r#""out_of_order":4,"log_lines":3,"#,
                r#""log_dropped":0,"triggers_refused":5,"backed_off":6,"start_ns":1,"end_ns":2,"#,
                r#""wall_s":0.25,"run_s":0.125,"decode_s":0.0,"#,
                r#""wakes_per_s":200.0,"peak_rss_bytes":1048576,"topics":[{"name":"imu","#,
                r#""topic":"/imu/data","#,
                r#""type_name":"sensor_msgs/msg/Imu","received":50,"lost":null,"overwritten":1,"#,
                r#""no_slot":0,"too_big":0}],"#,
                "COUNTS,",
                r#""clips_replaced":1,"damaged":null}"#
            )
            .replace("COUNTS", counts.trim_matches(['{', '}'])),
        );
    }
}
