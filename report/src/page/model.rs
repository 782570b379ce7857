//! The data of the page, as its script reads it. Times are in s after the start of the drive, of
//! two runs that of the first; numbers that a script would round are texts.

use std::collections::BTreeMap;

use gleaner_lambda::manifest::{ConfigValue, Kind};
use gleaner_lambda::{Cause, FaultKind};
use serde::Serialize;

use super::density::Dense;
use crate::run_summary::Losses;

/// What one output holds.
#[derive(Debug, Serialize)]
pub(crate) struct Run {
    pub(crate) out: String,
    pub(crate) lambda: String,
    pub(crate) version: String,
    pub(crate) kind: Kind,
    pub(crate) is_live: bool,
    pub(crate) drive: Vec<String>,
    /// What times count from.
    #[serde(skip)]
    pub(crate) start_ns: i64,
    /// The same in ms since 1970: what a date of the page is made from.
    pub(crate) start_ms: f64,
    /// What the page shows, in s.
    pub(crate) from: f64,
    pub(crate) to: f64,
    /// Only a part of the drive was replayed.
    pub(crate) is_part: bool,
    /// `None` if nothing tells.
    pub(crate) config: Option<BTreeMap<String, ConfigValue>>,
    pub(crate) counts: BTreeMap<&'static str, u64>,
    pub(crate) damaged: Option<String>,
    pub(crate) stopped: Option<String>,
    /// What is missing on the page, and why.
    pub(crate) notes: Vec<String>,
    /// What it took, in words.
    pub(crate) facts: Vec<Fact>,
    pub(crate) labels: Vec<String>,
    pub(crate) triggers: Vec<Mark>,
    /// All triggers by label, if `triggers` has not all of them; else none.
    pub(crate) trigger_density: Vec<Dense>,
    pub(crate) fault_kinds: Vec<FaultKind>,
    pub(crate) faults: Vec<FaultMark>,
    /// All faults by kind, likewise.
    pub(crate) fault_density: Vec<Dense>,
    pub(crate) fault_causes: Vec<FaultCause>,
    pub(crate) clips: Vec<ClipShown>,
    pub(crate) curves: Vec<CurveShown>,
    pub(crate) spreads: Vec<SpreadShown>,
    pub(crate) topics: Vec<Losses>,
    pub(crate) missed: Vec<(&'static str, u64)>,
    pub(crate) pictures: Vec<PictureShown>,
    pub(crate) log: Vec<LogShown>,
    /// How many there are, of which the page shows some.
    pub(crate) totals: Totals,
}

#[derive(Debug, Default, Serialize)]
pub(crate) struct Totals {
    pub(crate) triggers: u64,
    pub(crate) faults: u64,
    /// Faults whose cause is in no line of the table.
    pub(crate) faults_in_no_line: u64,
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

/// A trigger.
#[derive(Debug, Serialize)]
pub(crate) struct Mark {
    pub(crate) t: f64,
    #[serde(skip)]
    pub(crate) at_ns: i64,
    /// Which of `labels`.
    pub(crate) label: usize,
    pub(crate) kind: &'static str,
    pub(crate) score: Option<f64>,
    /// As they stand in the file; empty with `attributes_cut`, if there are more than the page has
    /// room for.
    pub(crate) attributes: Vec<(String, String)>,
    pub(crate) attributes_cut: bool,
    pub(crate) cause: Cause,
    pub(crate) topic: Option<String>,
    pub(crate) seq: Option<String>,
    pub(crate) fuel: Option<u64>,
    pub(crate) run_ns: u64,
    /// Which of `pictures`.
    pub(crate) pictures: Vec<usize>,
}

/// A wake that ended in a fault.
#[derive(Debug, Serialize)]
pub(crate) struct FaultMark {
    pub(crate) t: f64,
    /// Which of `fault_kinds`.
    pub(crate) lane: usize,
    pub(crate) message: String,
    pub(crate) amounts: Amounts,
    pub(crate) topic: Option<String>,
}

/// What was used of what is allowed, in words.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Amounts {
    pub(crate) used: Option<String>,
    pub(crate) allowed: Option<String>,
}

/// Faults with one cause.
#[derive(Debug, Serialize)]
pub(crate) struct FaultCause {
    pub(crate) kind: FaultKind,
    pub(crate) message: String,
    /// Of the first.
    pub(crate) amounts: Amounts,
    pub(crate) count: u64,
    pub(crate) first: f64,
    pub(crate) last: f64,
}

#[derive(Debug, Serialize)]
pub(crate) struct ClipShown {
    pub(crate) file: String,
    pub(crate) from: f64,
    pub(crate) to: f64,
    #[serde(skip)]
    pub(crate) span_ns: [i64; 2],
    pub(crate) bytes: u64,
    pub(crate) triggers: u64,
    /// What is in it, in words.
    pub(crate) contents: String,
    /// Why it holds less than was asked for.
    pub(crate) short: Vec<String>,
}

#[derive(Debug, Serialize)]
pub(crate) struct CurveShown {
    pub(crate) input: String,
    pub(crate) topic: String,
    pub(crate) path: String,
    pub(crate) samples: u64,
    pub(crate) non_finite: u64,
    pub(crate) per_point: u64,
    pub(crate) t: Vec<f64>,
    pub(crate) min: Vec<f64>,
    /// Empty if each is as its `min`.
    pub(crate) max: Vec<f64>,
}

#[derive(Debug, Serialize)]
pub(crate) struct SpreadShown {
    pub(crate) what: &'static str,
    /// `ns` or `fuel`.
    pub(crate) unit: &'static str,
    pub(crate) count: u64,
    /// The key of each is a word of the page: `half`, `90 %`.
    pub(crate) marks: Vec<(&'static str, u64)>,
    /// From, to, count; none if nobody kept them.
    pub(crate) bins: Vec<[u64; 3]>,
}

#[derive(Debug, Serialize)]
pub(crate) struct PictureShown {
    pub(crate) t: f64,
    /// Of a camera, or of a clip.
    pub(crate) of: String,
    /// How long before the trigger it was taken, in s, if it is known.
    pub(crate) age: Option<f64>,
    /// A `data:` address.
    pub(crate) src: String,
}

#[derive(Debug, Serialize)]
pub(crate) struct LogShown {
    pub(crate) t: f64,
    pub(crate) level: String,
    pub(crate) message: String,
}
