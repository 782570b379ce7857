use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::link::RecorderStatus;
use gleaner_lambda::manifest::LambdaKind;

/// How a lambda is doing on live topics. Counts are since its start; spreads are since the report
/// before, and in the last report since the start.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LiveStatus {
    /// Name of the lambda.
    pub lambda: String,
    /// Version of the lambda.
    pub version: String,
    /// What kind of lambda it is.
    pub kind: LambdaKind,
    /// Where its results are written.
    pub out: PathBuf,
    /// How often its process was started again before.
    pub restarts: u32,
    /// Time since its `init`, in s.
    pub up_s: f64,
    /// How often it ran.
    pub wakes: u64,
    /// Triggers of all kinds.
    pub triggers: u64,
    /// Wakes that ended in a fault.
    pub faults: u64,
    /// Event samples that woke nobody, by `backlog = "latest"` or because the ring was full.
    pub skipped: u64,
    /// Ticks that passed while the lambda was still running.
    pub missed_ticks: u64,
    /// Log lines that the lambda wrote and that were kept.
    pub log_lines: u64,
    /// Log lines over the rate limit, thrown away.
    pub log_dropped: u64,
    /// Triggers over `events_per_minute` of `[limits]`, refused.
    pub triggers_refused: u64,
    /// Wakes that did not happen, since the lambda had faulted again and again.
    pub backed_off: u64,
    /// Decisions and log lines that could not be written: the disk failed, or was too slow; and
    /// what native code of the lambda handed on in their place, which is none.
    pub unwritten: u64,
    /// Messages on the topics of `--rtt` and `--decisions` that were not sent, since a reader does
    /// not keep up.
    #[serde(default)]
    pub unsent: u64,
    /// Sample received, or tick due, until the lambda is entered. `None` without wakes.
    pub wake_latency: Option<DurationStats>,
    /// Time in the lambda.
    pub run_time: Option<DurationStats>,
    /// Lambda left until its decision is out.
    pub decision_latency: Option<DurationStats>,
    /// One entry per input, in the manifest's order.
    pub topics: Vec<LiveTopic>,
    /// The network.
    pub network: NetworkStatus,
    /// What became of the wakes on their way to the recorder; `None` without one.
    pub recorder_link: Option<LinkLosses>,
    /// What the recorders of the run counted, in `summary.json` only: whoever starts them adds it.
    /// `None` without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recording: Option<Box<RecorderStatus>>,
    /// Resident memory, in bytes.
    pub rss_bytes: u64,
    /// CPU time of the process, in s.
    pub cpu_s: f64,
}

impl LiveStatus {
    /// With what was counted of `before`, an earlier process of the same lambda. Spreads, rates,
    /// and what is true of an instant stay those of this one.
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
        ];
        add(counts);
        for topic in &mut self.topics {
            let Some(before) = before.topics.iter().find(|before| before.name == topic.name) else {
                continue;
            };
            // Unknown in one of them is unknown in both.
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
            ]);
        }
        self
    }
}

pub(crate) fn add<const N: usize>(counts: [(&mut u64, u64); N]) {
    counts.into_iter().for_each(|(count, before)| *count = count.saturating_add(before));
}

/// How long something took.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct DurationStats {
    /// How often.
    pub n: u64,
    /// Median, in ns.
    pub p50_ns: u64,
    /// What 99 of 100 do not exceed, in ns.
    pub p99_ns: u64,
    /// The longest, in ns.
    pub max_ns: u64,
}

/// What arrives on one input, and what is lost on the way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LiveTopic {
    /// Name of the input.
    pub name: String,
    /// Its topic, after remapping.
    pub topic: String,
    /// Its type, for example `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// Writers that are connected now.
    pub writers: Option<usize>,
    /// Samples received per second, since the report before.
    pub rate_hz: f64,
    /// Samples that reached the ring.
    pub received: u64,
    /// Samples that were lost before they reached us, as far as gaps in their numbers tell; `None`
    /// if nothing tells.
    pub lost: Option<u64>,
    /// Samples that could not be read at all.
    pub malformed: u64,
    /// Samples that a newer one pushed out of the ring.
    pub overwritten: u64,
    /// Samples that found no free slot, since the lambda held too many.
    pub no_slot: u64,
    /// Samples larger than the input's `max_size`.
    pub too_big: u64,
    /// Samples that should have woken the lambda and did not.
    pub skipped: u64,
    /// Age of the newest sample, in ns; `None` before the first.
    pub age_ns: Option<i64>,
    /// What is asked of the writers, in words.
    pub qos: Option<String>,
    /// What keeps writers from being heard, in whole sentences.
    pub qos_warnings: Vec<String>,
}

/// The network, as a process of ours sees it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct NetworkStatus {
    /// The domain of DDS.
    pub domain: u16,
    /// Other participants that are known.
    pub participants: usize,
    /// Bytes of socket buffer that were asked for.
    pub buffer_requested: usize,
    /// Bytes that the system granted.
    pub buffer_granted: usize,
    /// Datagrams that the system dropped because a buffer was full.
    pub socket_drops: u64,
    /// Datagrams that nobody should send, with fragments that claim too much or with too many
    /// numbers, dropped before they could do harm: see `docs/dds-limits.md`.
    #[serde(default)]
    pub filtered: u64,
    /// Why such datagrams are let pass, if they are.
    #[serde(default)]
    pub unfiltered: Option<String>,
}

/// What became of wakes on their way to the recorder.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkLosses {
    /// Wakes without a trigger that were left out because the recorder was too slow: clips say how
    /// many they lack.
    pub wakes_dropped: u64,
    /// Triggers that could not be handed over.
    pub triggers_lost: u64,
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
            qos: None,
            qos_warnings: Vec::new(),
        };
        LiveStatus {
            lambda: "hello".to_owned(),
            version: "0.1.0".to_owned(),
            kind: LambdaKind::Wasm,
            out: PathBuf::from("out"),
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
            run_time: None,
            decision_latency: None,
            topics: vec![topic],
            network: NetworkStatus {
                socket_drops: count,
                filtered: count,
                participants: 3,
                ..NetworkStatus::default()
            },
            recorder_link: Some(LinkLosses { wakes_dropped: count, triggers_lost: count }),
            recording: None,
            rss_bytes: count,
            cpu_s: count as f64,
        }
    }

    #[test]
    fn counts_are_those_of_both_processes_and_all_else_is_of_the_later_one() {
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
}
