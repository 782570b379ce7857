//! Hosts one lambda. The rooms follow the path of a sample: `input` holds it, `schedule` notices
//! it, `invoker` has the guest decide over `api`. `replay` feeds them from a recorded drive, `live`
//! from the topics of a vehicle; both begin with `session_setup`.
//!
//! The same library runs in `gleaner-runtime` (WebAssembly) and, loaded as `_gleaner`, in a Python
//! interpreter. Nothing outside `guest` depends on the kind of lambda.

pub mod api;
mod check;
pub mod guest;
pub mod input;
pub mod invoker;
pub mod isolation;
pub mod journal;
pub mod live;
pub mod memory;
pub mod program;
pub mod replay;
pub mod schedule;
pub mod session_setup;
#[cfg(test)]
mod test_decision;
