//! Triggers of a lambda: events, and the start and stop of recordings.

use gleaner_lambda::{Trigger, TriggerKind};
pub(super) use gleaner_rules::triggers::Triggers;
pub use gleaner_rules::triggers::{ATTRIBUTES, Attribute, AttributeValue, LABEL_BYTES, PER_WAKE};
use gleaner_rules::triggers::{TriggerError as Refusal, TriggerKind as RuleKind};
use serde_json::Value;

use super::Session;
use super::fuel::OutOfFuel;

/// A refused call; it had no effect.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(transparent)]
pub enum TriggerError {
    Refused(#[from] Refusal),
    OutOfFuel(#[from] OutOfFuel),
}

/// Cases of `trigger-error` in `wit/trigger.wit`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TriggerErrorKind {
    Invalid,
    TooMany,
}

impl TriggerErrorKind {
    /// The name in the WIT.
    pub fn name(self) -> &'static str {
        match self {
            Self::Invalid => "invalid",
            Self::TooMany => "too-many",
        }
    }
}

impl TriggerError {
    /// The case that the lambda receives.
    pub fn kind(&self) -> TriggerErrorKind {
        match self {
            Self::Refused(refusal) if !refusal.is_too_many() => TriggerErrorKind::Invalid,
            // A guest with a fuel allowance is ended instead.
            Self::Refused(_) | Self::OutOfFuel(_) => TriggerErrorKind::TooMany,
        }
    }
}

/// Cost of an attribute in bytes, beside its texts: it is copied into the host before it can be
/// refused.
const ATTRIBUTE_BYTES: usize = 64;

fn work(attribute: &Attribute) -> usize {
    let text = match &attribute.value {
        AttributeValue::Text(text) => text.len(),
        AttributeValue::Boolean(_) | AttributeValue::Signed(_) | AttributeValue::Real(_) => 8,
    };
    ATTRIBUTE_BYTES + attribute.key.len() + text
}

impl Session {
    /// Triggers an event, a moment worth recording. `score` is its strength, in the lambda's own
    /// unit.
    ///
    /// # Errors
    ///
    /// [`TriggerError`] if a limit is exceeded; there is no trigger then.
    pub fn event(
        &self,
        label: &str,
        score: f64,
        attributes: Vec<Attribute>,
    ) -> Result<(), TriggerError> {
        self.cause(TriggerKind::Event, label, Some(score), attributes)
    }

    /// Starts a recording that lasts until [`Session::stop`] with the same label. Fails as
    /// [`Session::event`]: there is no trigger then.
    pub fn start(&self, label: &str, attributes: Vec<Attribute>) -> Result<(), TriggerError> {
        self.cause(TriggerKind::Start, label, None, attributes)
    }

    /// Ends the recording that [`Session::start`] began. Fails as [`Session::event`]: there is
    /// no trigger then.
    pub fn stop(&self, label: &str) -> Result<(), TriggerError> {
        self.cause(TriggerKind::Stop, label, None, Vec::new())
    }

    fn cause(
        &self,
        kind: TriggerKind,
        label: &str,
        score: Option<f64>,
        attributes: Vec<Attribute>,
    ) -> Result<(), TriggerError> {
        self.fuel.charge(|| label.len() + attributes.iter().map(work).sum::<usize>())?;
        let state = &mut *self.lock();
        let caused = state.triggers.cause(
            state.now_ns,
            rule_kind(kind),
            (label, score),
            attributes,
            |attributes| {
                let attributes = attributes
                    .into_iter()
                    .map(|Attribute { key, value }| (key, json(value)))
                    .collect();
                Trigger { kind, label: label.to_owned(), score, attributes }
            },
        );
        Ok(caused?)
    }
}

fn rule_kind(kind: TriggerKind) -> RuleKind {
    match kind {
        TriggerKind::Event => RuleKind::Event,
        TriggerKind::Start => RuleKind::Start,
        TriggerKind::Stop => RuleKind::Stop,
    }
}

fn json(value: AttributeValue) -> Value {
    match value {
        AttributeValue::Boolean(value) => Value::from(value),
        AttributeValue::Signed(value) => Value::from(value),
        AttributeValue::Real(value) => Value::from(value),
        AttributeValue::Text(text) => Value::from(text),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use gleaner_lambda::manifest::Limits;

    use super::*;

    /// A session in the middle of a wake.
    pub(crate) fn session() -> Session {
        let session = Session::new(Vec::new(), Vec::new(), &Limits::default());
        session.begin(0);
        session
    }

    fn real(key: &str, value: f64) -> Attribute {
        Attribute { key: key.to_owned(), value: AttributeValue::Real(value) }
    }

    #[test]
    fn triggers_come_out_in_the_order_of_the_calls() {
        let session = session();
        session.start("rain", vec![real("wet", 0.5)]).unwrap();
        session.event("brake", 3.5, Vec::new()).unwrap();
        let triggers = session.end();
        assert_eq!(
            triggers.iter().map(|trigger| trigger.label.as_str()).collect::<Vec<_>>(),
            ["rain", "brake"]
        );
        assert_eq!(triggers[0].attributes["wet"], 0.5);
        assert_eq!((triggers[0].score, triggers[1].score), (None, Some(3.5)));
    }

    #[test]
    fn the_seventeenth_trigger_of_a_wake_is_refused() {
        let session = session();
        for _ in 0..PER_WAKE {
            session.event("x", 1.0, Vec::new()).unwrap();
        }
        assert_eq!(session.event("x", 1.0, Vec::new()), Err(Refusal::TooMany.into()));
        session.begin(1);
        assert_eq!(session.event("x", 1.0, Vec::new()), Ok(()));
    }

    #[test]
    fn outside_of_a_wake_nothing_can_trigger() {
        let session = session();
        session.event("before", 1.0, Vec::new()).unwrap();
        assert_eq!(
            session.during_init(|| session.event("init", 1.0, Vec::new())),
            Err(Refusal::NoWake.into())
        );
        session.event("after", 1.0, Vec::new()).unwrap();
        assert_eq!(session.end().len(), 2);
        assert_eq!(session.stop("late"), Err(Refusal::NoWake.into()));
    }
}
