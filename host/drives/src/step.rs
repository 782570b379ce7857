//! Results of replay steps, and the progress of a replay.

use gleaner_messages::transport::{Delivery, SampleMeta, Subscription};

/// One delivery of a message.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct ReplayStep {
    /// Log time of the message, in ns.
    pub at_ns: i64,
    pub subscription: Subscription,
    pub delivery: Delivery,
    pub meta: SampleMeta,
    /// Length of the CDR payload, without encapsulation; of a packed message that is too big, the
    /// part that was unpacked.
    pub bytes: usize,
}

#[derive(Copy, Clone, Debug, PartialEq, Eq, Default)]
pub struct Progress {
    /// Number of deliveries made.
    pub done: u64,
    /// Expected number of deliveries, if the files are correct; `None` if unknown, as in a database
    /// without metadata, or if only a part is replayed.
    pub total: Option<u64>,
}
