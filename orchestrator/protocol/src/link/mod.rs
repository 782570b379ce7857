//! How a lambda's process tells the recorder what it decided, and how both come to be connected.
//!
//! Whoever starts them makes a pair of sockets for each lambda, and hands one end to the recorder,
//! over its standard input, and the other to the lambda's process. So nobody listens anywhere, and
//! a socket is all that says who somebody is: no frame carries a lambda's name, and a lambda can
//! say nothing for another.
//!
//! - `frame`: a length, a tag, a payload; never longer than [`FRAME_MAX`].
//! - `control`: from the starter to the recorder: [`Control`] and [`Controlled`].
//! - `sending`: from a lambda's process to the recorder, without ever waiting for it:
//!   [`RecorderLink`].
//! - `hearing`: the recorder's end of that: [`LambdaLink`].
//! - `report`: what the recorder says to its starter, as lines of JSON on its standard output.

mod control;
mod error;
mod frame;
mod hearing;
mod queue;
mod report;
mod sending;
#[cfg(test)]
mod tests;

pub use control::{Add, Control, Controlled, Order};
pub use error::LinkError;
pub use frame::FRAME_MAX;
pub use hearing::{Answers, Heard, LambdaLink};
pub use report::{CommandStatus, Loss, RecordedTopic, RecorderReport, RecorderStatus};
pub use sending::{RecorderLink, Said};
