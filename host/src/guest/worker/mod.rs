//! A lambda in a process of its own, the *worker*: so a Python lambda runs in a replay.
//!
//! The worker opens the drives itself, follows the same schedule as the process that started it,
//! and sends one message for each wake through what was its standard output. The process that
//! started it reads the same drives, takes each outcome over as if the lambda had run there
//! ([`Remote`]), and writes all results. So the worker needs no file that it may write, and nothing
//! that native code in it does can change the cause of a decision, an exit code, or the results of
//! an earlier wake.
//!
//! Messages flow one way: the worker never waits for an answer. The reader trusts none of them:
//! lengths are bounded, triggers and log lines pass the same checks as calls of a lambda, and a
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
pub use remote::{NotReady, Remote};
pub use sender::{Reports, Sender};

use crate::api::data::Counts;
use crate::api::log::Level;

/// Longest message in bytes: a wake with all triggers and attributes that it may have, each
/// character escaped, has some 2 MB.
#[cfg(feature = "python")]
const MESSAGE_MAX: u64 = 4 << 20;

/// One line that a worker sends, as JSON.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Message {
    /// Sent first: the process is sandboxed, and nothing of the lambda has run yet.
    Ready { engine: String, layers: Vec<Layer> },
    /// A line that the lambda logged; sent before the message of the call that it belongs to.
    Log { level: Level, message: String },
    /// The start of the lambda's environment has ended.
    Prepared(Called),
    /// `init` has ended.
    Initialised(Called),
    /// A wake has ended.
    Woken(Woken),
    /// The course is over.
    Done(Done),
    /// Values of one field that the lambda read. [`Message::Done`] says how many of these follow
    /// it.
    Curve(Curve),
}

/// Outcome of a call into the lambda.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Called {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fault: Option<Fault>,
    /// Lines that the lambda logged, and their checksum: those included that its rate limit
    /// dropped.
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

/// The outcome of one wake.
#[derive(Debug, Serialize, Deserialize)]
struct Woken {
    at_ns: i64,
    run_ns: u64,
    call: Called,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    triggers: Vec<Trigger>,
    /// For each input, how many samples back from the newest the lambda looked, if it did.
    looked: Vec<Option<u64>>,
    /// Samples of all inputs that found no room so far, since the lambda holds others.
    #[serde(default, skip_serializing_if = "is_zero")]
    no_slot: u64,
}

/// Totals of the course, sent after the last wake.
#[derive(Debug, Serialize, Deserialize)]
struct Done {
    /// Of each input, in the manifest's order.
    counts: Vec<Counts>,
    decode_ns: u64,
    curves: usize,
    curves_omitted: u64,
}

#[cfg(feature = "python")]
impl Done {
    fn no_slot(&self) -> u64 {
        self.counts.iter().fold(0, |sum: u64, counts| sum.saturating_add(counts.no_slot))
    }
}

fn is_zero(count: &u64) -> bool {
    *count == 0
}
