//! Journals: of every wake of a lambda, what it saw and what it decided, so that a replay can make
//! each decision again and compare it.
//!
//! A journal is compact, is only ever appended to, can be read after a crash, and a flipped byte in
//! it is found and named. `header` and `entry` are what is kept, and what counts as a difference;
//! `encode` and `decode` turn a wake into some 15 bytes and back; `block`, `write` and `read` are
//! the file. `docs/journal.md` describes the bytes for readers in other languages. Nothing here
//! knows where a journal lies, or runs a lambda.

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

pub use decode::{Decoder, Malformed};
pub use encode::Encoder;
pub use entry::{InputView, JournalEntry, LogDigest, WakeSource};
pub use error::{Damage, JournalError};
pub use header::{
    Difference, DriveDigest, FileDigest, JournalEnd, JournalHeader, JournalInput, TimeRange,
};
pub use read::JournalReader;
pub use write::JournalWriter;

use gleaner_lambda::FaultKind;

/// Version of the format. A reader refuses every other, since it cannot know what else changed.
pub const VERSION: u16 = 1;

/// Most inputs of a journal: as many as a manifest may have.
pub const INPUTS_MAX: usize = gleaner_lambda::manifest::bounds::ITEMS_MAX;

/// Most triggers of one wake. The host allows fewer; a reader of files needs a limit that outlasts
/// the host's.
pub const TRIGGERS_MAX: usize = 64;

/// Most bytes of one trigger's attributes as JSON: above what the host allows, with every character
/// escaped.
pub const ATTRIBUTES_MAX: usize = 128 << 10;

/// The bytes that stand for each kind of fault, which is its place here, and the word of
/// `decisions.jsonl`.
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

/// The place of `kind` among the [`FAULTS`].
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
