//! Maximum lengths of result files: writers keep them, and readers refuse longer files.
//!
//! A longer file is not Gleaner's: another program may have put anything in its place, and a sparse
//! file of a terabyte takes no disk space.

use gleaner_base::ByteSize;

/// Length at which `log.jsonl` of a live run is rotated; twice as much is kept. A lambda may log
/// 34 GB a day within its limits, and the disk of a vehicle is not watched.
pub const LIVE_LOG_MAX: ByteSize = ByteSize::mib(256);

/// Longest line of a result file. A decision has at most 16 triggers, and a fault message that is
/// cut.
pub const LINE_MAX: ByteSize = ByteSize::mib(16);

/// Longest `decisions.jsonl`, `log.jsonl` or `clips.jsonl` that is read. Replays are not rotated,
/// and this is a week of wakes at 100 Hz, each with a line.
pub const LINES_MAX: ByteSize = ByteSize::gib(32);

/// Longest `summary.json` that is read; it has some kilobytes.
pub const SUMMARY_MAX: ByteSize = ByteSize::mib(4);

/// Longest `signals.json` that is read. Its curves and points are bounded.
pub const SIGNALS_MAX: ByteSize = ByteSize::mib(32);

/// Longest picture or thumbnail that is read. The longest that is written has some 100 KiB.
pub const PICTURE_MAX: ByteSize = ByteSize::mib(1);

/// Longest result item between runtime and shim, in bytes, including the line break. A decision
/// with all allowed triggers and attributes, each byte escaped, has 1.7 MB.
pub const RESULT_ITEM_MAX: usize = 2 << 20;
