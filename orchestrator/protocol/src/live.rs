use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::manifest::Kind;

/// How a lambda is doing on live topics. Counts are since its start; spreads are since the report before, and in the last report
/// since the start.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Live {
    /// Name of the lambda.
    pub lambda: String,
    /// Version of the lambda.
    pub version: String,
    /// What kind of lambda it is.
    pub kind: Kind,
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
    /// Decisions and log lines that could not be written: the disk failed, or was too slow.
    pub unwritten: u64,
    /// Sample received, or tick due, until the lambda is entered. `None` without wakes.
    pub wake_up: Option<Spread>,
    /// Time in the lambda.
    pub run: Option<Spread>,
    /// Lambda left until its decision is out.
    pub hand_out: Option<Spread>,
    /// One entry per input, in the manifest's order.
    pub topics: Vec<LiveTopic>,
    /// The network.
    pub network: Network,
    /// What became of the wakes on their way to the recorder; `None` without one.
    pub recorder: Option<ToRecorder>,
    /// Resident memory, in bytes.
    pub rss_bytes: u64,
    /// CPU time of the process, in s.
    pub cpu_s: f64,
}

/// How long something took.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Spread {
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
    /// Samples that were lost before they reached us, as far as gaps in their numbers tell; `None` if nothing tells.
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
    pub trouble: Vec<String>,
}

/// The network, as a process of ours sees it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Network {
    /// The domain of DDS.
    pub domain: u16,
    /// Other participants that are known.
    pub participants: usize,
    /// Bytes of socket buffer that were asked for.
    pub buffer_asked: usize,
    /// Bytes that the system granted.
    pub buffer_granted: usize,
    /// Datagrams that the system dropped because a buffer was full.
    pub socket_drops: u64,
    /// Datagrams with fragments that nobody should send, dropped before they could do harm: see `docs/dds-limits.md`.
    #[serde(default)]
    pub filtered: u64,
}

/// What became of wakes on their way to the recorder.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ToRecorder {
    /// Wakes without a trigger that were left out because the recorder was too slow: clips say how many they lack.
    pub wakes_dropped: u64,
    /// Triggers that could not be handed over.
    pub triggers_lost: u64,
}
