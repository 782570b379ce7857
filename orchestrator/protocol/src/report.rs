use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::{CheckReport, DriveInfo, Layer, LiveStatus, RecordingCounts};
use gleaner_journal::TimeRange;
use gleaner_lambda::Decision;
use gleaner_lambda::manifest::LambdaKind;

/// One line of JSON that `gleaner-runtime` writes on its standard output for the program that
/// started it.
///
/// The key `report` says which it is. Every floating-point value is finite: JSON has no other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "report", rename_all = "snake_case")]
pub enum Report {
    /// Sent a few times per second during a replay.
    Progress {
        /// Messages of the drive that were handled so far.
        done: u64,
        /// Messages of the drive, if its index tells.
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
        /// The layers around its process, and whether they hold here.
        layers: Vec<Layer>,
    },
    /// Live: the lambda is ready for its first wake.
    Ready,
    /// Live: a wake with a trigger or a fault. Where nobody reads fast enough, some are left out
    /// here; all are in the file.
    Decision(Box<Decision>),
    /// Live: sent once a second.
    Live(Box<LiveStatus>),
    /// Live: sent once, last.
    Ended(Box<LiveStatus>),
    /// Sent once, last: the topics that are there.
    Topics {
        /// By name.
        topics: Vec<TopicInfo>,
    },
    /// Sent once, last: a lambda was checked.
    Checked(Box<CheckReport>),
    /// Sent once, last: what is in a recorded drive.
    Drive(DriveInfo),
    /// Sent once, last, instead of a summary: a journal was compared, and every decision was the
    /// same.
    Verified(Verified),
}

/// A topic of the network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicInfo {
    /// Its absolute name.
    pub topic: String,
    /// Its type, for example `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// How many write it.
    pub writers: usize,
    /// How many read it.
    pub readers: usize,
    /// What the writers offer, in words, each once.
    pub qos: Vec<String>,
}

/// How far a journal was proved.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Verified {
    /// Name of the lambda.
    pub lambda: String,
    /// Wakes in the journal.
    pub wakes: u64,
    /// Triggers in them.
    pub triggers: u64,
    /// Those of the wakes that were not compared: the lambda had looked at samples from before the
    /// clip.
    pub uncovered: u64,
    /// Triggers in these.
    pub uncovered_triggers: u64,
    /// The journal has no end: its writer died, or its drive was damaged. What it holds was
    /// compared.
    pub truncated: bool,
    /// Duration, in s.
    pub wall_s: f64,
    /// What was not the same around the lambda, such as another version of its engine.
    pub notes: Vec<String>,
}

/// One pass over a drive, of several: what shows a leak or a slowdown.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Round {
    /// The pass, from 1.
    pub n: u32,
    /// Wakes of this pass.
    pub wakes: u64,
    /// Wakes of this pass that ended in a fault.
    pub faults: u64,
    /// Duration of this pass, in s.
    pub wall_s: f64,
    /// Wakes of this pass per second of `wall_s`.
    pub wakes_per_s: f64,
    /// Resident memory of the process after this pass, in bytes.
    pub rss_bytes: u64,
}

/// What a replay did, as a whole.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReplaySummary {
    /// Name of the lambda.
    pub lambda: String,
    /// Version of the lambda.
    pub version: String,
    /// What kind of lambda it is.
    pub kind: LambdaKind,
    /// The drive: MCAP files and rosbag2 directories, as they were named.
    pub drive: Vec<PathBuf>,
    /// Where the results were written.
    pub out: PathBuf,
    /// How often the lambda ran.
    pub wakes: u64,
    /// Triggers of all kinds.
    pub triggers: u64,
    /// Wakes that ended in a fault.
    pub faults: u64,
    /// Event samples that woke nobody, by `backlog = "latest"` or because the ring was full.
    pub skipped: u64,
    /// Ticks of a periodic lambda that passed while it was still running.
    pub missed_ticks: u64,
    /// Messages of the drive that came after one with a later log time: the index of a file lied,
    /// or was not there.
    pub out_of_order: u64,
    /// Log lines that the lambda wrote and that were kept.
    pub log_lines: u64,
    /// Log lines over the rate limit, thrown away.
    pub log_dropped: u64,
    /// Triggers over `events_per_minute` of `[limits]`, refused.
    pub triggers_refused: u64,
    /// Wakes that did not happen, since the lambda had faulted again and again.
    pub backed_off: u64,
    /// Log time of the drive's first message, in ns since the epoch.
    pub start_ns: i64,
    /// Log time of the drive's last message, in ns since the epoch.
    pub end_ns: i64,
    /// What was replayed of it.
    #[serde(default, skip_serializing_if = "TimeRange::is_all")]
    pub part: TimeRange,
    /// Duration of the replay, in s.
    pub wall_s: f64,
    /// Time in the lambda, in s.
    pub run_s: f64,
    /// Time spent decoding images, in s; part of `run_s`, as it happens on the lambda's thread.
    pub decode_s: f64,
    /// `wakes / wall_s`.
    pub wakes_per_s: f64,
    /// Largest resident memory of the process, in bytes.
    pub peak_rss_bytes: u64,
    /// One entry per input, in the manifest's order.
    pub topics: Vec<TopicReport>,
    /// What was recorded, and what was not; `clips.jsonl` has a line for each clip, and for those
    /// that were recovered.
    #[serde(flatten)]
    pub recording: RecordingCounts,
    /// Clips of an earlier replay that were deleted from the same folder.
    pub clips_replaced: u64,
    /// What is wrong with the drive, if it is damaged; the results end there.
    pub damaged: Option<String>,
    /// Why the lambda's process could not go on to the end of the drive; the results end there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopped: Option<String>,
}

