//! A path into the messages of one topic, compiled once.

use std::sync::Arc;

use gleaner_messages::FieldPath;
use gleaner_rules::clamps::WrongField;

use super::curves::Pen;
use super::data::{DataError, Topic};

/// What reading a field at a fixed place costs, in bytes: the walk to it, and its value.
pub(super) const FIELD_BYTES: usize = 64;

/// A compiled path into the messages of one topic.
pub struct Field {
    pub(super) topic: Arc<Topic>,
    pub(super) path: FieldPath,
    pub(super) pen: Option<Arc<Pen>>,
}

impl Field {
    /// Whether elements of varying size lie before it, so that reading it walks over much of a
    /// message.
    pub(super) fn walks(&self) -> bool {
        self.path.walks()
    }

    /// Bytes that reading it from a message of `message_bytes` may touch: all of them if elements
    /// of varying size lie before it.
    pub(super) fn work(&self, message_bytes: usize) -> usize {
        if self.walks() { message_bytes.max(FIELD_BYTES) } else { FIELD_BYTES }
    }

    /// The path as it was written.
    pub fn path(&self) -> &str {
        self.path.path()
    }

    /// Notes what was read of the sample of `at_ns`.
    pub(super) fn draw(&self, at_ns: i64, value: f64) {
        if let Some(pen) = &self.pen {
            pen.number(at_ns, value);
        }
    }

    pub(super) fn must_belong_to(&self, topic: &Arc<Topic>) -> Result<(), DataError> {
        if Arc::ptr_eq(&self.topic, topic) {
            return Ok(());
        }
        Err(WrongField::elsewhere(self.path(), self.topic.name(), topic.name()).into())
    }
}
