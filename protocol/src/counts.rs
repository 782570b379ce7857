//! Counts, durations and the state of the network, as they are part of several reports.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Statistics of durations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct DurationStats {
    /// Number of durations.
    pub n: u64,
    /// Median, in ns.
    pub p50_ns: u64,
    /// 99th percentile, in ns.
    pub p99_ns: u64,
    /// Maximum, in ns.
    pub max_ns: u64,
}

/// The network status of the ingress.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct NetworkStatus {
    /// DDS domain.
    pub domain: u16,
    /// Number of other known participants.
    pub participants: usize,
    /// Requested size of the socket buffer, in bytes.
    pub buffer_requested: usize,
    /// Granted size, in bytes.
    pub buffer_granted: usize,
    /// True if the ingress receives with real-time priority.
    #[serde(default)]
    pub real_time: bool,
    /// Number of datagrams that the system dropped because a buffer was full.
    pub socket_drops: u64,
    /// Number of harmful datagrams that the packet filter dropped, with excessive fragments or too
    /// many numbers: see `docs/dds-limits.md`.
    #[serde(default)]
    pub filtered: u64,
    /// The reason why such datagrams are not filtered, if any.
    #[serde(default)]
    pub unfiltered: Option<String>,
}

/// Times in which a process received no samples, as the ingress had ended. Samples that were sent
/// meanwhile are among the lost ones of their topics; where their number is unknown, the number of
/// lost ones is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ReceptionGaps {
    /// Number of ingresses that ended while the process ran.
    pub count: u64,
    /// Sum of the times until the next one was joined, in ms. Until it has found the writers,
    /// further samples are lost.
    pub ms: u64,
}

/// Losses on the link from a lambda to the recorder.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LinkLosses {
    /// Number of wakes without a trigger that were dropped because the recorder was too slow, or
    /// there was none for a minute: clips state how many they lack.
    pub wakes_dropped: u64,
    /// Number of triggers that could not be sent.
    pub triggers_lost: u64,
    /// Number of recorders that ended while the process ran. Clips lack the samples until the next
    /// one had joined, and wakes that were on their way.
    #[serde(default)]
    pub recorders_ended: u64,
    /// Time since which there is no recorder, in s; 0 with one.
    #[serde(default)]
    pub absent_s: u64,
}

/// Adds earlier counts to later ones.
pub(crate) fn add<const N: usize>(counts: [(&mut u64, u64); N]) {
    counts.into_iter().for_each(|(count, before)| *count = count.saturating_add(before));
}
