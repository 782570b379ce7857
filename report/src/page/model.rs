//! The data of the page, in the form that its script reads. Times are in s after the start of the
//! drive (of the first run's, if there are two). Numbers that a script would round are texts.

use std::collections::BTreeMap;

use gleaner_lambda::manifest::{ConfigValue, LambdaKind};
use gleaner_lambda::{Cause, FaultKind};
use serde::Serialize;

use super::density::DensityBin;
use crate::run_summary::TopicCounts;

#[derive(Debug, Serialize)]
pub(crate) struct PageRun {
    pub(crate) out: String,
    pub(crate) lambda: String,
    pub(crate) version: String,
    pub(crate) kind: LambdaKind,
    pub(crate) is_live: bool,
    pub(crate) drive: Vec<String>,
    /// Origin of the times, in ns.
    #[serde(skip)]
    pub(crate) start_ns: i64,
    /// `start_ns` in ms since 1970, for dates on the page.
    pub(crate) start_ms: f64,
    /// Start and end of the timeline, in s.
    pub(crate) from: f64,
    pub(crate) to: f64,
    /// True if only a part of the drive was replayed.
    pub(crate) is_part: bool,
    /// `None` if unknown.
    pub(crate) config: Option<BTreeMap<String, ConfigValue>>,
    pub(crate) counts: BTreeMap<&'static str, u64>,
    pub(crate) damaged: Option<String>,
    pub(crate) stopped: Option<String>,
    /// Missing parts of the page, with reasons.
    pub(crate) notes: Vec<String>,
    /// Cost and speed of the run, as text.
    pub(crate) facts: Vec<Fact>,
    pub(crate) labels: Vec<String>,
    pub(crate) triggers: Vec<TriggerEvent>,
    /// All triggers by label and time, if `triggers` is incomplete; else empty.
    pub(crate) trigger_density: Vec<DensityBin>,
    pub(crate) fault_kinds: Vec<FaultKind>,
    pub(crate) faults: Vec<FaultEvent>,
    /// All faults by kind and time, if `faults` is incomplete; else empty.
    pub(crate) fault_density: Vec<DensityBin>,
    pub(crate) fault_causes: Vec<FaultCause>,
    pub(crate) clips: Vec<PageClip>,
    pub(crate) curves: Vec<PageCurve>,
    pub(crate) spreads: Vec<PageSpread>,
    pub(crate) topics: Vec<TopicCounts>,
    pub(crate) missed: Vec<(&'static str, u64)>,
    pub(crate) pictures: Vec<PagePicture>,
    pub(crate) log: Vec<PageLogLine>,
    /// Total numbers, of which the page may show fewer.
    pub(crate) totals: Totals,
}

#[derive(Debug, Default, Serialize)]
pub(crate) struct Totals {
    pub(crate) triggers: u64,
    pub(crate) faults: u64,
    /// Faults whose cause is not in the table.
    pub(crate) unlisted_faults: u64,
    pub(crate) clips: u64,
    pub(crate) pictures_omitted: u64,
    pub(crate) curves_omitted: u64,
    pub(crate) log: u64,
}

#[derive(Debug, Serialize)]
pub(crate) struct Fact {
    pub(crate) what: &'static str,
    pub(crate) text: String,
}

#[derive(Debug, Serialize)]
pub(crate) struct TriggerEvent {
    pub(crate) t: f64,
    #[serde(skip)]
    pub(crate) at_ns: i64,
    /// Index into `labels`.
    pub(crate) label: usize,
    pub(crate) kind: &'static str,
    pub(crate) score: Option<f64>,
    /// Names and values as in the file; empty if `attributes_omitted`.
    pub(crate) attributes: Vec<(String, String)>,
    /// True if the attributes are too large for the page.
    pub(crate) attributes_omitted: bool,
    pub(crate) cause: Cause,
    pub(crate) topic: Option<String>,
    pub(crate) seq: Option<String>,
    pub(crate) fuel: Option<u64>,
    pub(crate) run_ns: u64,
    /// Indices into `pictures`.
    pub(crate) pictures: Vec<usize>,
}

#[derive(Debug, Serialize)]
pub(crate) struct FaultEvent {
    pub(crate) t: f64,
    /// Index into `fault_kinds`.
    pub(crate) lane: usize,
    pub(crate) message: String,
    pub(crate) amounts: Amounts,
    pub(crate) topic: Option<String>,
}

/// Used and allowed amounts, as text.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Amounts {
    pub(crate) used: Option<String>,
    pub(crate) allowed: Option<String>,
}

/// Faults with the same cause: equal messages, but for their numbers.
#[derive(Debug, Serialize)]
pub(crate) struct FaultCause {
    pub(crate) kind: FaultKind,
    pub(crate) message: String,
    /// Amounts of the first fault.
    pub(crate) amounts: Amounts,
    pub(crate) count: u64,
    pub(crate) first: f64,
    pub(crate) last: f64,
}

#[derive(Debug, Serialize)]
pub(crate) struct PageClip {
    pub(crate) file: String,
    pub(crate) from: f64,
    pub(crate) to: f64,
    #[serde(skip)]
    pub(crate) span_ns: [i64; 2],
    pub(crate) bytes: u64,
    pub(crate) triggers: u64,
    pub(crate) contents: String,
    /// Reasons why it lacks data of its window.
    pub(crate) incomplete: Vec<String>,
}

#[derive(Debug, Serialize)]
pub(crate) struct PageCurve {
    pub(crate) input: String,
    pub(crate) topic: String,
    pub(crate) path: String,
    pub(crate) samples: u64,
    pub(crate) non_finite: u64,
    pub(crate) per_point: u64,
    pub(crate) t: Vec<f64>,
    pub(crate) min: Vec<f64>,
    /// Empty if equal to `min`.
    pub(crate) max: Vec<f64>,
}

#[derive(Debug, Serialize)]
pub(crate) struct PageSpread {
    pub(crate) what: &'static str,
    /// `ns` or `fuel`.
    pub(crate) unit: &'static str,
    pub(crate) count: u64,
    /// Names, such as `p50`, and values.
    pub(crate) quantiles: Vec<(&'static str, u64)>,
    /// From, to, count; empty for a live run, which does not keep them.
    pub(crate) bins: Vec<[u64; 3]>,
}

#[derive(Debug, Serialize)]
pub(crate) struct PagePicture {
    pub(crate) t: f64,
    /// Topic of the camera, or file of the clip.
    pub(crate) source: String,
    /// Time from the picture to the trigger, in s; `None` for a thumbnail of a clip.
    pub(crate) age: Option<f64>,
    pub(crate) src: String,
}

#[derive(Debug, Serialize)]
pub(crate) struct PageLogLine {
    pub(crate) t: f64,
    pub(crate) level: String,
    pub(crate) message: String,
}
