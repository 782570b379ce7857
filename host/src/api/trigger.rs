//! What a lambda causes: events, and the start and stop of recordings.

use gleaner_protocol::manifest::Limits;
use gleaner_protocol::{Trigger, TriggerKind};
use serde_json::{Map, Value};

use super::Session;
use super::fuel::OutOfFuel;

/// Triggers that one wake may cause.
pub const PER_WAKE: usize = 16;
/// Attributes that one trigger may carry.
pub const ATTRIBUTES: usize = 16;
/// Longest label, in bytes.
pub const LABEL_BYTES: usize = 128;
/// Longest key of an attribute, in bytes.
pub const KEY_BYTES: usize = 64;
/// Longest text of an attribute, in bytes.
pub const TEXT_BYTES: usize = 1024;

/// A named fact that travels with a trigger.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    /// 1 to [`KEY_BYTES`] bytes, once for each trigger.
    pub key: String,
    /// The fact.
    pub value: AttributeValue,
}

/// Value of an [`Attribute`].
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub enum AttributeValue {
    Boolean(bool),
    Signed(i64),
    /// Finite.
    Real(f64),
    /// At most [`TEXT_BYTES`] bytes.
    Text(String),
}

impl Attribute {
    /// What it costs besides its texts: it was made for the host before it could be refused.
    const BYTES: usize = 64;

    fn work(&self) -> usize {
        let text = match &self.value {
            AttributeValue::Text(text) => text.len(),
            AttributeValue::Boolean(_) | AttributeValue::Signed(_) | AttributeValue::Real(_) => 8,
        };
        Self::BYTES + self.key.len() + text
    }
}

/// A refused call; it had no effect.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs)]
pub enum TriggerError {
    #[error("the label is empty")]
    NoLabel,
    #[error("the label has {bytes} bytes; at most {LABEL_BYTES} are allowed")]
    LongLabel { bytes: usize },
    #[error("the score of `{label}` is {score}; it must be finite")]
    Score { label: String, score: f64 },
    #[error("`{label}` has {given} attributes; at most {ATTRIBUTES} are allowed")]
    Attributes { label: String, given: usize },
    #[error("attribute `{key}` of `{label}`: {why}")]
    Attribute { label: String, key: String, why: &'static str },
    #[error("triggers belong to a wake: in init, and between two wakes, there are none")]
    NoWake,
    #[error("this wake has caused {PER_WAKE} triggers already; further ones are refused")]
    TooMany,
    #[error(
        "the lambda has caused {allowed} triggers in this minute already, `events_per_minute` in [limits]; further ones are refused"
    )]
    TooOften { allowed: u64 },
    #[error(transparent)]
    OutOfFuel(#[from] OutOfFuel),
}

/// Which of the refusals of `wit/trigger.wit` a lambda gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
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
    /// The refusal that a lambda gets.
    pub fn kind(&self) -> TriggerErrorKind {
        match self {
            Self::NoLabel
            | Self::LongLabel { .. }
            | Self::Score { .. }
            | Self::Attributes { .. }
            | Self::Attribute { .. }
            | Self::NoWake => TriggerErrorKind::Invalid,
            // Whoever can end a guest for want of fuel ends it instead.
            Self::TooMany | Self::TooOften { .. } | Self::OutOfFuel(_) => TriggerErrorKind::TooMany,
        }
    }
}

const MINUTE_NS: i64 = 60_000_000_000;

/// Triggers in this minute of the lambda's time.
pub(super) struct Rate {
    allowed: u64,
    minute: i64,
    caused: u64,
    refused: u64,
}

impl Rate {
    pub(super) fn new(limits: &Limits) -> Self {
        Self { allowed: limits.events_per_minute, minute: 0, caused: 0, refused: 0 }
    }

    pub(super) fn refused(&self) -> u64 {
        self.refused
    }

