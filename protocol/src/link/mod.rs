//! The link between a lambda's process and the recorder: it carries the wakes of the lambda.
//!
//! The program that starts both creates a pair of sockets for each lambda. It passes one end to the
//! recorder, over its standard input, and the other to the lambda's process. So no process listens
//! on a socket, and the socket itself identifies the lambda: no frame carries a lambda's name, and
//! a lambda cannot send for another.
//!
//! - `frame`: a length, a tag, a payload; never longer than [`FRAME_MAX`].
//! - `incoming` and `outgoing`: frames with descriptors, of any connection between programs.
//! - `control`: from the starter to the recorder: [`ControlClient`] and [`ControlServer`].
//! - `client`: from a lambda's process to the recorder, without blocking: [`RecorderLink`].
//! - `server`: the recorder's end of that: [`LambdaLink`].
//! - `report`: from the recorder to its starter, as lines of JSON on its standard output.

mod client;
mod control;
mod error;
pub(crate) mod frame;
mod incoming;
mod outgoing;
mod queue;
#[cfg(test)]
mod rejoin_tests;
mod report;
mod server;
#[cfg(test)]
mod tests;

pub use client::{RecorderLink, RecorderMessage};
pub use control::{AddLambda, ControlClient, ControlMessage, ControlServer};
pub use error::{GrantError, LinkError};
pub use frame::FRAME_MAX;
pub use incoming::Incoming;
pub(crate) use incoming::{FrameReceiver, ReceivedFrame};
pub(crate) use outgoing::{FrameQueue, send_frame, send_json, try_send_frame};
pub use report::{CommandStatus, Loss, RecordedTopic, RecorderReport, RecorderStatus};
pub use server::{LambdaLink, LambdaMessage, LambdaReplies};

/// The program that starts the others, in messages.
pub(crate) const STARTER: &str = "the parent";
