//! Compares the triggers in a clip's metadata with those in its journal.

use gleaner_base::excerpt;
use gleaner_journal::{Difference, JournalEntry};
use gleaner_lambda::Moment;
use gleaner_recorder::ClipStatements;

use super::counts_differ;

/// Maximum number of triggers that a clip lists.
const KEPT: usize = 10_000;

pub(super) struct JournalTriggers {
    lambda: String,
    pub(super) count: u64,
    /// The first [`KEPT`] of them.
    moments: Vec<Moment>,
    /// Stamps of the first and the last wake.
    span: Option<(i64, i64)>,
}

/// Number of times that a lambda was started again within a clip.
pub(super) fn restarts(stated: &ClipStatements, lambda: &str) -> usize {
    let processes = stated.clip().lambdas.iter().filter(|process| process.name == lambda);
    processes.count().saturating_sub(1)
}

impl JournalTriggers {
    pub(super) fn of(lambda: &str) -> Self {
        Self { lambda: lambda.to_owned(), count: 0, moments: Vec::new(), span: None }
    }

    pub(super) fn add(&mut self, entry: &JournalEntry) {
        let (first, _) = self.span.unwrap_or((entry.at_ns, entry.at_ns));
        self.span = Some((first, entry.at_ns));
        for trigger in &entry.triggers {
            self.count += 1;
            if self.moments.len() < KEPT {
                self.moments.push(Moment::of(&self.lambda, trigger, entry.at_ns));
            }
        }
    }

    /// Returns the first difference from the triggers that the clip lists.
    pub(super) fn differ(&self, stated: &ClipStatements) -> Option<Difference> {
        let clip = stated.clip();
        // In `incomplete`, a clip notes that its journal lacks wakes, whose triggers cannot be
        // reproduced.
        let lacking = format!("the journal of {} lacks ", self.lambda);
        // Each process of a lambda has a journal of its own.
        let is_short = clip.incomplete.iter().any(|why| why.starts_with(&lacking))
            || restarts(stated, &self.lambda) > 0;
        let is_here = |at_ns: i64| {
            !is_short || self.span.is_some_and(|(first, last)| (first..=last).contains(&at_ns))
        };
        // A command is no trigger of the lambda, and not in its journal.
        let is_own = |moment: &&Moment| moment.lambda == self.lambda && moment.source.is_none();
        let mut listed =
            stated.moments().iter().filter(is_own).filter(|moment| is_here(moment.at_ns));
        let mut reproduced = self.moments.iter();
        // All lambdas of a clip share its limit.
        let is_full = stated.moments().len() >= KEPT;
        for number in 1.. {
            let (journal, now) = (reproduced.next(), listed.next());
            if now.is_none() && (journal.is_none() || is_full) {
                break;
            }
            let record =
                format!("record gleaner.decision of trigger {number} of lambda `{}`", self.lambda);
            let label = |moment: &Moment| {
                excerpt(&format!(
                    "{} `{}` at {} ns",
                    moment.kind.as_str(),
                    moment.label,
                    moment.at_ns
                ))
            };
            let (what, journal, now) = match (journal, now) {
                (Some(journal), Some(now)) => match journal.differs_from(now) {
                    None => continue,
                    Some((key, [journal, now])) => {
                        (format!("`{key}` of {record}"), excerpt(&journal), excerpt(&now))
                    }
                },
                (journal, now) => {
                    let side =
                        |moment: Option<&Moment>| moment.map_or_else(|| "none".to_owned(), label);
                    (record, side(journal), side(now))
                }
            };
            return Some(Difference { what, journal, now });
        }
        let others = stated.moments().iter().filter(|moment| !is_own(moment)).count() as u64;
        match is_short || is_full && others > 0 {
            true => None,
            false => counts_differ(
                "`triggers` of record gleaner.clip",
                self.count + others,
                clip.triggers,
            ),
        }
    }
}
