//! Rings of messages, over `gleaner_rules::ring`.

use gleaner_rules::ring as rules;

use super::message::Message;
use crate::data::Guid;

pub(super) type Ring = rules::Ring<Arrival>;
pub(super) type Cell = rules::Cell<Arrival>;

/// One received message, as it enters a ring.
pub(crate) struct Arrival {
    pub(super) at_ns: i64,
    pub(super) publish_ns: i64,
    pub(super) writer: Guid,
    pub(super) seq: u64,
    pub(super) message: Message,
}