/// What arrived on one input, and what was lost on the way.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicReport {
    /// Name of the input.
    pub name: String,
    /// Its topic, after remapping.
    pub topic: String,
    /// Its type, for example `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// Samples that reached the ring.
    pub received: u64,
    /// Samples that were lost before they reached us; `None` where sequence numbers do not tell.
    /// Unknown is never 0.
    pub lost: Option<u64>,
    /// Samples that a newer one pushed out of the ring.
    pub overwritten: u64,
    /// Samples that found no free slot, since the lambda held too many.
    pub no_slot: u64,
    /// Samples larger than the input's `max_size`.
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
            r#"{"report":"round","n":2,"wakes":100,"faults":0,"wall_s":0.5,"wakes_per_s":200.0,"rss_bytes":4096}"#,
        );
    }

    #[test]
    fn a_summary_says_null_for_what_nobody_knows() {
        let topic = TopicReport {
            name: "imu".to_owned(),
            topic: "/imu/data".to_owned(),
            type_name: "sensor_msgs/msg/Imu".to_owned(),
            received: 50,
            lost: None,
            overwritten: 1,
            no_slot: 0,
            too_big: 0,
        };
        let summary = ReplaySummary {
            lambda: "brake-dark".to_owned(),
            version: "0.1.0".to_owned(),
            kind: LambdaKind::Wasm,
            drive: vec!["a.mcap".into(), "b".into()],
            out: "out".into(),
            wakes: 50,
            triggers: 2,
            faults: 0,
            skipped: 0,
            missed_ticks: 0,
            out_of_order: 4,
            log_lines: 3,
            log_dropped: 0,
            triggers_refused: 5,
            backed_off: 6,
            start_ns: 1,
            end_ns: 2,
            part: TimeRange::default(),
            wall_s: 0.25,
            run_s: 0.125,
            decode_s: 0.0,
            wakes_per_s: 200.0,
            peak_rss_bytes: 1 << 20,
            topics: vec![topic],
            recording: RecordingCounts { clips: 2, in_cooldown: 3, ..RecordingCounts::default() },
            clips_replaced: 1,
            damaged: None,
            stopped: None,
        };
        // Flat, whatever a recorder counts.
        let counts = serde_json::to_string(&summary.recording).unwrap();
        assert!(
            counts.starts_with(r#"{"clips":2,"windows":0,"in_cooldown":3,"ignored":0,"#),
            "{counts}"
        );
        reads_back(
            &Report::Summary(Box::new(summary)),
            &concat!(
                r#"{"report":"summary","lambda":"brake-dark","version":"0.1.0","kind":"wasm","drive":["a.mcap","b"],"#,
                r#""out":"out","wakes":50,"triggers":2,"faults":0,"skipped":0,"missed_ticks":0,"out_of_order":4,"log_lines":3,"#,
                r#""log_dropped":0,"triggers_refused":5,"backed_off":6,"start_ns":1,"end_ns":2,"wall_s":0.25,"run_s":0.125,"decode_s":0.0,"#,
                r#""wakes_per_s":200.0,"peak_rss_bytes":1048576,"topics":[{"name":"imu","topic":"/imu/data","#,
                r#""type_name":"sensor_msgs/msg/Imu","received":50,"lost":null,"overwritten":1,"no_slot":0,"too_big":0}],"#,
                "COUNTS,",
                r#""clips_replaced":1,"damaged":null}"#
            )
            .replace("COUNTS", counts.trim_matches(['{', '}'])),
        );
    }
}
