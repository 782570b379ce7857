//! Compares two runs decision by decision.
//!
//! `wakes` reads both files side by side and pairs the wakes, `compare` compares the two wakes of a
//! pair, and `summaries` compares `summary.json`, `signals.json` and `clips.jsonl`.

mod compare;
mod summaries;
#[cfg(test)]
mod tests;
mod wakes;

use std::collections::BTreeMap;
use std::path::Path;

use gleaner_base::{Exit, Explain};
use gleaner_lambda::Decision;
use gleaner_lambda::manifest::LambdaKind;
use serde::Serialize;

use crate::results::{Decisions, ResultsError};
use crate::run_summary::OutputError;

pub use compare::{ChangeKind, Difference, DifferenceKind};

/// Maximum number of differences that are listed. The others are only counted.
const LISTED: usize = 1_000;
/// Differences of each kind and change that are listed even beyond [`LISTED`], so that rare ones
/// are not crowded out.
const LISTED_OF_EACH: usize = 20;

/// The differences between two runs.
#[derive(Debug, Default, Serialize)]
pub struct Diff {
    /// True if no decision differs.
    pub identical: bool,
    pub a: ComparedRun,
    pub b: ComparedRun,
    /// Reasons why the runs are hard to compare, such as different drives.
    pub notes: Vec<String>,
    /// Config values that differ, of at most 200 keys.
    pub config: Vec<ValueChange>,
    pub counts: Vec<ValueChange>,
    /// Median cost of a wake, as far as the runs have it.
    pub cost: Vec<Cost>,
    pub triggers: ChangeCounts,
    pub faults: ChangeCounts,
    /// The listed differences, in the order of their wakes.
    pub differences: Vec<Difference>,
    /// Number of differences that are not listed.
    pub omitted: u64,
}

#[derive(Debug, Default, Serialize)]
pub struct ComparedRun {
    /// Result folder of the run.
    pub out: String,
    pub lambda: String,
    pub version: String,
    pub kind: LambdaKind,
    /// The files of its drive; empty for a live run.
    pub drive: Vec<String>,
    /// Start of its drive, in ns; `None` for a live run.
    pub start_ns: Option<i64>,
}

/// A value that differs; `None` where it is missing or unknown.
#[derive(Debug, PartialEq, Eq, Serialize)]
pub struct ValueChange {
    /// Name of the value, in words or as a key of the config.
    pub what: String,
    /// Value in the first run.
    pub a: Option<String>,
    /// Value in the second run.
    pub b: Option<String>,
}

/// Median cost of a wake.
#[derive(Debug, PartialEq, Serialize)]
pub struct Cost {
    /// The measured quantity, in words.
    pub what: &'static str,
    /// `ns` or `fuel`.
    pub unit: &'static str,
    /// Value in the first run.
    pub a: Option<u64>,
    /// Value in the second run.
    pub b: Option<u64>,
    /// `b / a`.
    pub ratio: Option<f64>,
}

#[derive(Debug, Default, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct ChangeCounts {
    pub identical: u64,
    /// Number of those that only the first run has.
    pub removed: u64,
    /// Number of those that only the second run has.
    pub added: u64,
    /// Number of those that both runs have, with different values.
    pub changed: u64,
}

#[derive(Debug, thiserror::Error)]
pub enum DiffError {
    #[error(transparent)]
    Output(#[from] OutputError),
    #[error(transparent)]
    Read(ResultsError),
    #[error(
        "`{out}` has more than {} wakes, or more than {} MiB of them, at one instant",
        wakes::WAKES_PER_INSTANT,
        wakes::BYTES_PER_INSTANT >> 20
    )]
    Crowded { out: String },
}

impl Explain for DiffError {
    fn help(&self) -> Option<String> {
        match self {
            Self::Output(error) => error.help(),
            Self::Read(_) | Self::Crowded { .. } => Some(
                "name two complete result folders of `gleaner replay` or `gleaner run`".to_owned(),
            ),
        }
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

impl Diff {
    /// Compares the runs in these folders. Both are read once, side by side; memory use does not
    /// grow with their length.
    ///
    /// # Errors
    ///
    /// [`DiffError`] if a folder does not hold results, or one of its files cannot be read to its
    /// end.
    pub fn between(a: &Path, b: &Path) -> Result<Diff, DiffError> {
        let mut diff = summaries::compared(a, b)?;
        // The start of a live run is not recorded: seconds count from its first decision.
        let mut list = DifferenceList { start_ns: diff.a.start_ns, ..DifferenceList::default() };
        let (mut wakes_a, mut wakes_b) = (decisions(a)?.with_sizes(), decisions(b)?.with_sizes());
        for pair in wakes::Pairs::new(&mut wakes_a, &mut wakes_b) {
            let pair = pair.map_err(|error| match error {
                wakes::WakesError::Read(source) => DiffError::Read(source),
                wakes::WakesError::Crowded { first } => {
                    DiffError::Crowded { out: if first { a } else { b }.display().to_string() }
                }
            })?;
            if pair.out_of_order && !list.out_of_order {
                list.out_of_order = true;
                diff.notes.push(
                    "the wakes are not in the order of their times: some may be listed as removed \
                     and added"
                        .to_owned(),
                );
            }
            list.add(pair.a.as_ref(), pair.b.as_ref());
        }
        diff.triggers = list.triggers;
        diff.faults = list.faults;
        diff.identical = list.triggers.is_identical() && list.faults.is_identical();
        diff.omitted = list.omitted;
        diff.differences = list.listed;
        Ok(diff)
    }
}

fn decisions(out: &Path) -> Result<Decisions, DiffError> {
    Decisions::open(out).map_err(DiffError::Read)
}

/// Collects differences: lists the first ones, counts all.
#[derive(Default)]
struct DifferenceList {
    start_ns: Option<i64>,
    listed: Vec<Difference>,
    of_each: BTreeMap<(DifferenceKind, ChangeKind), usize>,
    omitted: u64,
    triggers: ChangeCounts,
    faults: ChangeCounts,
    out_of_order: bool,
}

impl DifferenceList {
    fn add(&mut self, a: Option<&Decision>, b: Option<&Decision>) {
        let Some(either) = a.or(b) else { return };
        let start_ns = *self.start_ns.get_or_insert(either.at_ns);
        let compared = compare::wakes(a, b, start_ns);
        self.triggers.identical += compared.identical_triggers;
        self.faults.identical += u64::from(compared.has_identical_fault);
        for difference in compared.differences {
            let counts = match difference.kind {
                DifferenceKind::Trigger => &mut self.triggers,
                DifferenceKind::Fault => &mut self.faults,
            };
            counts.count(difference.change);
            let alike = self.of_each.entry((difference.kind, difference.change)).or_default();
            if self.listed.len() < LISTED || *alike < LISTED_OF_EACH {
                *alike += 1;
                self.listed.push(difference);
            } else {
                self.omitted += 1;
            }
        }
    }
}

impl ChangeCounts {
    pub fn is_identical(self) -> bool {
        self.removed == 0 && self.added == 0 && self.changed == 0
    }

    fn count(&mut self, change: ChangeKind) {
        match change {
            ChangeKind::Removed => self.removed += 1,
            ChangeKind::Added => self.added += 1,
            ChangeKind::Changed => self.changed += 1,
        }
    }
}
