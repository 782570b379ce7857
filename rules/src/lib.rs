//! The rules that apply to lambdas, each implemented once for the host and the Rust SDK.
//!
//! The host and, natively, `gleaner_sdk::testing` enforce them with this code: the schedule of a
//! lambda ([`schedule`]), its back-off ([`faults`]), its triggers, log lines and stored bytes
//! ([`triggers`], [`log`], [`scratch`]), its view of an input and the limits of one call ([`ring`],
//! [`clamps`], [`path`], [`frames`]), its frames and the operations on them ([`pixels`]), and the
//! form of names, sizes and durations in its manifest ([`names`], [`units`]). `cases/*.json` has
//! calls and results for each; the Python SDK, which has its own implementation of these rules,
//! passes the same cases.
//!
//! This crate has no dependency, since `gleaner new` copies it with the SDK into the folder of
//! every new lambda. It uses no clock, file or thread, and nothing of the host or of WebAssembly.
//! The caller provides the time and the content of rings.

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
