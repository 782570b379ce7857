//! What differs between two wakes.

use gleaner_lambda::{Decision, Fault, SCORE_TOLERANCE, Trigger, TriggerKind};
use serde::Serialize;
use serde_json::{Map, Value};

use crate::words::{cut, fault_kind, gist, score, seconds};

/// Most characters of what is said of one difference.
const CHARS: usize = 300;

/// What a difference is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Of {
    /// A trigger.
    Trigger,
    /// A fault.
    Fault,
}

/// What became of it in the second run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Is {
    /// Only the first run has it.
    Gone,
    /// Only the second run has it.
    New,
    /// Both have it, not alike.
    Changed,
}

/// A trigger or a fault that both runs do not have alike.
#[derive(Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Time of the wake, in ns since the epoch of the drive.
    pub at_ns: i64,
    /// The same, in s after the start of the first run's drive.
    pub t: f64,
    /// A trigger or a fault.
    pub of: Of,
    /// What became of it.
    pub is: Is,
    /// The topic of the sample that woke it; `None` for a tick.
    pub topic: Option<String>,
    /// Its label; of a fault, its kind.
    pub label: String,
    /// Score or message; of what changed, before and after.
    pub detail: String,
}

/// What is alike and what is not, in one wake.
#[derive(Debug, Default)]
pub(super) struct Found {
    pub(super) same_triggers: u64,
    pub(super) same_fault: bool,
    pub(super) differences: Vec<Difference>,
}

/// Compares a wake of both runs; in one of them there may be none that triggered or faulted.
pub(super) fn wakes(a: Option<&Decision>, b: Option<&Decision>, start_ns: i64) -> Found {
    let mut found = Found::default();
    let Some(wake) = a.or(b) else { return found };
    let mut note = |of, is, label: &str, detail: String| {
        found.differences.push(Difference {
            at_ns: wake.at_ns,
            t: seconds(wake.at_ns, start_ns),
            of,
            is,
            topic: wake.topic.as_deref().map(short),
            label: short(label),
            detail: short(&detail),
        });
    };

    for (a, b) in pairs(triggers(a), triggers(b)) {
        match (a, b) {
            (Some(a), Some(b)) => match changes(a, b) {
                None => found.same_triggers += 1,
                Some((label, detail)) => note(Of::Trigger, Is::Changed, &label, detail),
            },
            (Some(a), None) => note(Of::Trigger, Is::Gone, &named(a), score(a)),
            (None, Some(b)) => note(Of::Trigger, Is::New, &named(b), score(b)),
            (None, None) => {}
        }
    }

    match (fault(a), fault(b)) {
        (None, None) => {}
        (Some(a), None) => note(Of::Fault, Is::Gone, &kind(a), first_line(a)),
        (None, Some(b)) => note(Of::Fault, Is::New, &kind(b), first_line(b)),
        (Some(a), Some(b)) if a.kind == b.kind && a.message == b.message => found.same_fault = true,
        (Some(a), Some(b)) if a.kind == b.kind => {
            note(
                Of::Fault,
                Is::Changed,
                &kind(a),
                format!("{} → {}", first_line(a), first_line(b)),
            );
        }
        (Some(a), Some(b)) => {
            let kinds = format!("{} → {}", kind(a), kind(b));
            note(Of::Fault, Is::Changed, &kinds, format!("{} → {}", first_line(a), first_line(b)));
        }
    }
    found
}

fn triggers(wake: Option<&Decision>) -> &[Trigger] {
    wake.map_or(&[], |wake| &wake.triggers)
}

fn fault(wake: Option<&Decision>) -> Option<&Fault> {
    wake?.fault.as_ref()
}

/// Triggers of one wake in pairs: first those of one kind and label, in their order; of the others,
/// those at the same place.
fn pairs<'a>(
    a: &'a [Trigger],
    b: &'a [Trigger],
) -> Vec<(Option<&'a Trigger>, Option<&'a Trigger>)> {
    let mut left: Vec<Option<&Trigger>> = b.iter().map(Some).collect();
    let mut take = |wanted: &Trigger| {
        let is_it = |other: &Option<&Trigger>| other.is_some_and(|other| is_alike(wanted, other));
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

fn is_alike(a: &Trigger, b: &Trigger) -> bool {
    a.kind == b.kind && a.label == b.label
}

/// Label, and what else is not the same, if anything is not.
fn changes(a: &Trigger, b: &Trigger) -> Option<(String, String)> {
    let label = if is_alike(a, b) { named(a) } else { format!("{} → {}", named(a), named(b)) };
    let mut said = Vec::new();
    let same_score = match (a.score, b.score) {
        (Some(a), Some(b)) => is_near(a, b),
        (None, None) => true,
        _ => false,
    };
    if !same_score {
        let both = [a, b].map(score);
        let both = if both[0] == both[1] { [a, b].map(exact) } else { both };
        said.push(format!("score {} → {}", both[0], both[1]));
    }
    said.extend(attributes(&a.attributes, &b.attributes));
    (!said.is_empty() || !is_alike(a, b)).then(|| (label, said.join(", ")))
}

fn attributes(a: &Map<String, Value>, b: &Map<String, Value>) -> Vec<String> {
    let word = |value: Option<&Value>| value.map_or("none".to_owned(), Value::to_string);
    let changed =
        a.iter().filter(|(key, value)| !b.get(*key).is_some_and(|other| is_same(value, other)));
    let gone =
        changed.map(|(key, value)| format!("{key} {} → {}", word(Some(value)), word(b.get(key))));
    let new = b.iter().filter(|(key, _)| !a.contains_key(*key));
    gone.chain(new.map(|(key, value)| format!("{key} none → {}", word(Some(value))))).collect()
}

/// Numbers with a fraction within the tolerance of scores, all else exactly.
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

fn kind(fault: &Fault) -> String {
    fault_kind(fault.kind)
}

fn first_line(fault: &Fault) -> String {
    gist(&fault.message).to_owned()
}

/// `text`, or its begin.
pub(super) fn short(text: &str) -> String {
    cut(text, CHARS)
}
