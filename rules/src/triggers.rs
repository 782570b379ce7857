//! Limits and checks of triggers: their number, form and rate.

use std::fmt;

use crate::text::cut;

pub const PER_WAKE: usize = 16;
/// Maximum number of attributes of one trigger.
pub const ATTRIBUTES: usize = 16;
pub const LABEL_BYTES: usize = 128;
pub const KEY_BYTES: usize = 64;
pub const TEXT_BYTES: usize = 1024;

const MINUTE_NS: i64 = 60_000_000_000;

/// The action that a trigger requests from the recorder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TriggerKind {
    /// Record the window around this wake.
    Event,
    /// Begin a recording that lasts until `Stop`.
    Start,
    /// End the recording that `Start` began.
    Stop,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    /// Key of 1 to [`KEY_BYTES`] bytes, unique in its trigger.
    pub key: String,
    pub value: AttributeValue,
}

#[derive(Clone, Debug, PartialEq)]
pub enum AttributeValue {
    Boolean(bool),
    Signed(i64),
    /// Finite.
    Real(f64),
    /// At most [`TEXT_BYTES`] bytes.
    Text(String),
}

/// The reason for a refused call, which had no effect.
#[derive(Clone, Debug, PartialEq)]
pub enum TriggerError {
    NoLabel,
    LongLabel { bytes: usize },
    Score { label: String, score: f64 },
    Attributes { label: String, given: usize },
    Attribute { label: String, key: String, why: &'static str },
    NoWake,
    TooMany,
    TooOften { allowed: u64 },
}

impl TriggerError {
    /// Returns whether a limit on the number of triggers was exceeded; otherwise the trigger was
    /// invalid.
    pub const fn is_too_many(&self) -> bool {
        matches!(self, Self::TooMany | Self::TooOften { .. })
    }
}

impl fmt::Display for TriggerError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoLabel => write!(f, "the label is empty"),
            Self::LongLabel { bytes } => {
                write!(f, "the label has {bytes} bytes; at most {LABEL_BYTES} are allowed")
            }
            Self::Score { label, score } => {
                write!(f, "the score of `{label}` is {score}; it must be finite")
            }
            Self::Attributes { label, given } => {
                write!(f, "`{label}` has {given} attributes; at most {ATTRIBUTES} are allowed")
            }
            Self::Attribute { label, key, why } => {
                write!(f, "attribute `{key}` of `{label}`: {why}")
            }
            Self::NoWake => {
                write!(
                    f,
                    "triggers belong to a wake: they are refused in init and between two wakes"
                )
            }
            Self::TooMany => {
                write!(
                    f,
                    "this wake has caused {PER_WAKE} triggers already; further ones are refused"
                )
            }
            Self::TooOften { allowed } => {
                write!(f, "the lambda has caused {allowed} triggers in this minute already, ")?;
                write!(f, "`events_per_minute` in [limits]; further ones are refused")
            }
        }
    }
}

impl std::error::Error for TriggerError {}

/// Triggers of the current wake, and their number in the current minute of the lambda's time.
#[derive(Debug)]
pub struct Triggers<T> {
    /// `None` outside of a wake, where triggers are refused.
    wake: Option<Vec<T>>,
    per_minute: u64,
    minute: i64,
    caused: u64,
    refused: u64,
}

impl<T> Triggers<T> {
    /// Creates an empty list, outside of a wake.
    pub fn new(per_minute: u64) -> Self {
        Self { wake: None, per_minute, minute: 0, caused: 0, refused: 0 }
    }

    /// Begins a wake; drops triggers of an earlier one.
    pub fn begin(&mut self) {
        self.wake = Some(Vec::new());
    }

    /// Ends a wake; returns its triggers, in the order of the calls.
    pub fn end(&mut self) -> Vec<T> {
        self.wake.take().unwrap_or_default()
    }

    /// Suspends a wake, for example for an `init` in its middle, which may not trigger. Returns the
    /// triggers of the wake.
    pub fn suspend(&mut self) -> Option<Vec<T>> {
        self.wake.take()
    }

    /// Resumes a wake with the result of [`Triggers::suspend`].
    pub fn resume(&mut self, wake: Option<Vec<T>>) {
        self.wake = wake;
    }

    /// Returns the triggers of this wake so far.
    pub fn list(&self) -> &[T] {
        self.wake.as_deref().unwrap_or_default()
    }

    /// Returns the number of triggers refused by the rate limit, since the start.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Adds the number of triggers refused in another process.
    pub fn add_refused(&mut self, refused: u64) {
        self.refused = self.refused.saturating_add(refused);
    }

    /// Adds a trigger, which `make` creates, at the time `now_ns` in nanoseconds.
    ///
    /// # Errors
    ///
    /// [`TriggerError`] if a limit is exceeded; then no trigger is added.
    pub fn cause(
        &mut self,
        now_ns: i64,
        kind: TriggerKind,
        (label, score): (&str, Option<f64>),
        attributes: Vec<Attribute>,
        make: impl FnOnce(Vec<Attribute>) -> T,
    ) -> Result<(), TriggerError> {
        if self.wake.is_none() {
            return Err(TriggerError::NoWake);
        }
        // A lambda over the limit per minute may still end a recording.
        if kind != TriggerKind::Stop {
            self.check_rate(now_ns)?;
        }
        let wake = self.wake.as_mut().ok_or(TriggerError::NoWake)?;
        if wake.len() >= PER_WAKE {
            return Err(TriggerError::TooMany);
        }
        check(label, score, &attributes)?;
        wake.push(make(attributes));
        self.caused += 1;
        Ok(())
    }

    fn check_rate(&mut self, now_ns: i64) -> Result<(), TriggerError> {
        let minute = now_ns.div_euclid(MINUTE_NS);
        if self.minute != minute {
            (self.minute, self.caused) = (minute, 0);
        }
        if self.caused < self.per_minute {
            return Ok(());
        }
        self.refused += 1;
        Err(TriggerError::TooOften { allowed: self.per_minute })
    }
}

fn check(label: &str, score: Option<f64>, attributes: &[Attribute]) -> Result<(), TriggerError> {
    match label.len() {
        0 => return Err(TriggerError::NoLabel),
        bytes if bytes > LABEL_BYTES => return Err(TriggerError::LongLabel { bytes }),
        _ => {}
    }
    let label = || label.to_owned();
    if let Some(score) = score.filter(|score| !score.is_finite()) {
        return Err(TriggerError::Score { label: label(), score });
    }
    if attributes.len() > ATTRIBUTES {
        return Err(TriggerError::Attributes { label: label(), given: attributes.len() });
    }
    for (n, Attribute { key, value }) in attributes.iter().enumerate() {
        let refuse = |why| {
            Err(TriggerError::Attribute {
                label: label(),
                key: cut(key, KEY_BYTES).to_owned(),
                why,
            })
        };
        if key.is_empty() || key.len() > KEY_BYTES {
            return refuse("the key must have 1 to 64 bytes");
        }
        match value {
            AttributeValue::Real(value) if !value.is_finite() => {
                return refuse("the value must be finite");
            }
            AttributeValue::Text(text) if text.len() > TEXT_BYTES => {
                return refuse("the text must have at most 1,024 bytes");
            }
            _ => {}
        }
        if attributes[..n].iter().any(|before| before.key == *key) {
            return refuse("the key is given twice");
        }
    }
    Ok(())
}
