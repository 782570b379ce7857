//! Decisions of wakes, with their triggers and faults.

pub use gleaner_rules::triggers::{AttributeValue, TriggerKind};

/// The outcome of one wake: the fields of a line of `decisions.jsonl`, except the writer, the fuel
/// and the run time.
#[derive(Clone, Debug, PartialEq)]
pub struct Decision {
    /// Time of the sample or tick that woke the lambda, in nanoseconds.
    pub at_ns: i64,
    /// Cause of the wake.
    pub cause: Cause,
    /// Name of the input whose sample woke the lambda; none for a tick.
    pub input: Option<String>,
    /// Topic of the waking sample; none for a tick.
    pub topic: Option<String>,
    /// Sequence number of the waking sample; none for a tick.
    pub seq: Option<u64>,
    /// Triggers of the wake, in the order of the calls.
    pub triggers: Vec<Trigger>,
    /// The fault that ended the wake early; none if it completed. Triggers before the fault still
    /// count.
    pub fault: Option<Fault>,
}

/// Cause of a wake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// A sample on the input that `[schedule] event` names.
    Event,
    /// A tick of the `[schedule] period`.
    Tick,
}

/// A trigger: an event, or the start or stop of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Trigger {
    /// Time of the wake, in nanoseconds.
    pub at_ns: i64,
    /// Kind of the trigger: an event, or the start or stop of a recording.
    pub kind: TriggerKind,
    /// Label that the lambda gave.
    pub label: String,
    /// Strength of the event, in the unit that the lambda documents; none for `start` and `stop`.
    pub score: Option<f64>,
    /// Attributes, in the order in which the lambda added them.
    pub attributes: Vec<(String, AttributeValue)>,
}

impl Trigger {
    /// Returns the attribute `key`; none if the lambda did not add it.
    pub fn attribute(&self, key: &str) -> Option<&AttributeValue> {
        self.attributes.iter().find(|(given, _)| given == key).map(|(_, value)| value)
    }
}

/// An error that ended a wake early.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// The cause, for programs.
    pub kind: FaultKind,
    /// The cause, for people.
    pub message: String,
    /// Amount that the lambda used, in the unit of the exceeded limit.
    pub used: Option<u64>,
    /// The limit, in the same unit.
    pub allowed: Option<u64>,
}

/// Kind of a fault; natively there are fewer kinds than in the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum FaultKind {
    /// The lambda returned an error.
    Exception,
    /// The lambda panicked.
    Trap,
    /// The lambda held more handles, or passed more bytes in one call, than `[limits]` allows.
    HostCall,
}
