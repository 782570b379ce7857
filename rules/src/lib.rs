//! The rules that apply to lambdas, each written once.
//!
//! The host and, natively, `gleaner_sdk::testing` enforce them with this code: the schedule of a
//! lambda ([`schedule`]), its back-off ([`faults`]), its triggers, log lines and stored bytes
//! ([`triggers`], [`log`], [`scratch`]), its view of an input and the limits of one call ([`ring`],
//! [`clamps`], [`path`], [`frames`]), its frames and the operations on them ([`pixels`]), and the
//! form of names, sizes and durations in its manifest ([`names`], [`units`]). `cases/*.json` has
//! calls and results for each; the Python SDK, which implements these rules again, passes the same
//! cases.
//!
//! Never: a dependency, since this is copied with the SDK into the folder of every new lambda; a
//! clock, a file or a thread; anything of the host or of WebAssembly. The caller provides the time
//! and the content of rings.

pub mod clamps;
pub mod faults;
pub mod frames;
pub mod log;
pub mod names;
pub mod path;
pub mod pixels;
pub mod refused;
pub mod ring;
pub mod schedule;
pub mod scratch;
pub mod text;
pub mod triggers;
pub mod units;
