//! Basics for every Gleaner program: exit codes, errors for users, safe and atomic file access,
//! sizes, durations and dates, text of messages.
//!
//! Nothing here depends on what a lambda is.

mod atomic_write;
mod exit;
mod failure;
mod line_pieces;
mod plain_file;
pub mod safe_file;
#[cfg(test)]
mod test_folder;
pub mod text;
mod time;
pub mod units;

pub use atomic_write::write_atomically;
pub use exit::Exit;
pub use failure::{Explain, Failure, chain};
pub use line_pieces::{LinePiece, each_piece};
pub use plain_file::{NotPlain, PlainFile};
pub use text::{excerpt, grouped, hex, visible};
pub use time::{UtcTime, nanoseconds};
pub use units::{ByteSize, UnitError, format_duration, parse_duration};
