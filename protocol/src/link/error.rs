//! Errors of a connection between two programs.

use std::io;

use rustix::io::Errno;

use gleaner_base::{Exit, Explain};
use gleaner_journal::MalformedWake;

/// A grant with a value out of bounds.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the grant of {what} is invalid: `{field}` {reason}")]
pub struct GrantError {
    /// The topic or reader.
    pub(crate) what: String,
    /// The invalid field.
    pub(crate) field: &'static str,
    /// The reason: "is 0, instead of 1 to 65536".
    pub(crate) reason: String,
}

/// An error of a connection between two programs. `peer` is the other end, or the sender of a
/// frame, by its name in messages, such as "the recorder".
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum LinkError {
    #[error("{peer} has ended, or closed the connection")]
    Gone { peer: &'static str },
    #[error("the recorder refuses the lambda: {reason}")]
    Refused { reason: String },
    #[error("the recorder has not responded for {seconds} s")]
    Silent { seconds: u64 },
    /// A frame is too long: `bytes` is the length in its head.
    #[error("frame `{frame}` from {peer} has {bytes} bytes, above the maximum of {max}")]
    TooLong { peer: &'static str, frame: &'static str, bytes: u64, max: usize },
    /// A frame has an unknown tag, or one for another connection.
    #[error("frame {tag} from {peer} is unknown")]
    Unknown { peer: &'static str, tag: u8 },
    #[error("received frame `{frame}` from {peer} instead of `{expected}`")]
    Unexpected { peer: &'static str, frame: &'static str, expected: &'static str },
    #[error("frame `{frame}` from {peer} is invalid: {reason}")]
    Malformed { peer: &'static str, frame: &'static str, reason: String },
    #[error("frame `wake` from {peer} cannot be decoded")]
    Wake { peer: &'static str, source: MalformedWake },
    #[error("frame `{frame}` came without its descriptor")]
    NoDescriptor { frame: &'static str },
    /// The socket of a reader did not arrive: the ingress has too many open files.
    #[error("cannot serve reader `{reader}`: its socket did not arrive")]
    NoSocket { reader: String },
    #[error("the parent passed no connection `{name}`")]
    NoConnection { name: &'static str },
    #[error("standard input is not a socket of the program that starts this one")]
    NoStarter,
    /// The other side is of another version, and may share memory of another layout.
    #[error("{peer} is of version `{version}` of Gleaner, this program of {own}")]
    OtherVersion { peer: &'static str, version: String, own: &'static str },
    #[error("cannot grant topics to a reader")]
    Grant { source: GrantError },
    /// The other side does not read, and the queue of messages to it is full.
    #[error("{peer} does not read its messages")]
    Full { peer: &'static str },
    #[error("the connection to {peer} failed")]
    Socket { peer: &'static str, source: io::Error },
}

impl LinkError {
    /// Converts the error of a socket to `peer`.
    pub(crate) fn of(peer: &'static str, error: Errno) -> LinkError {
        match error {
            Errno::PIPE | Errno::CONNRESET => LinkError::Gone { peer },
            error => LinkError::Socket { peer, source: error.into() },
        }
    }
}

impl Explain for LinkError {
    fn help(&self) -> Option<String> {
        match self {
            LinkError::Refused { .. } => {
                Some("build the lambda again, and restart recorder and lambda".to_owned())
            }
            LinkError::Unknown { .. } | LinkError::OtherVersion { .. } => {
                Some("use programs of the same version of Gleaner".to_owned())
            }
            LinkError::NoStarter => {
                Some("start it with `gleaner run`, which passes it its connections".to_owned())
            }
            _ => None,
        }
    }

    fn exit(&self) -> Exit {
        match self {
            LinkError::Gone { .. } | LinkError::Silent { .. } | LinkError::Socket { .. } => {
                Exit::Unreachable
            }
            LinkError::Refused { .. } | LinkError::NoStarter | LinkError::Grant { .. } => {
                Exit::Usage
            }
            _ => Exit::Internal,
        }
    }
}
