//! The status of a live lambda: counts, durations, topics and network.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::counts::{DurationStats, LinkLosses, NetworkStatus, ReceptionGaps, add};
use crate::link::RecorderStatus;
use gleaner_lambda::manifest::LambdaKind;

/// The status of a live lambda. Counts are since its start; durations are since the previous
/// report, and in the last report since the start.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct LiveStatus {
    /// Name of the lambda.
    pub lambda: String,
    /// Version of the lambda.
    pub version: String,
    /// Kind of the lambda.
    #[schemars(with = "String")]
    pub kind: LambdaKind,
    /// The folder of its results.
    pub out: PathBuf,
    /// Number of restarts of its process so far.
    pub restarts: u32,
    /// Time since its `init`, in s.
    pub up_s: f64,
    /// Number of wakes.
    pub wakes: u64,
    /// Triggers of all kinds.
    pub triggers: u64,
    /// Wakes that ended in a fault.
    pub faults: u64,
    /// Number of event samples that did not wake the lambda, by `backlog = "latest"` or because the
    /// ring was full.
    pub skipped: u64,
    /// Number of ticks that came during a wake, and were skipped.
    pub missed_ticks: u64,
    /// Number of log lines of the lambda that were kept.
    pub log_lines: u64,
    /// Number of log lines over the rate limit, which were dropped.
    pub log_dropped: u64,
    /// Number of triggers over `events_per_minute` of `[limits]`, which were refused.
    pub triggers_refused: u64,
    /// Number of wakes skipped by the back-off after repeated faults.
    pub backed_off: u64,
    /// Number of decisions and log lines that could not be written, as the disk failed or was too
    /// slow; and of invalid items that native code of the lambda sent in their place.
    pub unwritten: u64,
    /// Number of messages on the topics of `--rtt` and `--decisions` that were dropped, as a reader
    /// was too slow, the lambda too fast, or the ingress had ended.
    #[serde(default)]
    pub unsent: u64,
    /// Time from reception of a sample, or from a due tick, until the lambda is entered. `None`
    /// without wakes.
    pub wake_latency: Option<DurationStats>,
    /// Time in the lambda's code.
    pub run_time: Option<DurationStats>,
    /// Time from the return of the lambda until its decision is sent.
    pub decision_latency: Option<DurationStats>,
    /// One entry per input, in the manifest's order.
    pub topics: Vec<LiveTopic>,
    /// Status of the network.
    pub network: NetworkStatus,
    /// Times without reception, as the ingress had ended.
    #[serde(default)]
    pub reception_gaps: ReceptionGaps,
    /// Losses on the link to the recorder; `None` without a recorder.
    pub recorder_link: Option<LinkLosses>,
    /// Counts of the recorders of the run, in `summary.json` only: added by the program that starts
    /// them. `None` without a recorder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recording: Option<Box<RecorderStatus>>,
    /// Resident memory of the process alone, in bytes: topics in shared memory are not part of it.
    pub rss_bytes: u64,
    /// CPU time of the process, in s.
    pub cpu_s: f64,
}

/// Numbers of wakes of a lambda, in some time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct WakeCounts {
    /// Number of wakes.
    pub wakes: u64,
    /// Wakes that ended in a fault.
    pub faults: u64,
    /// Number of wakes skipped by the back-off after repeated faults.
    pub backed_off: u64,
}

/// Number of faults from which on a lambda can be [faulty](WakeCounts::faulty): fewer are too few
/// to judge it by.
const FAULTS_MIN: u64 = 10;
/// Number of its wakes, of which one ended with a fault, in a lambda that is faulty: at least half.
const FAULTY_ONE_OF: u64 = 2;

impl WakeCounts {
    /// Returns the wakes since those of `before`.
    #[must_use]
    pub fn since(self, before: Self) -> Self {
        Self {
            wakes: self.wakes.saturating_sub(before.wakes),
            faults: self.faults.saturating_sub(before.faults),
            backed_off: self.backed_off.saturating_sub(before.backed_off),
        }
    }

