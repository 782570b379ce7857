//! What came of a wake.

pub use gleaner_rules::triggers::{AttributeValue, Kind as TriggerKind};

/// The outcome of one wake: what a line of `decisions.jsonl` says of it, but for the digits of the
/// writer, fuel and time.
#[derive(Clone, Debug, PartialEq)]
pub struct Decision {
    /// Time of the sample or tick that woke the lambda, in nanoseconds.
    pub at_ns: i64,
    /// What woke it.
    pub cause: Cause,
    /// The input that woke it; none for a tick.
    pub input: Option<String>,
    /// Topic of the waking sample; none for a tick.
    pub topic: Option<String>,
    /// Number of the waking sample; none for a tick.
    pub seq: Option<u64>,
    /// What the lambda caused, in the order in which it did.
    pub triggers: Vec<Trigger>,
    /// Why the wake ended early, if it did. Triggers that came before the fault still count.
    pub fault: Option<Fault>,
}

/// What woke a lambda.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// A sample on the input that `[schedule] event` names.
    Event,
    /// The clock, by `[schedule] period`.
    Tick,
}

/// An action that a lambda took.
#[derive(Clone, Debug, PartialEq)]
pub struct Trigger {
    /// Time of its wake, in nanoseconds.
    pub at_ns: i64,
    /// What the recorder does about it.
    pub kind: TriggerKind,
    /// The lambda's word for what it saw.
    pub label: String,
    /// How strongly, in the unit that the lambda documents; none unless it is an event.
    pub score: Option<f64>,
    /// Named facts, in the order in which the lambda gave them.
    pub attributes: Vec<(String, AttributeValue)>,
}

impl Trigger {
    /// The fact of that name, if the lambda gave it.
    pub fn attribute(&self, key: &str) -> Option<&AttributeValue> {
        self.attributes.iter().find(|(given, _)| given == key).map(|(_, value)| value)
    }
}

/// Why a wake ended early.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// The cause, for programs.
    pub kind: FaultKind,
    /// The cause, for people.
    pub message: String,
    /// What the lambda used, in the unit of the limit that it passed.
    pub used: Option<u64>,
    /// What it was allowed, in the same unit.
    pub allowed: Option<u64>,
}

/// The causes of a fault that there are natively.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum FaultKind {
    /// The lambda returned an error.
    Exception,
    /// The lambda panicked.
    Trap,
    /// It held more handles, or passed more bytes in one call, than `[limits]` allow.
    HostCall,
}