    /// Adds triggers that were refused in another process.
    pub(super) fn relay(&mut self, refused: u64) {
        self.refused = self.refused.saturating_add(refused);
    }

    /// Whether one more may be caused.
    fn check(&mut self, at_ns: i64) -> Result<(), TriggerError> {
        let minute = at_ns.div_euclid(MINUTE_NS);
        if self.minute != minute {
            (self.minute, self.caused) = (minute, 0);
        }
        if self.caused < self.allowed {
            return Ok(());
        }
        self.refused += 1;
        Err(TriggerError::TooOften { allowed: self.allowed })
    }
}

#[derive(Default)]
pub(super) struct Triggers(Vec<Trigger>);

impl Triggers {
    pub(super) fn into_list(self) -> Vec<Trigger> {
        self.0
    }

    pub(super) fn list(&self) -> &[Trigger] {
        &self.0
    }

    fn add(
        &mut self,
        kind: TriggerKind,
        label: &str,
        score: Option<f64>,
        attributes: Vec<Attribute>,
    ) -> Result<(), TriggerError> {
        if self.0.len() >= PER_WAKE {
            return Err(TriggerError::TooMany);
        }
        match label.len() {
            0 => return Err(TriggerError::NoLabel),
            bytes if bytes > LABEL_BYTES => return Err(TriggerError::LongLabel { bytes }),
            _ => {}
        }
        let label = label.to_owned();
        if let Some(score) = score.filter(|score| !score.is_finite()) {
            return Err(TriggerError::Score { label, score });
        }
        let attributes = checked(&label, attributes)?;
        self.0.push(Trigger { kind, label, score, attributes });
        Ok(())
    }
}

fn checked(label: &str, attributes: Vec<Attribute>) -> Result<Map<String, Value>, TriggerError> {
    if attributes.len() > ATTRIBUTES {
        return Err(TriggerError::Attributes { label: label.to_owned(), given: attributes.len() });
    }
    let mut map = Map::new();
    for Attribute { key, value } in attributes {
        let refuse = |why| TriggerError::Attribute {
            label: label.to_owned(),
            key: super::log::cut(&key, KEY_BYTES).to_owned(),
            why,
        };
        if key.is_empty() || key.len() > KEY_BYTES {
            return Err(refuse("the key must have 1 to 64 bytes"));
        }
        let value = match value {
            AttributeValue::Boolean(value) => Value::from(value),
            AttributeValue::Signed(value) => Value::from(value),
            AttributeValue::Real(value) if !value.is_finite() => return Err(refuse("the value must be finite")),
            AttributeValue::Real(value) => Value::from(value),
            AttributeValue::Text(text) if text.len() > TEXT_BYTES => {
                return Err(refuse("the text must have at most 1,024 bytes"));
            }
            AttributeValue::Text(text) => Value::from(text),
        };
        if map.contains_key(&key) {
            return Err(refuse("the key is given twice"));
        }
        map.insert(key, value);
    }
    Ok(map)
}

impl Session {
    /// Something worth keeping happened. `score` says how strongly, in the lambda's own unit.
    ///
    /// # Errors
    ///
    /// [`TriggerError`] if a limit of this file is passed; nothing is caused then.
    pub fn event(&self, label: &str, score: f64, attributes: Vec<Attribute>) -> Result<(), TriggerError> {
        self.cause(TriggerKind::Event, label, Some(score), attributes)
    }

    /// Starts a recording that lasts until [`Session::stop`] with the same label.
    ///
    /// # Errors
    ///
    /// As [`Session::event`].
    pub fn start(&self, label: &str, attributes: Vec<Attribute>) -> Result<(), TriggerError> {
        self.cause(TriggerKind::Start, label, None, attributes)
    }

