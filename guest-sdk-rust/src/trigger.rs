//! Triggers: events, and the start and stop of recordings, that a lambda reports in a wake:
//! `gleaner:lambda/trigger`.
//!
//! A trigger is effective from the moment of the call, even if the same wake faults later. In
//! `init` all triggers are refused.

use crate::Result;
pub use crate::error::TriggerErrorKind;
use crate::error::into_result;
use crate::world::gleaner::lambda::trigger as wit;
pub use crate::world::gleaner::lambda::trigger::TriggerError;

/// Builds an event, which [`EventBuilder::send`] reports. An event opens the `[record]` window
/// around the sample or tick of this wake. `score` is the strength of the event, in a unit that the
/// lambda documents.
#[must_use = "an event has no effect until `send`"]
pub fn event(label: &str, score: f64) -> EventBuilder<'_> {
    EventBuilder { label, score, attributes: Vec::new() }
}

/// Builds the start of a recording, which [`StartBuilder::send`] starts. The recording lasts until
/// [`stop`] is called with the same label. At most 64 labels of a lambda can be recorded at once.
#[must_use = "a recording does not start until `send`"]
pub fn start(label: &str) -> StartBuilder<'_> {
    StartBuilder { label, attributes: Vec::new() }
}

/// Ends the recording that [`start`] began with the same label.
///
/// # Errors
///
/// `invalid` outside of a wake, or if the label is empty or over 128 bytes; `too-many` for more
/// than 16 triggers in one wake.
pub fn stop(label: &str) -> Result<()> {
    into_result(wit::stop(label))
}

/// An event that has not been sent.
pub struct EventBuilder<'a> {
    label: &'a str,
    score: f64,
    attributes: Vec<wit::Attribute>,
}

impl EventBuilder<'_> {
    /// Adds a named value that is stored with the trigger in the clip; at most 16 per trigger.
    pub fn with(mut self, key: &str, value: impl Into<AttributeValue>) -> Self {
        self.attributes.push(attribute(key, value));
        self
    }

    /// Reports the event.
    ///
    /// # Errors
    ///
    /// `invalid`: called outside of a wake, as in `init`; label empty or over 128 bytes; score or
    /// value not finite; key empty, over 64 bytes or given twice; text over 1,024 bytes; more than
    /// 16 attributes. `too-many`: more than 16 triggers in one wake, or more in a minute than
    /// `events_per_minute` in `[limits]`. The call has no effect then.
    pub fn send(self) -> Result<()> {
        into_result(wit::event(self.label, self.score, &self.attributes))
    }
}

/// The start of a recording that has not been sent.
pub struct StartBuilder<'a> {
    label: &'a str,
    attributes: Vec<wit::Attribute>,
}

impl StartBuilder<'_> {
    /// Adds a named value that is stored with the trigger in the clip; at most 16 per trigger.
    pub fn with(mut self, key: &str, value: impl Into<AttributeValue>) -> Self {
        self.attributes.push(attribute(key, value));
        self
    }

    /// Starts the recording.
    ///
    /// # Errors
    ///
    /// As [`EventBuilder::send`].
    pub fn send(self) -> Result<()> {
        into_result(wit::start(self.label, &self.attributes))
    }
}

fn attribute(key: &str, value: impl Into<AttributeValue>) -> wit::Attribute {
    wit::Attribute { key: key.to_owned(), value: value.into().0 }
}

/// Value of an attribute; converted from `bool`, `i64`, `f64` and `&str`.
pub struct AttributeValue(wit::AttributeValue);

conversions! {
    AttributeValue:
    bool => |value| wit::AttributeValue::Boolean(value),
    i64 => |value| wit::AttributeValue::Signed(value),
    f64 => |value| wit::AttributeValue::Real(value),
    &str => |value| wit::AttributeValue::Text(value.to_owned()),
}