    /// Returns the number of all wakes, with those that were skipped.
    pub fn all(self) -> u64 {
        self.wakes.saturating_add(self.backed_off)
    }

    /// Returns a sentence with the numbers if the lambda is faulty: at least 10 of its wakes ended
    /// with a fault, and these are at least half of all. Those that were skipped after faults count
    /// as such. Its probation has failed then.
    pub fn faulty(self) -> Option<String> {
        let Self { wakes, faults, backed_off } = self;
        let failed = faults.saturating_add(backed_off);
        let is_faulty = faults >= FAULTS_MIN && failed.saturating_mul(FAULTY_ONE_OF) >= self.all();
        let skipped = match backed_off {
            0 => String::new(),
            _ => format!(" ({backed_off} more skipped)"),
        };
        is_faulty.then(|| format!("{faults} of its last {wakes} wakes faulted{skipped}"))
    }
}

impl LiveStatus {
    /// Returns the status of a lambda before its first wake: all counts are 0.
    pub fn new(lambda: &str, version: &str, kind: LambdaKind, out: PathBuf) -> LiveStatus {
        LiveStatus {
            lambda: lambda.to_owned(),
            version: version.to_owned(),
            kind,
            out,
            ..LiveStatus::default()
        }
    }

    /// Returns its numbers of wakes.
    pub fn wake_counts(&self) -> WakeCounts {
        WakeCounts { wakes: self.wakes, faults: self.faults, backed_off: self.backed_off }
    }

    /// Adds the counts of `before`, an earlier process of the same lambda. Durations, rates and
    /// instantaneous values stay those of this process.
    #[must_use]
    pub fn after(mut self, before: &LiveStatus) -> LiveStatus {
        self.up_s += before.up_s;
        self.cpu_s += before.cpu_s;
        let counts = [
            (&mut self.wakes, before.wakes),
            (&mut self.triggers, before.triggers),
            (&mut self.faults, before.faults),
            (&mut self.skipped, before.skipped),
            (&mut self.missed_ticks, before.missed_ticks),
            (&mut self.log_lines, before.log_lines),
            (&mut self.log_dropped, before.log_dropped),
            (&mut self.triggers_refused, before.triggers_refused),
            (&mut self.backed_off, before.backed_off),
            (&mut self.unwritten, before.unwritten),
            (&mut self.unsent, before.unsent),
            (&mut self.network.socket_drops, before.network.socket_drops),
            (&mut self.network.filtered, before.network.filtered),
            (&mut self.reception_gaps.count, before.reception_gaps.count),
            (&mut self.reception_gaps.ms, before.reception_gaps.ms),
        ];
        add(counts);
        for topic in &mut self.topics {
            let Some(before) = before.topics.iter().find(|before| before.name == topic.name) else {
                continue;
            };
            // Unknown in one of them means unknown in the sum.
            topic.lost =
                topic.lost.zip(before.lost).map(|(now, before)| now.saturating_add(before));
            add([
                (&mut topic.received, before.received),
                (&mut topic.malformed, before.malformed),
                (&mut topic.overwritten, before.overwritten),
                (&mut topic.no_slot, before.no_slot),
                (&mut topic.too_big, before.too_big),
                (&mut topic.skipped, before.skipped),
            ]);
        }
        if let (Some(now), Some(before)) = (&mut self.recorder_link, &before.recorder_link) {
            add([
                (&mut now.wakes_dropped, before.wakes_dropped),
                (&mut now.triggers_lost, before.triggers_lost),
                (&mut now.recorders_ended, before.recorders_ended),
            ]);
        }
        self
    }
}

