//! Append-only logs on the disk of a vehicle, one folder for each stream: records are acknowledged
//! once they are durable, and everything lost is marked.
//!
//! A [`SpoolWriter`] appends records and commits them in groups; a [`SpoolReader`] iterates over
//! them. `docs/spool.md` describes the files. Nothing here knows what a record means.

mod error;
mod folder;
mod format;
mod note;
mod queue;
mod reader;
mod scan;
mod storage;
mod writer;

pub use error::SpoolError;
pub use folder::SpoolFolder;
pub use format::{BUDGET_MIN, BootId, GapReason, NAME_MAX, PAYLOAD_MAX, SpoolGap, SpoolTime};
pub use note::SpoolNote;
pub use reader::{SpoolItem, SpoolReader, SpoolRecord, TornTail};
pub use storage::{SegmentFile, SpoolStorage};
pub use writer::{SpoolConfig, SpoolStatus, SpoolWriter};
