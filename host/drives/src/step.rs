//! What a replay says of each message, and of how far it is.

use gleaner_transport::{SampleMeta, Subscription, Verdict};

/// One delivery.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Step {
    /// Log time of the message, in ns.
    pub at_ns: i64,
    /// To whom it was delivered.
    pub subscription: Subscription,
    /// What the sink made of it.
    pub verdict: Verdict,
    /// What the sink was told besides the bytes.
    pub meta: SampleMeta,
    /// Length of the CDR payload, without encapsulation; of one that is packed and too big, as far
    /// as it was unpacked.
    pub bytes: usize,
}

/// How far a replay has come.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Default)]
pub struct Progress {
    /// Deliveries made.
    pub done: u64,
    /// Deliveries to expect if the files hold what they claim; `None` if nothing says, as in a
    /// database without metadata, or where only a part is replayed.
    pub total: Option<u64>,
}