/// The samples of one input: received and lost.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct LiveTopic {
    /// Name of the input.
    pub name: String,
    /// Topic of the input, after remapping.
    pub topic: String,
    /// Message type, for example `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// Number of connected writers.
    pub writers: Option<usize>,
    /// Samples received per second, since the previous report.
    pub rate_hz: f64,
    /// Number of samples that reached the ring.
    pub received: u64,
    /// Number of samples lost before they reached this process, by gaps in their numbers; `None` if
    /// unknown.
    pub lost: Option<u64>,
    /// Number of samples that could not be parsed.
    pub malformed: u64,
    /// Number of samples that newer ones replaced in the ring.
    pub overwritten: u64,
    /// Always 0: a lambda that holds too many samples has a fault.
    pub no_slot: u64,
    /// Number of samples larger than the input's `max_size`.
    pub too_big: u64,
    /// Number of samples that should have woken the lambda and did not.
    pub skipped: u64,
    /// Age of the newest sample, in ns; `None` before the first.
    pub age_ns: Option<i64>,
    /// The requested QoS, as text.
    pub qos: Option<String>,
    /// Reasons why writers do not match, in whole sentences.
    pub qos_warnings: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn live(count: u64, lost: Option<u64>) -> LiveStatus {
        let topic = LiveTopic {
            name: "imu".to_owned(),
            topic: "/imu".to_owned(),
            type_name: "sensor_msgs/msg/Imu".to_owned(),
            writers: Some(1),
            rate_hz: count as f64,
            received: count,
            lost,
            malformed: count,
            overwritten: count,
            no_slot: count,
            too_big: count,
            skipped: count,
            age_ns: Some(5),
            ..LiveTopic::default()
        };
        LiveStatus {
            restarts: count as u32,
            up_s: count as f64,
            wakes: count,
            triggers: count,
            faults: count,
            skipped: count,
            missed_ticks: count,
            log_lines: count,
            log_dropped: count,
            triggers_refused: count,
            backed_off: count,
            unwritten: count,
            unsent: count,
            wake_latency: Some(DurationStats {
                n: count,
                p50_ns: count,
                p99_ns: count,
                max_ns: count,
            }),
            topics: vec![topic],
            network: NetworkStatus {
                socket_drops: count,
                filtered: count,
                participants: 3,
                ..NetworkStatus::default()
            },
            reception_gaps: ReceptionGaps { count, ms: count },
            recorder_link: Some(LinkLosses {
                wakes_dropped: count,
                triggers_lost: count,
                recorders_ended: count,
                absent_s: 0,
            }),
            rss_bytes: count,
            cpu_s: count as f64,
            ..LiveStatus::new("hello", "0.1.0", LambdaKind::Wasm, PathBuf::from("out"))
        }
    }

    #[test]
    fn counts_are_added_and_other_values_are_those_of_the_later_process() {
        let both = live(2, Some(3)).after(&live(40, Some(50)));
        let mut expected = live(42, Some(53));
        (expected.restarts, expected.rss_bytes, expected.topics[0].rate_hz) = (2, 2, 2.0);
        expected.wake_latency = live(2, None).wake_latency;
        assert_eq!(both, expected);
        assert_eq!(
            live(2, Some(3)).after(&live(40, None)).topics[0].lost,
            None,
            "unknown is never 0"
        );
        let long = live(u64::MAX, None).after(&live(1, None));
        assert_eq!(long.wakes, u64::MAX);
    }

    #[test]
    fn ten_faults_that_are_half_of_all_wakes_make_a_lambda_faulty() {
        let faulty = |wakes, faults, backed_off| WakeCounts { wakes, faults, backed_off }.faulty();
        assert_eq!([faulty(9, 9, 0), faulty(21, 10, 0), faulty(1000, 499, 1)], [const { None }; 3]);
        assert_eq!(faulty(20, 10, 0).unwrap(), "10 of its last 20 wakes faulted");
        let text = faulty(176, 76, 6218).unwrap();
        assert!(text.ends_with("wakes faulted (6218 more skipped)"), "{text}");
        assert!(faulty(u64::MAX, u64::MAX, u64::MAX).is_some());
    }
}
