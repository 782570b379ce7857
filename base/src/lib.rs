//! What every program of Gleaner needs, and nothing of what it does: exit codes, errors as people
//! read them, files that are safe to open and written whole, sizes and durations, words in
//! messages.
//!
//! Nothing here knows what a lambda is.

mod exit;
mod failure;
pub mod own_file;
mod pieces;
mod plain_file;
#[cfg(test)]
mod scratch;
mod time;
pub mod units;
mod whole;
pub mod words;

pub use exit::Exit;
pub use failure::{Explain, Failure, chain};
pub use pieces::{Piece, each_piece};
pub use plain_file::{NotPlain, PlainFile};
pub use time::nanoseconds;
pub use units::{ByteSize, UnitError, format_duration, parse_duration};
pub use whole::write_whole;
pub use words::{excerpt, grouped, hex, visible};
