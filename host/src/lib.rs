//! Hosts one lambda. The rooms follow the path of a sample: `input` holds it, `schedule` notices
//! it, `judge` lets the guest decide over `api`, `replay` drives the whole from a recorded drive,
//! `live` from the topics of a vehicle; what both need is in `stage`.
//!
//! The same library runs in `gleaner-runtime` (WebAssembly) and, loaded as `_gleaner`, in a Python
//! interpreter. Nothing outside `guest` knows which kind of lambda it runs.

pub mod api;
mod check;
pub mod guest;
pub mod input;
pub mod isolation;
pub mod journal;
pub mod judge;
pub mod live;
pub mod memory;
#[cfg(feature = "dds")]
mod network;
pub mod program;
pub mod replay;
pub mod schedule;
pub mod stage;
#[cfg(feature = "dds")]
mod topics;
