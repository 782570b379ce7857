//! Collects triggers and faults from `decisions.jsonl`, which may have millions: some of them in
//! detail, all of them by time and by count.

use std::collections::HashMap;

use gleaner_lambda::{Decision, Fault, FaultKind, Trigger};

use super::density::Density;
use super::html;
use super::model::{Amounts, FaultCause, FaultEvent, TriggerEvent};
use crate::format::{cut, grouped, seconds, size, without_numbers};

/// Maximum number of triggers with details.
pub(super) const TRIGGERS_MAX: usize = 5_000;
/// Maximum number of faults with details.
pub(super) const FAULTS_MAX: usize = 500;
/// Maximum number of rows in the table of faults.
const CAUSES_MAX: usize = 100;

/// Labels with their own lane; the others share one.
const LABELS_MAX: usize = 24;
const OTHER_LABELS: &str = "(other labels)";

const LABEL_CHARS: usize = 120;
const MESSAGE_CHARS: usize = 2_000;
/// Maximum size of the attributes of a trigger, in bytes of JSON.
const ATTRIBUTE_BYTES: usize = 2_048;

/// Remaining bytes for texts on the page. Escaped texts may take six times their size in the file.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct TextBudget(pub(super) usize);

impl TextBudget {
    /// Returns whether a text has been omitted.
    fn is_full(self) -> bool {
        self.0 == 0
    }

    /// Takes the bytes of `value`; returns false if they exceed the budget.
    pub(super) fn take(&mut self, value: &impl serde::Serialize) -> bool {
        let bytes = html::json(value).len();
        match self.0.checked_sub(bytes) {
            Some(left) => {
                self.0 = left;
                true
            }
            None => {
                // A later, smaller value might fit, but the gaps in such a page would not be
                // visible.
                self.0 = 0;
                false
            }
        }
    }
}

#[derive(Default)]
pub(super) struct Events {
    start_ns: i64,
    pub(super) labels: Vec<String>,
    label_numbers: HashMap<String, usize>,
    pub(super) triggers: Vec<TriggerEvent>,
    pub(super) trigger_density: Density,
    pub(super) fault_kinds: Vec<FaultKind>,
    pub(super) faults: Vec<FaultEvent>,
    pub(super) fault_density: Density,
    pub(super) causes: Vec<FaultCause>,
    cause_numbers: HashMap<(FaultKind, String), usize>,
    pub(super) triggers_seen: u64,
    pub(super) faults_seen: u64,
    pub(super) unlisted_faults: u64,
    trigger_budget: TextBudget,
    fault_budget: TextBudget,
}

impl Events {
    /// Creates an empty collection for a run that starts at `start_ns`. Texts of triggers may take
    /// `budget` bytes, those of faults half of it.
    pub(super) fn new(start_ns: i64, budget: usize) -> Self {
        Self {
            start_ns,
            trigger_budget: TextBudget(budget),
            fault_budget: TextBudget(budget / 2),
            ..Self::default()
        }
    }

    pub(super) fn add(&mut self, decision: &Decision) {
        for trigger in &decision.triggers {
            self.trigger(decision, trigger);
        }
        if let Some(fault) = &decision.fault {
            self.fault(decision, fault);
        }
    }

    fn trigger(&mut self, decision: &Decision, trigger: &Trigger) {
        self.triggers_seen += 1;
        let label = self.label_number(&trigger.label);
        self.trigger_density.add(label, decision.at_ns.saturating_sub(self.start_ns));
        if self.triggers.len() == TRIGGERS_MAX || self.trigger_budget.is_full() {
            return;
        }
        let attributes_omitted = html::json(&trigger.attributes).len() > ATTRIBUTE_BYTES;
        let shown = |(name, value): (&String, &serde_json::Value)| {
            // As text, since a script would round large integers.
            (name.clone(), value.as_str().map_or_else(|| value.to_string(), str::to_owned))
        };
        let event = TriggerEvent {
            t: seconds(decision.at_ns, self.start_ns),
            at_ns: decision.at_ns,
            label,
            kind: trigger.kind.as_str(),
            score: trigger.score,
            attributes: if attributes_omitted {
                Vec::new()
            } else {
                trigger.attributes.iter().map(shown).collect()
            },
            attributes_omitted,
            cause: decision.cause,
            topic: decision.topic.as_deref().map(|topic| cut(topic, LABEL_CHARS)),
            seq: decision.seq.map(|seq| seq.to_string()),
            fuel: decision.fuel,
            run_ns: decision.run_ns,
            pictures: Vec::new(),
        };
        if self.trigger_budget.take(&event) {
            self.triggers.push(event);
        }
    }

    fn label_number(&mut self, label: &str) -> usize {
        let label = cut(label, LABEL_CHARS);
        if let Some(number) = self.label_numbers.get(&label) {
            return *number;
        }
        let number = self.labels.len().min(LABELS_MAX);
        if number < LABELS_MAX {
            self.label_numbers.insert(label.clone(), number);
            self.labels.push(label);
        } else if self.labels.len() == LABELS_MAX {
            self.labels.push(OTHER_LABELS.to_owned());
        }
        number
    }

    fn fault(&mut self, decision: &Decision, fault: &Fault) {
        self.faults_seen += 1;
        let lane =
            self.fault_kinds.iter().position(|kind| *kind == fault.kind).unwrap_or_else(|| {
                self.fault_kinds.push(fault.kind);
                self.fault_kinds.len() - 1
            });
        self.fault_density.add(lane, decision.at_ns.saturating_sub(self.start_ns));
        let t = seconds(decision.at_ns, self.start_ns);
        let message = cut(&fault.message, MESSAGE_CHARS);
        self.count(fault, &message, t);
        if self.faults.len() == FAULTS_MAX || self.fault_budget.is_full() {
            return;
        }
        let topic = decision.topic.as_deref().map(|topic| cut(topic, LABEL_CHARS));
        let event = FaultEvent { t, lane, message, amounts: amounts(fault), topic };
        if self.fault_budget.take(&event) {
            self.faults.push(event);
        }
    }

    fn count(&mut self, fault: &Fault, message: &str, t: f64) {
        let cause = (fault.kind, without_numbers(message));
        if let Some(number) = self.cause_numbers.get(&cause) {
            let cause = &mut self.causes[*number];
            cause.count += 1;
            cause.last = t;
        } else if self.causes.len() < CAUSES_MAX {
            self.cause_numbers.insert(cause, self.causes.len());
            self.causes.push(FaultCause {
                kind: fault.kind,
                message: message.to_owned(),
                amounts: amounts(fault),
                count: 1,
                first: t,
                last: t,
            });
        } else {
            self.unlisted_faults += 1;
        }
    }
}

/// Formats the used and the allowed amount, in the unit of the limit.
fn amounts(fault: &Fault) -> Amounts {
    let words = |amount: u64| match fault.kind {
        FaultKind::Memory => size(amount),
        FaultKind::Deadline | FaultKind::Killed => format!("{:.1} ms", amount as f64 / 1e6),
        _ => grouped(amount),
    };
    Amounts { used: fault.used.map(words), allowed: fault.allowed.map(words) }
}
