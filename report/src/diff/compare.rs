//! Compares two wakes: their triggers, one by one, and their faults.

use gleaner_lambda::{Decision, Fault, SCORE_TOLERANCE, Trigger, TriggerKind};
use serde::Serialize;
use serde_json::{Map, Value};

use crate::format::{cut, fault_kind, gist, score, seconds};

/// Maximum number of characters of each text in a [`Difference`].
const CHARS: usize = 300;

/// The part of a decision that differs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DifferenceKind {
    Trigger,
    Fault,
}

/// The change from the first run to the second.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ChangeKind {
    /// Only the first run has it.
    Removed,
    /// Only the second run has it.
    Added,
    /// Both runs have it, with different values.
    Changed,
}

/// A trigger or a fault that differs between the runs.
#[derive(Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Time of the wake, in ns since the epoch of the drive.
    pub at_ns: i64,
    /// Time of the wake, in s after the start of the first run's drive.
    pub t: f64,
    pub kind: DifferenceKind,
    pub change: ChangeKind,
    /// Topic of the sample that caused the wake; `None` for a tick.
    pub topic: Option<String>,
    /// Label of the trigger, or kind of the fault.
    pub label: String,
    /// Score or message; for a change, the values before and after.
    pub detail: String,
}

#[derive(Debug, Default)]
pub(super) struct WakeComparison {
    pub(super) identical_triggers: u64,
    pub(super) has_identical_fault: bool,
    pub(super) differences: Vec<Difference>,
}

/// Compares a wake of both runs; `None` for a run in which it neither triggered nor faulted.
pub(super) fn wakes(a: Option<&Decision>, b: Option<&Decision>, start_ns: i64) -> WakeComparison {
    let mut compared = WakeComparison::default();
    let Some(wake) = a.or(b) else { return compared };
    let mut note = |kind, change, label: &str, detail: String| {
        compared.differences.push(Difference {
            at_ns: wake.at_ns,
            t: seconds(wake.at_ns, start_ns),
            kind,
            change,
            topic: wake.topic.as_deref().map(short),
            label: short(label),
            detail: short(&detail),
        });
    };

    for (a, b) in pairs(triggers(a), triggers(b)) {
        let trigger = DifferenceKind::Trigger;
        match (a, b) {
            (Some(a), Some(b)) => match changes(a, b) {
                None => compared.identical_triggers += 1,
                Some((label, detail)) => note(trigger, ChangeKind::Changed, &label, detail),
            },
            (Some(a), None) => note(trigger, ChangeKind::Removed, &named(a), score(a)),
            (None, Some(b)) => note(trigger, ChangeKind::Added, &named(b), score(b)),
            (None, None) => {}
        }
    }

    let kind = DifferenceKind::Fault;
    match (fault(a), fault(b)) {
        (None, None) => {}
        (Some(a), None) => note(kind, ChangeKind::Removed, &fault_kind(a.kind), first_line(a)),
        (None, Some(b)) => note(kind, ChangeKind::Added, &fault_kind(b.kind), first_line(b)),
        (Some(a), Some(b)) if a.kind == b.kind && a.message == b.message => {
            compared.has_identical_fault = true;
        }
        (Some(a), Some(b)) => {
            let [kind_a, kind_b] = [a, b].map(|fault| fault_kind(fault.kind));
            let kinds = if a.kind == b.kind { kind_a } else { format!("{kind_a} → {kind_b}") };
            let lines = format!("{} → {}", first_line(a), first_line(b));
            note(kind, ChangeKind::Changed, &kinds, lines);
        }
    }
    compared
}

fn triggers(wake: Option<&Decision>) -> &[Trigger] {
    wake.map_or(&[], |wake| &wake.triggers)
}

fn fault(wake: Option<&Decision>) -> Option<&Fault> {
    wake?.fault.as_ref()
}

/// Pairs the triggers of one wake: first by kind and label, in their order; then the others by
/// position.
fn pairs<'a>(
    a: &'a [Trigger],
    b: &'a [Trigger],
) -> Vec<(Option<&'a Trigger>, Option<&'a Trigger>)> {
    let mut left: Vec<Option<&Trigger>> = b.iter().map(Some).collect();
    let mut take = |wanted: &Trigger| {
        let is_it =
            |other: &Option<&Trigger>| other.is_some_and(|other| has_same_name(wanted, other));
        left.iter_mut().find(|other| is_it(other)).and_then(Option::take)
    };
    let mut pairs: Vec<_> = a.iter().map(|a| (Some(a), take(a))).collect();
    let mut rest = left.into_iter().flatten();
    for pair in pairs.iter_mut().filter(|pair| pair.1.is_none()) {
        pair.1 = rest.next();
    }
    pairs.extend(rest.map(|b| (None, Some(b))));
    pairs
}

fn has_same_name(a: &Trigger, b: &Trigger) -> bool {
    a.kind == b.kind && a.label == b.label
}

/// Returns the label and the other values that differ; `None` if the triggers are identical.
fn changes(a: &Trigger, b: &Trigger) -> Option<(String, String)> {
    let label =
        if has_same_name(a, b) { named(a) } else { format!("{} → {}", named(a), named(b)) };
    let mut values = Vec::new();
    let same_score = match (a.score, b.score) {
        (Some(a), Some(b)) => is_near(a, b),
        (None, None) => true,
        _ => false,
    };
    if !same_score {
        let both = [a, b].map(score);
        let both = if both[0] == both[1] { [a, b].map(exact) } else { both };
        values.push(format!("score {} → {}", both[0], both[1]));
    }
    values.extend(attributes(&a.attributes, &b.attributes));
    (!values.is_empty() || !has_same_name(a, b)).then(|| (label, values.join(", ")))
}

fn attributes(a: &Map<String, Value>, b: &Map<String, Value>) -> Vec<String> {
    let word = |value: Option<&Value>| value.map_or("none".to_owned(), Value::to_string);
    let changed =
        a.iter().filter(|(key, value)| !b.get(*key).is_some_and(|other| is_same(value, other)));
    let removed =
        changed.map(|(key, value)| format!("{key} {} → {}", word(Some(value)), word(b.get(key))));
    let added = b.iter().filter(|(key, _)| !a.contains_key(*key));
    removed.chain(added.map(|(key, value)| format!("{key} none → {}", word(Some(value))))).collect()
}

/// Returns whether numbers with a fraction are within the tolerance of scores, and other values are
/// equal.
fn is_same(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Number(x), Value::Number(y)) if x.is_f64() || y.is_f64() => {
            x.as_f64().zip(y.as_f64()).is_some_and(|(x, y)| is_near(x, y))
        }
        _ => a == b,
    }
}

fn is_near(a: f64, b: f64) -> bool {
    a == b || (a - b).abs() <= SCORE_TOLERANCE * a.abs().max(b.abs())
}

fn named(trigger: &Trigger) -> String {
    match trigger.kind {
        TriggerKind::Event => trigger.label.clone(),
        kind => format!("{}, {}", trigger.label, kind.as_str()),
    }
}

fn exact(trigger: &Trigger) -> String {
    trigger.score.map_or("-".to_owned(), |score| score.to_string())
}

fn first_line(fault: &Fault) -> String {
    gist(&fault.message).to_owned()
}

/// Cuts `text` to [`CHARS`] characters.
pub(super) fn short(text: &str) -> String {
    cut(text, CHARS)
}
