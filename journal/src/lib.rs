//! Journals: the inputs and the decision of every wake of a lambda, so that a replay can repeat and
//! compare each decision.
//!
//! A journal is compact and append-only; it can be read after a crash, and a flipped byte is found
//! and located. `header` and `entry` define the content and its comparison; `encode` and `decode`
//! convert a wake to some 15 bytes and back; `block`, `write` and `read` are the file format, which
//! `docs/journal.md` describes for readers in other languages. Nothing here chooses the path of a
//! journal, or runs a lambda.

mod block;
mod decode;
mod encode;
mod entry;
mod error;
mod header;
mod number;
mod previous;
mod read;
#[cfg(test)]
mod tests;
mod write;

pub use decode::{Decoder, MalformedWake};
pub use encode::Encoder;
pub use entry::{InputView, JournalEntry, LogDigest, WakeSource};
pub use error::{Damage, JournalError};
pub use header::{
    Difference, DriveDigest, FileDigest, JournalEnd, JournalHeader, JournalInput, TimeRange,
};
pub use read::JournalReader;
pub use write::JournalWriter;

use gleaner_lambda::FaultKind;

/// Version of the format. A reader refuses every other version.
pub const VERSION: u16 = 1;

/// Maximum number of inputs, that of manifests.
pub const INPUTS_MAX: usize = gleaner_lambda::manifest::bounds::ITEMS_MAX;

/// Maximum number of triggers of one wake. The host allows fewer; readers need a limit that remains
/// valid if the host's changes.
pub const TRIGGERS_MAX: usize = 64;

/// Maximum length of one trigger's attributes as JSON, above the limit of the host with every
/// character escaped.
pub const ATTRIBUTES_MAX: usize = 128 << 10;

/// The kinds of fault, by their code in a journal, with their words in `decisions.jsonl`.
const FAULTS: [(FaultKind, &str); 8] = [
    (FaultKind::Fuel, "fuel"),
    (FaultKind::Deadline, "deadline"),
    (FaultKind::Memory, "memory"),
    (FaultKind::Stack, "stack"),
    (FaultKind::Trap, "trap"),
    (FaultKind::HostCall, "host_call"),
    (FaultKind::Exception, "exception"),
    (FaultKind::Killed, "killed"),
];

fn fault_code(kind: FaultKind) -> usize {
    match kind {
        FaultKind::Fuel => 0,
        FaultKind::Deadline => 1,
        FaultKind::Memory => 2,
        FaultKind::Stack => 3,
        FaultKind::Trap => 4,
        FaultKind::HostCall => 5,
        FaultKind::Exception => 6,
        FaultKind::Killed => 7,
    }
}
