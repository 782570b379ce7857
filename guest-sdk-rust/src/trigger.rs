//! What a lambda causes: `gleaner:lambda/trigger`.

use crate::Result;
use crate::bindings::gleaner::lambda::trigger as wit;
pub use crate::bindings::gleaner::lambda::trigger::TriggerError;
use crate::error::answer;

/// Something worth keeping happened. `score` says how strongly, in a unit that the lambda
/// documents.
///
/// Nothing happens before [`Event::send`].
#[must_use = "an event counts once it is sent"]
pub fn event(label: &str, score: f64) -> Event<'_> {
    Event { label, score, attributes: Vec::new() }
}

/// Starts a recording that lasts until [`stop`] with the same label.
///
/// Nothing happens before [`Start::send`].
#[must_use = "a recording starts once this is sent"]
pub fn start(label: &str) -> Start<'_> {
    Start { label, attributes: Vec::new() }
}

/// Ends the recording that [`start`] began.
///
/// # Errors
///
/// As [`Start::send`].
pub fn stop(label: &str) -> Result<()> {
    answer(wit::stop(label))
}

/// An event being described.
pub struct Event<'a> {
    label: &'a str,
    score: f64,
    attributes: Vec<wit::Attribute>,
}

impl Event<'_> {
    /// Adds a named fact that travels into the clip; 16 at most.
    pub fn with(mut self, key: &str, value: impl Into<Value>) -> Self {
        self.attributes.push(attribute(key, value));
        self
    }

    /// Causes the event.
    ///
    /// # Errors
    ///
    /// If the label is empty or over 128 bytes, a number is not finite, a key is given twice, this
    /// wake has caused 16 triggers, or there is no wake, as in `init`. Nothing is caused then.
    pub fn send(self) -> Result<()> {
        answer(wit::event(self.label, self.score, &self.attributes))
    }
}

/// The start of a recording, being described.
pub struct Start<'a> {
    label: &'a str,
    attributes: Vec<wit::Attribute>,
}

impl Start<'_> {
    /// Adds a named fact that travels into the clip; 16 at most.
    pub fn with(mut self, key: &str, value: impl Into<Value>) -> Self {
        self.attributes.push(attribute(key, value));
        self
    }

    /// Starts the recording.
    ///
    /// # Errors
    ///
    /// As [`Event::send`].
    pub fn send(self) -> Result<()> {
        answer(wit::start(self.label, &self.attributes))
    }
}

fn attribute(key: &str, value: impl Into<Value>) -> wit::Attribute {
    wit::Attribute { key: key.to_owned(), value: value.into().0 }
}

/// Value of an attribute; made from `bool`, `i64`, `f64` and `&str`.
pub struct Value(wit::AttributeValue);

impl From<bool> for Value {
    fn from(value: bool) -> Self {
        Self(wit::AttributeValue::Boolean(value))
    }
}

impl From<i64> for Value {
    fn from(value: i64) -> Self {
        Self(wit::AttributeValue::Signed(value))
    }
}

impl From<f64> for Value {
    fn from(value: f64) -> Self {
        Self(wit::AttributeValue::Real(value))
    }
}

impl From<&str> for Value {
    fn from(value: &str) -> Self {
        Self(wit::AttributeValue::Text(value.to_owned()))
    }
}
