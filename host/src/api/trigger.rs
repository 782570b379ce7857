//! What a lambda causes: events, and the start and stop of recordings.

use gleaner_protocol::{Trigger, TriggerKind};
use serde_json::{Map, Value};

use super::Session;

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
}

#[derive(Default)]
pub(super) struct Triggers(Vec<Trigger>);

impl Triggers {
    pub(super) fn into_list(self) -> Vec<Trigger> {
        self.0
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
        self.lock().triggers.as_mut().ok_or(TriggerError::NoWake)?.add(kind, label, score, attributes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A session in the middle of a wake.
    fn session() -> Session {
        let session = Session::new(Vec::new(), Vec::new());
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
