//! The rules that a lambda can meet, each written once.
//!
//! The host and, natively, `gleaner_sdk::testing` keep them with this code: when a lambda runs
//! ([`schedule`]), when it rests ([`faults`]), what it may cause, say and keep ([`triggers`],
//! [`log`], [`scratch`]), what it sees of an input and how much of it at once ([`ring`],
//! [`clamps`], [`path`], [`frames`]), what its frames are and what is computed on them
//! ([`pixels`]), and how names, sizes and durations are written in its manifest ([`names`],
//! [`units`]). `cases/*.json` has calls and answers for each; the Python SDK, which has these rules
//! a second time, answers the same cases.
//!
//! Never: a dependency, since this travels with the SDK into the folder of every new lambda; a
//! clock, a file or a thread; anything of the host or of WebAssembly. What time it is, and what a
//! ring shows, the caller says.

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
