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
//! #         let full = recent.len() == 50;
//! #         if let Some(mean) = recent.mean().filter(|mean| full && *mean < self.brake_mps2) {
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
//! The source of the lambda is unchanged. The fake host follows the rules of the real one: rings
//! with `depth` and `hold`, schedules, columns, clamping, errors and their texts, operations on
//! pixels to the last bit, limits of triggers, log, scratch, frames, handles and bytes per call,
//! faults with a fresh instance after each, and back-off. Most of these rules are the host's own
//! code, in `gleaner-rules`.
//!
//! A model answers as the test determines: see [`FakeModel`].
//!
//! Not included: limits of fuel, time and memory, except of the memory of frames and tensors that
//! the lambda creates; decoders of JPEG and PNG; message definitions, so a message has only the
//! fields that the test sets; clips; models, and frames as tensors. See `docs/rust.md` for the
//! consequences.
//!
//! The module exists only in native builds, so use it in `#[cfg(test)]`. A function of the SDK that
//! is called while no lambda runs panics with a message that names the way out.

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
mod model;
mod path;
mod ring;
mod run;
mod schedule;
pub(crate) mod scratch;
mod session;
mod table;
pub(crate) mod trigger;

pub use decision::{AttributeValue, Cause, Decision, Fault, FaultKind, Trigger, TriggerKind};
pub use error::Error;
pub use host::{Host, Setting};
pub use log::LogLine;
pub use message::{FieldValue, Message};
pub use model::{FakeModel, SeenFrame};
pub use run::Run;
