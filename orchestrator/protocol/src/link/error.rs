//! Errors of a connection between two programs.

use std::io;

use rustix::io::Errno;

use super::FRAME_MAX;
use gleaner_base::{Exit, Explain};
use gleaner_journal::MalformedWake;

/// An error of a connection between two programs.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The other side has ended, or closed the connection.
    #[error("{peer} has ended, or closed the connection")]
    Gone {
        /// "the recorder", "the lambda" or "the starter".
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
    #[error("frame `{frame}` from {peer} has {bytes} bytes, above the maximum of {FRAME_MAX}")]
    TooLong {
        /// Sender of the frame.
        peer: &'static str,
        /// Name of the frame.
        frame: &'static str,
        /// The length in its head.
        bytes: u64,
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
    /// A lambda was added without its socket.
    #[error("frame `add` came without a socket")]
    NoSocket,
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
    pub(super) fn of(peer: &'static str, error: Errno) -> LinkError {
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
            LinkError::Unknown { .. } => {
                Some("use recorder and runtime of the same version".to_owned())
            }
            _ => None,
        }
    }

    fn exit(&self) -> Exit {
        match self {
            LinkError::Gone { .. } | LinkError::Silent { .. } | LinkError::Socket { .. } => {
                Exit::Unreachable
            }
            LinkError::Refused { .. } => Exit::Usage,
            _ => Exit::Internal,
        }
    }
}