    /// Ends the recording that [`Session::start`] began.
    ///
    /// # Errors
    ///
    /// As [`Session::event`].
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
        self.fuel.charge(|| label.len() + attributes.iter().map(Attribute::work).sum::<usize>())?;
        let state = &mut *self.lock();
        let triggers = state.triggers.as_mut().ok_or(TriggerError::NoWake)?;
        // Who has used up the minute may still end what was begun.
        if kind != TriggerKind::Stop {
            state.rate.check(state.now_ns)?;
        }
        triggers.add(kind, label, score, attributes)?;
        state.rate.caused += 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A session in the middle of a wake.
    fn session() -> Session {
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
        assert_eq!(triggers.iter().map(|trigger| trigger.label.as_str()).collect::<Vec<_>>(), ["rain", "brake"]);
        assert_eq!(triggers[0].attributes["wet"], 0.5);
        assert_eq!((triggers[0].score, triggers[1].score), (None, Some(3.5)));
    }

    #[test]
    fn the_seventeenth_trigger_of_a_wake_is_refused() {
        let session = session();
        for _ in 0..PER_WAKE {
            session.event("x", 1.0, Vec::new()).unwrap();
        }
        assert_eq!(session.event("x", 1.0, Vec::new()), Err(TriggerError::TooMany));
        session.begin(1);
        assert_eq!(session.event("x", 1.0, Vec::new()), Ok(()));
    }

    #[test]
    fn triggers_beyond_those_of_a_minute_are_refused_by_name_and_counted() {
        let mut limits = Limits::default();
        limits.events_per_minute = 2;
        let session = Session::new(Vec::new(), Vec::new(), &limits);
        let event = |at_ns| {
            session.begin(at_ns);
            session.event("x", 1.0, Vec::new())
        };
        assert_eq!([event(0), event(1)], [Ok(()), Ok(())]);
        // What is refused for another reason does not count.
        assert_eq!(session.event("", 1.0, Vec::new()), Err(TriggerError::TooOften { allowed: 2 }));
        assert_eq!(event(MINUTE_NS - 1), Err(TriggerError::TooOften { allowed: 2 }));
        assert_eq!(session.triggers_refused(), 2);
        session.begin(MINUTE_NS);
        assert_eq!(session.event("", 1.0, Vec::new()), Err(TriggerError::NoLabel));
        assert_eq!([event(MINUTE_NS), event(MINUTE_NS), event(0)], [Ok(()), Ok(()), Ok(())]);
    }

    #[test]
    fn outside_of_a_wake_nothing_can_be_caused() {
        let session = session();
        session.event("before", 1.0, Vec::new()).unwrap();
        assert_eq!(session.during_init(|| session.event("init", 1.0, Vec::new())), Err(TriggerError::NoWake));
        session.event("after", 1.0, Vec::new()).unwrap();
        assert_eq!(session.end().len(), 2);
        assert_eq!(session.stop("late"), Err(TriggerError::NoWake));
    }

    #[test]
    fn what_would_break_the_record_is_refused_by_name() {
        let session = session();
        let refused = |result: Result<(), TriggerError>| result.unwrap_err().to_string();
        assert_eq!(refused(session.event("", 1.0, Vec::new())), "the label is empty");
        assert_eq!(
            refused(session.event(&"x".repeat(129), 1.0, Vec::new())),
            "the label has 129 bytes; at most 128 are allowed"
        );
        assert_eq!(refused(session.event("a", f64::NAN, Vec::new())), "the score of `a` is NaN; it must be finite");
        assert_eq!(
            refused(session.event("a", 1.0, vec![real("k", f64::INFINITY)])),
            "attribute `k` of `a`: the value must be finite"
        );
        assert_eq!(
            refused(session.event("a", 1.0, vec![real("k", 1.0), real("k", 2.0)])),
            "attribute `k` of `a`: the key is given twice"
        );
        assert_eq!(
            refused(session.event("a", 1.0, (0..17).map(|i| real(&i.to_string(), 0.0)).collect())),
            "`a` has 17 attributes; at most 16 are allowed"
        );
        assert!(session.end().is_empty());
    }
}
