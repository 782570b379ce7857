//! Errors of a connection between two programs.

use std::io;

use rustix::io::Errno;

use crate::ingress::GrantError;
use gleaner_base::{Exit, Explain};
use gleaner_journal::MalformedWake;

/// An error of a connection between two programs.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The other side has ended, or closed the connection.
    #[error("{peer} has ended, or closed the connection")]
    Gone {
        /// Its name in messages, such as "the recorder".
        peer: &'static str,
    },
    /// The recorder refuses the lambda.
    #[error("the recorder refuses the lambda: {reason}")]
    Refused {
        /// The reason, from the recorder.
        reason: String,
    },
    /// The recorder does not respond.
    #[error("the recorder has not responded for {seconds} s")]
    Silent {
        /// The timeout.
        seconds: u64,
    },
    /// A frame is too long.
    #[error("frame `{frame}` from {peer} has {bytes} bytes, above the maximum of {max}")]
    TooLong {
        /// Sender of the frame.
        peer: &'static str,
        /// Name of the frame.
        frame: &'static str,
        /// The length in its head.
        bytes: u64,
        /// The maximum.
        max: usize,
    },
    /// A frame has an unknown tag, or one for another connection.
    #[error("frame {tag} from {peer} is unknown")]
    Unknown {
        /// Sender of the frame.
        peer: &'static str,
        /// Tag of the frame.
        tag: u8,
    },
    /// A frame is out of order.
    #[error("received frame `{frame}` from {peer} instead of `{expected}`")]
    Unexpected {
        /// Sender of the frame.
        peer: &'static str,
        /// Name of the frame.
        frame: &'static str,
        /// The expected frame.
        expected: &'static str,
    },
    /// The payload of a frame is invalid.
    #[error("frame `{frame}` from {peer} is invalid: {reason}")]
    Malformed {
        /// Sender of the frame.
        peer: &'static str,
        /// Name of the frame.
        frame: &'static str,
        /// The reason.
        reason: String,
    },
    /// The wake in a frame cannot be decoded.
    #[error("frame `wake` from {peer} cannot be decoded")]
    Wake {
        /// Sender of the frame.
        peer: &'static str,
        /// The cause.
        source: MalformedWake,
    },
    /// A frame lacks the descriptor that belongs to it.
    #[error("frame `{frame}` came without its descriptor")]
    NoDescriptor {
        /// Name of the frame.
        frame: &'static str,
    },
    /// The socket of a reader did not arrive: the ingress has too many open files.
    #[error("cannot serve reader `{reader}`: its socket did not arrive")]
    NoSocket {
        /// Name of the reader.
        reader: String,
    },
    /// The starter did not pass a connection that the program needs.
    #[error("the starter passed no connection `{name}`")]
    NoConnection {
        /// Its name.
        name: &'static str,
    },
    /// The standard input of a program is no connection to a starter.
    #[error("the standard input is no socket of a program that starts this one")]
    NoStarter,
    /// The other side is of another version, and may share memory of another layout.
    #[error("{peer} is of version `{version}` of Gleaner, this program of {own}")]
    OtherVersion {
        /// Its name in messages.
        peer: &'static str,
        /// Its version.
        version: String,
        /// The version of this program.
        own: &'static str,
    },
    /// A grant to a reader is invalid.
    #[error("cannot grant topics to a reader")]
    Grant {
        /// The cause.
        source: GrantError,
    },
    /// The other side does not read, and the queue of messages to it is full.
    #[error("{peer} does not read its messages")]
    Full {
        /// Its name in messages.
        peer: &'static str,
    },
    /// The socket failed.
    #[error("the connection to {peer} failed")]
    Socket {
        /// The other end.
        peer: &'static str,
        /// The error of the system.
        source: io::Error,
    },
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
            LinkError::Grant { source } => source.help(),
            _ => None,
        }
    }

    fn exit(&self) -> Exit {
        match self {
            LinkError::Gone { .. } | LinkError::Silent { .. } | LinkError::Socket { .. } => {
                Exit::Unreachable
            }
            LinkError::Refused { .. } | LinkError::NoStarter => Exit::Usage,
            LinkError::Grant { source } => source.exit(),
            _ => Exit::Internal,
        }
    }
}
