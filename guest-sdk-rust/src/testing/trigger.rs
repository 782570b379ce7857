//! `gleaner:lambda/trigger`: what a lambda causes, checked and counted as by the host.

use super::decision::{Trigger, TriggerKind};
use super::log::cut;
use super::manifest::Limits;
use super::session::current;
use super::types::refusal;

const PER_WAKE: usize = 16;
const ATTRIBUTES: usize = 16;
const LABEL_BYTES: usize = 128;
const KEY_BYTES: usize = 64;
const TEXT_BYTES: usize = 1024;
const MINUTE_NS: i64 = 60_000_000_000;

/// A named fact that travels with the trigger into the clip.
#[derive(Clone, Debug)]
pub struct Attribute {
    /// 1 to 64 bytes.
    pub key: String,
    /// The fact.
    pub value: AttributeValue,
}

/// The fact itself.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub enum AttributeValue {
    Boolean(bool),
    Signed(i64),
    /// Finite.
    Real(f64),
    /// At most 1,024 bytes.
    Text(String),
}

/// The call is refused and had no effect. The message names the limit.
#[derive(Clone, Debug)]
pub enum TriggerError {
    /// No wake; label empty or over 128 bytes; score or value not finite; key empty, over 64 bytes or given twice; text over
    /// 1,024 bytes; more than 16 attributes.
    Invalid(String),
    /// More than 16 triggers in one wake, or more than `events_per_minute` of `[limits]`.
    TooMany(String),
}

refusal!(TriggerError);

type Answer = Result<(), TriggerError>;

pub(crate) fn event(label: &str, score: f64, attributes: &[Attribute]) -> Answer {
    cause(TriggerKind::Event, label, Some(score), attributes)
}

pub(crate) fn start(label: &str, attributes: &[Attribute]) -> Answer {
    cause(TriggerKind::Start, label, None, attributes)
}

pub(crate) fn stop(label: &str) -> Answer {
    cause(TriggerKind::Stop, label, None, &[])
}

fn cause(kind: TriggerKind, label: &str, score: Option<f64>, attributes: &[Attribute]) -> Answer {
    let session = current();
    let text = |value: &AttributeValue| if let AttributeValue::Text(text) = value { text.len() } else { 0 };
    let texts = attributes.iter().map(|attribute| attribute.key.len() + text(&attribute.value)).sum::<usize>();
    session.passed(label.len() + texts);
    let state = &mut *session.lock();
    let Some(triggers) = &mut state.triggers else {
        let why = "triggers belong to a wake: in init, and between two wakes, there are none";
        return Err(TriggerError::Invalid(why.to_owned()));
    };
    // Who has used up the minute may still end what was begun.
    if kind != TriggerKind::Stop {
        state.rate.check(state.now_ns)?;
    }
    if triggers.len() >= PER_WAKE {
        let why = format!("this wake has caused {PER_WAKE} triggers already; further ones are refused");
        return Err(TriggerError::TooMany(why));
    }
    let trigger = Trigger { at_ns: state.now_ns, kind, label: label.to_owned(), score, attributes: Vec::new() };
    triggers.push(checked(trigger, attributes).map_err(TriggerError::Invalid)?);
    state.rate.caused += 1;
    Ok(())
}

fn checked(mut trigger: Trigger, attributes: &[Attribute]) -> Result<Trigger, String> {
    let label = &trigger.label;
    match label.len() {
        0 => return Err("the label is empty".to_owned()),
        bytes if bytes > LABEL_BYTES => {
            return Err(format!("the label has {bytes} bytes; at most {LABEL_BYTES} are allowed"));
        }
        _ => {}
    }
    if let Some(score) = trigger.score.filter(|score| !score.is_finite()) {
        return Err(format!("the score of `{label}` is {score}; it must be finite"));
    }
    if attributes.len() > ATTRIBUTES {
        return Err(format!("`{label}` has {} attributes; at most {ATTRIBUTES} are allowed", attributes.len()));
    }
    for Attribute { key, value } in attributes {
        let refuse = |why: &str| Err(format!("attribute `{}` of `{label}`: {why}", cut(key, KEY_BYTES)));
        if key.is_empty() || key.len() > KEY_BYTES {
            return refuse("the key must have 1 to 64 bytes");
        }
        match value {
            AttributeValue::Real(value) if !value.is_finite() => return refuse("the value must be finite"),
            AttributeValue::Text(text) if text.len() > TEXT_BYTES => {
                return refuse("the text must have at most 1,024 bytes");
            }
            _ => {}
        }
        if trigger.attributes.iter().any(|(given, _)| given == key) {
            return refuse("the key is given twice");
        }
        trigger.attributes.push((key.clone(), value.clone()));
    }
    Ok(trigger)
}

/// Triggers in this minute of the lambda's time.
pub(super) struct Rate {
    allowed: u64,
    minute: i64,
    caused: u64,
    pub(super) refused: u64,
}

impl Rate {
    pub(super) fn new(limits: &Limits) -> Self {
        Self { allowed: limits.events_per_minute, minute: 0, caused: 0, refused: 0 }
    }

    fn check(&mut self, at_ns: i64) -> Answer {
        let minute = at_ns.div_euclid(MINUTE_NS);
        if self.minute != minute {
            (self.minute, self.caused) = (minute, 0);
        }
        if self.caused < self.allowed {
            return Ok(());
        }
        self.refused += 1;
        Err(TriggerError::TooMany(format!(
            "the lambda has caused {} triggers in this minute already, `events_per_minute` in [limits]; further ones are refused",
            self.allowed
        )))
    }
}
