//! Basics for every Gleaner program: exit codes, errors for users, safe and atomic file access,
//! sizes, durations and dates, text of messages.
//!
//! Nothing here depends on what a lambda is.

mod atomic_write;
mod discovery;
mod exit;
mod failure;
mod line_pieces;
mod open_files;
mod plain_file;
pub mod programs;
mod rate_limit;
pub mod safe_file;
mod shortage;
pub mod text;
mod time;
pub mod units;
mod version;

pub use atomic_write::{DiskSteps, WriteSteps, sync_folder, write_atomically, write_atomically_by};
pub use discovery::ignored_variables;
pub use exit::Exit;
pub use failure::{Explain, Failure, chain};
pub use line_pieces::{LinePiece, each_piece};
pub use open_files::{open_files_max, raise_open_files};
pub use plain_file::{NotPlain, PlainFile};
pub use rate_limit::RateLimit;
pub use shortage::is_shortage;
pub use text::{excerpt, grouped, hex, in_one_line, visible};
pub use time::{UtcTime, nanoseconds};
pub use units::{ByteSize, UnitError, format_duration, parse_duration};
pub use version::{set_commit, version};
