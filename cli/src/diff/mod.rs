//! `gleaner diff OUT1 OUT2`: what differs between two runs, decision by decision.
//!
//! `wakes` walks through both files at once and pairs the wakes, `compare` says what differs within a pair, `whole` compares what the
//! runs say of themselves, and `show` is what people see of it.

mod compare;
mod show;
#[cfg(test)]
mod tests;
mod wakes;
mod whole;

use std::collections::BTreeMap;
use std::io::{self, IsTerminal};
use std::path::Path;

use gleaner_base::{Exit, Explain, Failure};
use gleaner_lambda::Decision;
use gleaner_lambda::manifest::Kind;
use serde::Serialize;

use crate::args::DiffArgs;
use crate::report::{self, TellError};
use crate::results::{Decisions, ResultsError};
use crate::say::say;
use crate::show::{Paint, json_line};

pub(crate) use compare::Difference;
use compare::{Is, Of};

/// So many differences are listed; of those that are rare, so many in any case. The others are counted.
const LISTED: usize = 1_000;
const LISTED_OF_EACH: usize = 20;

/// What differs between two runs.
#[derive(Debug, Serialize)]
pub(crate) struct Diff {
    /// No decision differs.
    pub(crate) same: bool,
    pub(crate) a: Side,
    pub(crate) b: Side,
    /// What makes them hard to compare, such as another drive.
    pub(crate) notes: Vec<String>,
    pub(crate) config: Vec<Change>,
    /// Counts that differ.
    pub(crate) counts: Vec<Change>,
    pub(crate) cost: Vec<Cost>,
    pub(crate) triggers: Tally,
    pub(crate) faults: Tally,
    pub(crate) differences: Vec<Difference>,
    /// Differences that are not listed.
    pub(crate) left_out: u64,
}

/// One of both.
#[derive(Debug, Serialize)]
pub(crate) struct Side {
    pub(crate) out: String,
    pub(crate) lambda: String,
    pub(crate) version: String,
    pub(crate) kind: Kind,
    pub(crate) drive: Vec<String>,
    pub(crate) start_ns: Option<i64>,
}

/// A value that is not the same; `None` where there is none, or nobody knows it.
#[derive(Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Change {
    pub(crate) what: String,
    pub(crate) a: Option<String>,
    pub(crate) b: Option<String>,
}

/// What half of the wakes took at most.
#[derive(Debug, PartialEq, Serialize)]
pub(crate) struct Cost {
    pub(crate) what: &'static str,
    /// `ns` or `fuel`.
    pub(crate) unit: &'static str,
    pub(crate) a: Option<u64>,
    pub(crate) b: Option<u64>,
    /// `b / a`.
    pub(crate) ratio: Option<f64>,
}

/// How many of each.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq, Serialize)]
pub(crate) struct Tally {
    pub(crate) same: u64,
    /// Only the first run has them.
    pub(crate) gone: u64,
    /// Only the second has them.
    pub(crate) new: u64,
    pub(crate) changed: u64,
}

/// Why two runs cannot be compared.
#[derive(Debug, thiserror::Error)]
pub(crate) enum DiffError {
    #[error(transparent)]
    Tell(#[from] TellError),
    #[error(transparent)]
    Read(ResultsError),
    #[error("`{out}` has more than {} wakes, or more than {} MiB of them, at one instant", wakes::AT_ONCE, wakes::BYTES_AT_ONCE >> 20)]
    Crowded { out: String },
}

impl Explain for DiffError {
    fn help(&self) -> Option<String> {
        match self {
            Self::Tell(error) => error.help(),
            Self::Read(_) | Self::Crowded { .. } => {
                Some("name two folders that `gleaner replay` or `gleaner run` wrote to, whole".to_owned())
            }
        }
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

/// Compares, and shows what differs: ends with 0 if the decisions are the same, with 4 if not.
pub(crate) fn run(args: &DiffArgs) -> Result<Exit, Failure> {
    let diff = between(&args.a, &args.b)?;
    let exit = if diff.same { Exit::Ok } else { Exit::Differs };
    say(&if args.json { json_line(&diff) } else { diff.text() })?;
    // Only then: a page that cannot be written must not cost what was found.
    if let Some(path) = &args.report {
        let path = report::write_both(&args.a, &args.b, diff, path)?;
        if !args.json {
            say(&format!("  report: {}\n", path.display()))?;
        }
    }
    Ok(exit)
}

impl Diff {
    /// The differences, for a person at this terminal.
    pub(crate) fn text(&self) -> String {
        show::text(self, Paint::new(io::stdout().is_terminal()))
    }
}

/// What differs between the runs in these folders.
pub(crate) fn between(a: &Path, b: &Path) -> Result<Diff, DiffError> {
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
            diff.notes
                .push("the wakes are not in the order of their times: some may be listed as gone and new".to_owned());
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
    pub(crate) fn is_same(self) -> bool {
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
