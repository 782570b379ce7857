//! What differs between two runs, decision by decision.
//!
//! `wakes` walks through both files at once and pairs the wakes, `compare` says what differs within
//! a pair, and `whole` compares what the runs say of themselves.

mod compare;
#[cfg(test)]
mod tests;
mod wakes;
mod whole;

use std::collections::BTreeMap;
use std::path::Path;

use gleaner_base::{Exit, Explain};
use gleaner_lambda::Decision;
use gleaner_lambda::manifest::Kind;
use serde::Serialize;

use crate::results::{Decisions, ResultsError};
use crate::run_summary::OutputError;

pub use compare::{Difference, Is, Of};

/// So many differences are listed; of those that are rare, so many in any case. The others are
/// counted.
const LISTED: usize = 1_000;
const LISTED_OF_EACH: usize = 20;

/// What differs between two runs.
#[derive(Debug, Serialize)]
pub struct Diff {
    /// No decision differs.
    pub same: bool,
    /// The first run.
    pub a: Side,
    /// The second.
    pub b: Side,
    /// What makes them hard to compare, such as another drive.
    pub notes: Vec<String>,
    /// Values of the config that differ, of at most 200 keys.
    pub config: Vec<Change>,
    /// Counts that differ.
    pub counts: Vec<Change>,
    /// What a wake costs, so far as a run has it.
    pub cost: Vec<Cost>,
    /// How many triggers differ.
    pub triggers: Tally,
    /// How many faults differ.
    pub faults: Tally,
    /// Those that are listed, in the order of their wakes.
    pub differences: Vec<Difference>,
    /// Differences that are not listed.
    pub left_out: u64,
}

/// One of both.
#[derive(Debug, Serialize)]
pub struct Side {
    /// Its folder.
    pub out: String,
    /// The name of its lambda.
    pub lambda: String,
    /// The version of its lambda.
    pub version: String,
    /// The kind of its lambda.
    pub kind: Kind,
    /// The files of its drive; none if it was live.
    pub drive: Vec<String>,
    /// When its drive starts, in ns; `None` if it was live.
    pub start_ns: Option<i64>,
}

/// A value that is not the same; `None` where there is none, or nobody knows it.
#[derive(Debug, PartialEq, Eq, Serialize)]
pub struct Change {
    /// Its name, in words or as a key of the config.
    pub what: String,
    /// In the first run.
    pub a: Option<String>,
    /// In the second run.
    pub b: Option<String>,
}

/// What half of the wakes took at most.
#[derive(Debug, PartialEq, Serialize)]
pub struct Cost {
    /// What was measured, in words.
    pub what: &'static str,
    /// `ns` or `fuel`.
    pub unit: &'static str,
    /// In the first run.
    pub a: Option<u64>,
    /// In the second run.
    pub b: Option<u64>,
    /// `b / a`.
    pub ratio: Option<f64>,
}

/// How many of each.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Tally {
    /// Both runs have them alike.
    pub same: u64,
    /// Only the first run has them.
    pub gone: u64,
    /// Only the second has them.
    pub new: u64,
    /// Both have them, not alike.
    pub changed: u64,
}

/// Why two runs cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum DiffError {
    /// A folder holds no results.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// A file of lines cannot be read to its end.
    #[error(transparent)]
    Read(ResultsError),
    /// More happened at one instant than is held in memory.
    #[error("`{out}` has more than {} wakes, or more than {} MiB of them, at one instant", wakes::AT_ONCE, wakes::BYTES_AT_ONCE >> 20)]
    Crowded {
        /// The folder of the run.
        out: String,
    },
}

impl Explain for DiffError {
    fn help(&self) -> Option<String> {
        match self {
            Self::Output(error) => error.help(),
            Self::Read(_) | Self::Crowded { .. } => Some(
                "name two folders that `gleaner replay` or `gleaner run` wrote to, whole"
                    .to_owned(),
            ),
        }
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

impl Diff {
    /// What differs between the runs in these folders. Both are read once, side by side; the memory
    /// that it takes does not grow with their length.
    ///
    /// # Errors
    ///
    /// [`DiffError`] if one of them holds no results, or a file of it cannot be read to its end.
    pub fn between(a: &Path, b: &Path) -> Result<Diff, DiffError> {
        let mut diff = whole::compared(a, b)?;
        // Of a live run nothing says when it began: seconds count from its first decision.
        let mut list = List { start_ns: diff.a.start_ns, ..List::default() };
        let (mut wakes_a, mut wakes_b) = (decisions(a)?.weighed(), decisions(b)?.weighed());
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
                    "the wakes are not in the order of their times: some may be listed as gone and new".to_owned(),
                );
            }
            list.add(pair.a.as_ref(), pair.b.as_ref());
        }
        diff.triggers = list.triggers;
        diff.faults = list.faults;
        diff.same = list.triggers.is_same() && list.faults.is_same();
        diff.left_out = list.left_out;
        diff.differences = list.listed;
        Ok(diff)
    }
}

fn decisions(out: &Path) -> Result<Decisions, DiffError> {
    Decisions::open(out).map_err(DiffError::Read)
}

/// The differences, some of them by word, all of them by count.
#[derive(Default)]
struct List {
    start_ns: Option<i64>,
    listed: Vec<Difference>,
    of_each: BTreeMap<(Of, Is), usize>,
    left_out: u64,
    triggers: Tally,
    faults: Tally,
    out_of_order: bool,
}

impl List {
    fn add(&mut self, a: Option<&Decision>, b: Option<&Decision>) {
        let Some(either) = a.or(b) else { return };
        let start_ns = *self.start_ns.get_or_insert(either.at_ns);
        let found = compare::wakes(a, b, start_ns);
        self.triggers.same += found.same_triggers;
        self.faults.same += u64::from(found.same_fault);
        for difference in found.differences {
            let tally = match difference.of {
                Of::Trigger => &mut self.triggers,
                Of::Fault => &mut self.faults,
            };
            tally.count(difference.is);
            let alike = self.of_each.entry((difference.of, difference.is)).or_default();
            if self.listed.len() < LISTED || *alike < LISTED_OF_EACH {
                *alike += 1;
                self.listed.push(difference);
            } else {
                self.left_out += 1;
            }
        }
    }
}

impl Tally {
    /// Whether nothing differs.
    pub fn is_same(self) -> bool {
        self.gone == 0 && self.new == 0 && self.changed == 0
    }

    fn count(&mut self, is: Is) {
        match is {
            Is::Gone => self.gone += 1,
            Is::New => self.new += 1,
            Is::Changed => self.changed += 1,
        }
    }
}
