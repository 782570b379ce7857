//! How a process of ours is doing, and what it says of itself: the same for the runtime and for the
//! recorder.
//!
//! - [`hand_on`], [`inherited`], [`close_on_exec`]: open files that the shim hands to its runtime.
//! - [`log`]: lines for people, on standard error.
//! - [`own`]: memory of our own code in a process that a lambda shares.
//! - [`Pulse`]: what it does, and since when, for the shim that ends it if it does not come back.
//! - [`Spreads`], [`Durations`]: how long things take, in bounded memory.
//! - [`start`]: the stream of reports, and the request to stop.
//! - [`usage`]: memory and CPU time.
//!
//! What never happens here: what is reported to whoever started us is `gleaner_protocol`'s.

mod handed_on;
pub mod log;
pub mod own;
mod pulse;
mod spread;
pub mod start;
pub mod usage;

pub use handed_on::{close_on_exec, hand_on, inherited};
pub use pulse::{Busy, PULSE_ENV, Pulse, Share};
pub use spread::{Durations, Spreads};
