//! Messages between vehicles, people and the cloud.
//!
//! `frame` has the frames of the control channel: one WebSocket per vehicle, opened by it.
//! `enrolment` has the messages by which a vehicle gets its certificate, and `people` those of the
//! API for people; `waves` is the part of it by which a release reaches vehicles step by step.
//! `clips` has those about recorded clips, and `records` those of a search. `object` checks files
//! that are sent. Nothing here opens a connection; with the features of these names, `listener`
//! accepts those of clients, and `openapi` describes an API for other programs.
//!
//! A vehicle is given the complete desired state, never a change of it: a list of deployments, each
//! by the digest of its signed envelope. It fetches envelopes and files that it lacks by HTTPS from
//! the same address, and verifies all of them by its own trust root. What it has recorded goes up
//! in batches, and counts as delivered once the cloud has acknowledged it.

#![warn(missing_docs)]

pub mod clips;
mod enrolment;
mod frame;
#[cfg(feature = "listener")]
pub mod listener;
mod object;
#[cfg(feature = "openapi")]
pub mod openapi;
pub mod people;
mod problem;
pub mod records;
pub mod waves;

pub use enrolment::{
    CERTIFICATE_NAME, EnrolReply, EnrolRequest, Enrolment, EnrolmentError, RenewRequest,
};
pub use frame::{
    Ack, Body, Cursor, Desired, FRAME_MAX, Frame, FrameError, GoAway, Hello, LINES_MAX, PROTOCOL,
    Ping, Pong, RECORDS_MAX, Records, Reported, STATUS_STREAM, STREAM_NAME_MAX, TAIL_S,
    TAIL_STREAMS_MAX, Tail, WANTED_MAX, Wanted, Welcome, compress, decompress, desired_digest,
};
pub use object::{AnnouncedFile, UnfinishedFile};
pub use problem::{CAUSES_MAX, PROBLEM_TEXT_MAX, PROBLEMS_MAX, WantedProblem, problem_text};

#[cfg(test)]
mod tests;
