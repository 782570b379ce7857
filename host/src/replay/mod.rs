//! Replays recorded drives to a built lambda: the same artifact as on the vehicle, as fast as the
//! machine allows.
//!
//! Time is the drive's. Each sample is delivered and the lambda runs if its schedule requests it,
//! then the next: nothing is skipped, and nothing depends on the speed of the machine.

mod digests;
mod drive_loop;
mod inspect;
mod job;
mod journal_file;
mod open;
mod options;
mod packed;
mod pictures;
mod record;
mod reports;
mod round;
mod signals;
mod time_range;
mod topic_filter;
mod verify;
mod worker_loop;

pub use inspect::{InspectArgs, inspect};
pub use job::ReplayJob;
pub use options::{ReplayArgs, ReplayOptions, VerifyArgs};
pub use packed::{Packed, UnpackedArgs};
