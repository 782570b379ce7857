//! A path into the messages of one topic, compiled once.

use std::sync::Arc;

use gleaner_messages::FieldPath;
use gleaner_rules::clamps::WrongField;

use super::curves::CurveWriter;
use super::data::{DataError, Topic};

/// Cost of reading a field at a fixed offset, in bytes: its path and its value.
pub(super) const FIELD_BYTES: usize = 64;

/// A compiled path into the messages of one topic.
pub struct Field {
    pub(super) topic: Arc<Topic>,
    pub(super) path: FieldPath,
    pub(super) curve: Option<Arc<CurveWriter>>,
}

impl Field {
    /// Returns whether elements of varying size precede it, so that reading it parses much of the
    /// message.
    pub(super) fn walks(&self) -> bool {
        self.path.walks()
    }

    /// Number of bytes that reading it from a message of `message_bytes` may touch: all of them if
    /// elements of varying size precede it.
    pub(super) fn work(&self, message_bytes: usize) -> usize {
        if self.walks() { message_bytes.max(FIELD_BYTES) } else { FIELD_BYTES }
    }

    pub fn path(&self) -> &str {
        self.path.path()
    }

    /// Adds the value of the sample of `at_ns` to the field's curve.
    pub(super) fn draw(&self, at_ns: i64, value: f64) {
        if let Some(curve) = &self.curve {
            curve.number(at_ns, value);
        }
    }

    pub(super) fn must_belong_to(&self, topic: &Arc<Topic>) -> Result<(), DataError> {
        if Arc::ptr_eq(&self.topic, topic) {
            return Ok(());
        }
        Err(WrongField::elsewhere(self.path(), self.topic.name(), topic.name()).into())
    }
}
