//! How long the files of results become: the bounds of their writers, by which their readers refuse
//! what no writer of ours has made.
//!
//! Another program may have put anything in their place, and a sparse file of a terabyte takes no
//! disk.

use gleaner_base::ByteSize;

/// `log.jsonl` of a live run, before it goes on in a new file; twice as much is kept. A lambda may
/// log 34 GB a day within its limits, and no person watches the disk of a vehicle.
pub const LIVE_LOG_MAX: ByteSize = ByteSize::mib(256);

/// Longest line of a file of results. A decision holds 16 triggers at most, and a fault that is
/// cut.
pub const LINE_MAX: ByteSize = ByteSize::mib(16);

/// Longest `decisions.jsonl`, `log.jsonl` or `clips.jsonl` that is read. Replays are not cut, and
/// this is a week of wakes at 100 Hz, each with a line.
pub const LINES_MAX: ByteSize = ByteSize::gib(32);

/// Longest `summary.json` that is read; it has some kilobytes.
pub const SUMMARY_MAX: ByteSize = ByteSize::mib(4);

/// Longest `signals.json` that is read. Its curves and points are bounded.
pub const SIGNALS_MAX: ByteSize = ByteSize::mib(32);

/// Longest picture or thumbnail that is read. The longest that is written has some 100 KiB.
pub const PICTURE_MAX: ByteSize = ByteSize::mib(1);

/// Longest page, in bytes, with its line break. A decision with all triggers and attributes that
/// are allowed, each byte of them escaped, has 1.7 MB.
pub const RESULT_ITEM_MAX: usize = 2 << 20;
