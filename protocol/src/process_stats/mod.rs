//! Reports the state of a process, in the same way for the runtime, the ingress and the recorder.
//!
//! - [`make_inheritable`], [`inherited`], [`close_on_exec`]: open files that the shim passes to its
//!   runtime.
//! - [`log`]: log lines for users, on standard error.
//! - [`own`]: memory of Gleaner's code in a process that it shares with a lambda.
//! - [`Heartbeat`]: the current activity and its start, for the shim, which kills a process that
//!   does not return.
//! - [`IntervalDurations`], [`Durations`]: statistics of durations, in bounded memory.
//! - [`ReportWriter`]: reports to a starter that may be slow to read.
//! - [`start`]: the stream of reports, and the request to stop.
//! - [`usage`]: memory and CPU time.
//!
//! The reports to the starter are in `gleaner_protocol`.

mod durations;
mod heartbeat;
mod inherited_file;
pub mod log;
pub mod own;
mod report_writer;
pub mod start;
pub mod usage;

pub use durations::{Durations, IntervalDurations};
pub use heartbeat::{Busy, HEARTBEAT_ENV, Heartbeat, Share, monotonic_ns};
pub use inherited_file::{close_on_exec, inherited, make_inheritable};
pub use report_writer::{ReportSender, ReportWriter};
