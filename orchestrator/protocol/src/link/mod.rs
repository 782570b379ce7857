//! How a lambda's process tells the recorder what it decided, and how both come to be connected.
//!
//! Whoever starts them makes a pair of sockets for each lambda, and hands one end to the recorder,
//! over its standard input, and the other to the lambda's process. So nobody listens anywhere, and
//! a socket is all that says who somebody is: no frame carries a lambda's name, and a lambda can
//! say nothing for another.
//!
//! - `frame`: a length, a tag, a payload; never longer than [`FRAME_MAX`].
//! - `control`: from the starter to the recorder: [`ControlClient`] and [`ControlServer`].
//! - `client`: from a lambda's process to the recorder, without ever waiting for it:
//!   [`RecorderLink`].
//! - `server`: the recorder's end of that: [`LambdaLink`].
//! - `report`: what the recorder says to its starter, as lines of JSON on its standard output.

mod client;
mod control;
mod error;
mod frame;
mod queue;
mod report;
mod server;
#[cfg(test)]
mod tests;

pub use client::{RecorderLink, RecorderMessage};
pub use control::{AddLambda, ControlClient, ControlMessage, ControlServer};
pub use error::LinkError;
pub use frame::FRAME_MAX;
pub use report::{CommandStatus, Loss, RecordedTopic, RecorderReport, RecorderStatus};
pub use server::{LambdaLink, LambdaMessage, LambdaReplies};
