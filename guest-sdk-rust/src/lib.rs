//! Gleaner's SDK for lambdas in Rust.
//!
//! A lambda is a type that implements [`Lambda`], exported once with [`lambda!`], in a crate of
//! type `cdylib`:
//!
//! ```
//! use gleaner_sdk::{Config, Field, Lambda, Result, Sample, Topic, event, input};
//!
//! struct Dip {
//!     imu: Topic,
//!     ax: Field,
//!     brake: f64,
//! }
//!
//! impl Lambda for Dip {
//!     fn init(config: &Config) -> Result<Self> {
//!         let imu = input("imu")?;
//!         let ax = imu.field("linear_acceleration.x")?;
//!         Ok(Self { imu, ax, brake: config.real("brake_mps2")? })
//!     }
//!
//!     fn on_event(&mut self, _sample: Sample) -> Result<()> {
//!         let recent = self.imu.column(&self.ax, 50)?;
//!         if let Some(mean) = recent.mean().filter(|mean| *mean < self.brake) {
//!             event("dip", -mean).send()?;
//!         }
//!         Ok(())
//!     }
//! }
//!
//! gleaner_sdk::lambda!(Dip);
//! ```
//!
//! On the vehicle and in replay, the functions of this crate call the host. In `cargo test`,
//! [`testing`] provides a fake host with the same rules; outside of it, the functions panic. Keep
//! detection rules in plain functions over plain numbers: they need no host, and any unit test can
//! call them.
//!
//! [`kernels`] has such functions for pixels and signals.
//!
//! The modules [`data`], [`inference`], [`log`], [`scratch`] and [`trigger`] are the interfaces of
//! the WIT package `gleaner:lambda`. An error in their docs, such as `no-room`, is a case of a WIT
//! variant; [`Error::kind`] returns it, here as [`data::DataErrorKind::NoRoom`].

#![warn(missing_docs)]

/// Implements `From` for a type with one field.
macro_rules! conversions {
    ($target:ident: $($from:ty => |$value:ident| $make:expr),+ $(,)?) => {
        $(impl From<$from> for $target {
            fn from($value: $from) -> Self {
                Self($make)
            }
        })+
    };
}

// Generated, and compared with what is generated. Natively, only its data types are used.
#[allow(dead_code, unused_imports, clippy::too_many_lines)]
#[doc(hidden)]
#[rustfmt::skip]
pub mod bindings;
mod config;
pub mod data;
mod error;
pub mod inference;
pub mod kernels;
mod lambda;
pub mod log;
pub mod scratch;
#[cfg(not(target_family = "wasm"))]
pub mod testing;
pub mod trigger;

#[cfg(target_family = "wasm")]
#[doc(hidden)]
pub use bindings as world;
pub use config::{Config, ConfigValue};
pub use data::{Column, Encoding, Field, Frame, Sample, Tick, Topic, input, inputs, now_ns};
pub use error::{Error, ErrorKind, Result};
pub use inference::{DetectOptions, Detection, Model, Tensor};
pub use lambda::Lambda;
#[doc(hidden)]
pub use lambda::{Exported, Instance};
#[cfg(not(target_family = "wasm"))]
#[doc(hidden)]
pub use testing::bindings as world;
pub use trigger::{event, start, stop};
