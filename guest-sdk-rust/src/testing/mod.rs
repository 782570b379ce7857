//! Runs a lambda natively, with a fake host, in `cargo test`.
//!
//! ```
//! use gleaner_sdk::testing::{Host, Message};
//! # use gleaner_sdk::{Config, Field, Lambda, Result, Sample, Topic, event, input};
//! #
//! # struct Dip {
//! #     imu: Topic,
//! #     forward: Field,
//! #     brake_mps2: f64,
//! # }
//! #
//! # impl Lambda for Dip {
//! #     fn init(config: &Config) -> Result<Self> {
//! #         let imu = input("imu")?;
//! #         let forward = imu.field("linear_acceleration.x")?;
//! #         Ok(Self { imu, forward, brake_mps2: config.real("brake_mps2")? })
//! #     }
//! #
//! #     fn on_event(&mut self, _sample: Sample) -> Result<()> {
//! #         let recent = self.imu.column(&self.forward, 50)?;
//! #         if let Some(mean) = recent.mean().filter(|mean| recent.len() == 50 && *mean < self.brake_mps2) {
//! #             event("dip", -mean).send()?;
//! #         }
//! #         Ok(())
//! #     }
//! # }
//! # const MANIFEST: &str = "
//! #     lambda = { name = 'dip', version = '0.1.0', kind = 'wasm', entry = 'dip.wasm' }
//! #     schedule = { event = 'imu' }
//! #     input = [{ name = 'imu', topic = '/imu/data', type = 'sensor_msgs/msg/Imu' }]
//! #     config = { brake_mps2 = -3.0 }";
//!
//! // In a lambda's own crate: let manifest = include_str!("../lambda.toml");
//! # let manifest = MANIFEST;
//! let mut run = Host::from_manifest(manifest).set("brake_mps2", -2.0).load::<Dip>()?;
//! for n in 0..50 {
//!     run.deliver("imu", n * 10_000_000, Message::new().with("linear_acceleration.x", -4.0))?;
//! }
//! assert_eq!(run.faults().next(), None);
//! assert_eq!(run.triggers().map(|trigger| trigger.label.as_str()).collect::<Vec<_>>(), ["dip"]);
//! # Ok::<(), gleaner_sdk::testing::Error>(())
//! ```
//!
//! The lambda is the same source; only what it calls is another. The rules are those of the host:
//! rings with `depth` and `hold`, schedules, columns, what is clamped and refused and in which
//! words, operations on pixels to the last bit, limits of triggers, log, scratch, frames, handles
//! and bytes of a call, faults and the lambda made anew after one, rests. Most of them are the
//! host's own code, in `gleaner-rules`.
//!
//! Not here: fuel, time and memory, but for pixels of frames that are made; decoders of JPEG and
//! PNG; definitions of messages, so that a message has the fields that the test gives; clips;
//! models. `docs/rust.md` says what follows from that.
//!
//! It exists natively only, so use it in `#[cfg(test)]`. A call of the SDK while no lambda runs
//! panics, and says what to do.

#[doc(hidden)]
pub mod bindings;
pub(crate) mod data;
mod decision;
mod error;
mod frame;
mod host;
pub(crate) mod inference;
mod limits;
pub(crate) mod log;
mod manifest;
mod message;
mod path;
mod ring;
mod run;
mod schedule;
pub(crate) mod scratch;
mod session;
mod table;
pub(crate) mod trigger;
pub(crate) mod types;

pub use decision::{AttributeValue, Cause, Decision, Fault, FaultKind, Trigger, TriggerKind};
pub use error::Error;
pub use host::{Host, Setting};
pub use log::Line;
pub use message::{FieldValue, Message};
pub use run::Run;
