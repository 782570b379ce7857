//! Runs a lambda in a separate process, the *worker*: the way a Python lambda runs in a replay.
//!
//! The worker opens the drives itself, follows the same schedule as its parent, and sends one
//! message for each wake through its original standard output. The parent reads the same drives,
//! takes over each outcome as if the lambda had run there ([`RemoteGuest`]), and writes all
//! results. So the worker needs no writable file, and native code in it cannot change the cause of
//! a decision, an exit code, or the results of an earlier wake.
//!
//! Messages flow one way: the worker never waits for an answer. The parent trusts none of them:
//! lengths are limited, triggers and log lines pass the same checks as calls of a lambda, and a
//! message that does not fit the schedule ends the replay.

#[cfg(feature = "python")]
mod process;
#[cfg(feature = "python")]
mod remote;
mod sender;

use gleaner_lambda::signals::Curve;
use gleaner_lambda::{Fault, Trigger};
use gleaner_protocol::Layer;
use serde::{Deserialize, Serialize};

#[cfg(feature = "python")]
pub use remote::{RemoteGuest, WorkerStartError};
pub use sender::{MessageSender, SendingGuest};

use crate::api::data::Counts;
use crate::api::log::Level;
use crate::guest::LambdaEngine;

/// Maximum length of a message in bytes: a wake with the maximum of triggers and attributes, each
/// character escaped, has some 2 MB.
#[cfg(feature = "python")]
const MESSAGE_MAX: u64 = 4 << 20;

/// One line that a worker sends, as JSON.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum WorkerMessage {
    /// Sent first: the process is sandboxed, and no code of the lambda has run yet.
    Ready {
        engine: LambdaEngine,
        layers: Vec<Layer>,
    },
    /// A line that the lambda logged; sent before the message of the call that it belongs to.
    Log {
        level: Level,
        message: String,
    },
    /// The start-up code of the lambda's environment has ended.
    Prepared(CallOutcome),
    Initialised(CallOutcome),
    Woken(WakeMessage),
    /// The drive has ended.
    Done(TotalsMessage),
    /// Curve of one field that the lambda read. [`WorkerMessage::Done`] gives the number of curves
    /// that follow it.
    Curve(Curve),
}

#[derive(Debug, Default, Serialize, Deserialize)]
struct CallOutcome {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fault: Option<Fault>,
    /// Number and checksum of the lines that the lambda logged, including dropped ones.
    said: (u64, u32),
    /// Log lines that the rate limit dropped.
    #[serde(default, skip_serializing_if = "is_zero")]
    log_dropped: u64,
    /// Triggers that the rate limit refused.
    #[serde(default, skip_serializing_if = "is_zero")]
    triggers_refused: u64,
    /// Resident memory of the worker, after its start and after `init`.
    #[serde(default, skip_serializing_if = "is_zero")]
    resident_bytes: u64,
}

#[derive(Debug, Serialize, Deserialize)]
struct WakeMessage {
    at_ns: i64,
    run_ns: u64,
    #[serde(default, skip_serializing_if = "is_zero")]
    model_ns: u64,
    call: CallOutcome,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    triggers: Vec<Trigger>,
    /// Number of samples, back from the newest, at which the lambda looked: for each input, if any.
    looked: Vec<Option<u64>>,
    /// Number of samples of all inputs refused so far, since the lambda holds all slots.
    #[serde(default, skip_serializing_if = "is_zero")]
    no_slot: u64,
}

/// Totals of the replay, sent after the last wake.
#[derive(Debug, Serialize, Deserialize)]
struct TotalsMessage {
    /// Counts of each input, in the manifest's order.
    counts: Vec<Counts>,
    decode_ns: u64,
    curves: usize,
    curves_omitted: u64,
}

#[cfg(feature = "python")]
impl TotalsMessage {
    fn no_slot(&self) -> u64 {
        self.counts.iter().fold(0, |sum: u64, counts| sum.saturating_add(counts.no_slot))
    }
}

fn is_zero(count: &u64) -> bool {
    *count == 0
}
