//! Triggers and faults out of `decisions.jsonl`, of which there may be millions: some in detail,
//! all by time, and how many there are.

use std::collections::HashMap;

use gleaner_lambda::{Decision, Fault, FaultKind, Trigger};

use super::density::Density;
use super::html;
use super::model::{Amounts, FaultCause, FaultMark, Mark};
use crate::words::{cut, grouped, seconds, size};

/// Most triggers with all that is known of them, most faults, and most lines of the table of
/// faults.
pub(super) const TRIGGERS_MAX: usize = 5_000;
pub(super) const FAULTS_MAX: usize = 500;
const CAUSES_MAX: usize = 100;

/// Labels with a lane of their own; the others share one.
const LABELS_MAX: usize = 24;
const OTHER_LABELS: &str = "(other labels)";

/// Most characters of a label, and of a fault's message; most bytes of attributes.
const LABEL_CHARS: usize = 120;
const MESSAGE_CHARS: usize = 2_000;
const ATTRIBUTE_BYTES: usize = 2_048;

/// Bytes that texts may take on the page: hostile ones are six times as long there as in their
/// file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Room(pub(super) usize);

impl Room {
    /// Whether something found none.
    fn is_full(self) -> bool {
        self.0 == 0
    }

    /// Whether `value` found room.
    pub(super) fn take(&mut self, value: &impl serde::Serialize) -> bool {
        let bytes = html::json(value).len();
        match self.0.checked_sub(bytes) {
            Some(left) => {
                self.0 = left;
                true
            }
            None => {
                // What comes later is smaller perhaps, but a page with holes would not say where
                // they are.
                self.0 = 0;
                false
            }
        }
    }
}

/// Collects them.
pub(super) struct Marks {
    start_ns: i64,
    pub(super) labels: Vec<String>,
    numbers: HashMap<String, usize>,
    pub(super) triggers: Vec<Mark>,
    pub(super) trigger_density: Density,
    pub(super) fault_kinds: Vec<FaultKind>,
    pub(super) faults: Vec<FaultMark>,
    pub(super) fault_density: Density,
    pub(super) causes: Vec<FaultCause>,
    of_cause: HashMap<(FaultKind, String), usize>,
    pub(super) triggers_seen: u64,
    pub(super) faults_seen: u64,
    pub(super) faults_in_no_line: u64,
    trigger_room: Room,
    fault_room: Room,
}

impl Marks {
    /// None yet, of a drive that starts at `start_ns`; texts of triggers may take `room`, those of
    /// faults half of it.
    pub(super) fn new(start_ns: i64, room: usize) -> Self {
        Self {
            start_ns,
            labels: Vec::new(),
            numbers: HashMap::new(),
            triggers: Vec::new(),
            trigger_density: Density::new(),
            fault_kinds: Vec::new(),
            faults: Vec::new(),
            fault_density: Density::new(),
            causes: Vec::new(),
            of_cause: HashMap::new(),
            triggers_seen: 0,
            faults_seen: 0,
            faults_in_no_line: 0,
            trigger_room: Room(room),
            fault_room: Room(room / 2),
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
        let label = self.number(&trigger.label);
        self.trigger_density.add(label, decision.at_ns.saturating_sub(self.start_ns));
        if self.triggers.len() == TRIGGERS_MAX || self.trigger_room.is_full() {
            return;
        }
        let attributes_cut = html::json(&trigger.attributes).len() > ATTRIBUTE_BYTES;
        let shown = |(name, value): (&String, &serde_json::Value)| {
            // A script would round large whole numbers.
            (name.clone(), value.as_str().map_or_else(|| value.to_string(), str::to_owned))
        };
        let mark = Mark {
            t: seconds(decision.at_ns, self.start_ns),
            at_ns: decision.at_ns,
            label,
            kind: trigger.kind.as_str(),
            score: trigger.score,
            attributes: if attributes_cut {
                Vec::new()
            } else {
                trigger.attributes.iter().map(shown).collect()
            },
            attributes_cut,
            cause: decision.cause,
            topic: decision.topic.as_deref().map(|topic| cut(topic, LABEL_CHARS)),
            seq: decision.seq.map(|seq| seq.to_string()),
            fuel: decision.fuel,
            run_ns: decision.run_ns,
            pictures: Vec::new(),
        };
        if self.trigger_room.take(&mark) {
            self.triggers.push(mark);
        }
    }

    fn number(&mut self, label: &str) -> usize {
        let label = cut(label, LABEL_CHARS);
        if let Some(number) = self.numbers.get(&label) {
            return *number;
        }
        let number = self.labels.len().min(LABELS_MAX);
        if number < LABELS_MAX {
            self.numbers.insert(label.clone(), number);
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
        if self.faults.len() == FAULTS_MAX || self.fault_room.is_full() {
            return;
        }
        let topic = decision.topic.as_deref().map(|topic| cut(topic, LABEL_CHARS));
        let mark = FaultMark { t, lane, message, amounts: amounts(fault), topic };
        if self.fault_room.take(&mark) {
            self.faults.push(mark);
        }
    }

    fn count(&mut self, fault: &Fault, message: &str, t: f64) {
        let cause = (fault.kind, message.to_owned());
        if let Some(number) = self.of_cause.get(&cause) {
            let cause = &mut self.causes[*number];
            cause.count += 1;
            cause.last = t;
        } else if self.causes.len() < CAUSES_MAX {
            let (kind, message) = cause.clone();
            self.of_cause.insert(cause, self.causes.len());
            self.causes.push(FaultCause {
                kind,
                message,
                amounts: amounts(fault),
                count: 1,
                first: t,
                last: t,
            });
        } else {
            self.faults_in_no_line += 1;
        }
    }
}

/// In the unit of the limit.
fn amounts(fault: &Fault) -> Amounts {
    let words = |amount: u64| match fault.kind {
        FaultKind::Memory => size(amount),
        FaultKind::Deadline | FaultKind::Killed => format!("{:.1} ms", amount as f64 / 1e6),
        _ => grouped(amount),
    };
    Amounts { used: fault.used.map(words), allowed: fault.allowed.map(words) }
}
