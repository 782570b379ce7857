use std::io;

use rustix::io::Errno;

use super::FRAME_MAX;
use gleaner_base::{Exit, Explain};
use gleaner_journal::Malformed;

/// Why two programs do not understand each other.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The other side has closed the connection: it has ended, or does not want to be connected any
    /// more.
    #[error("{who} has ended, or closed the connection")]
    Gone {
        /// Who: "the recorder", "the lambda" or "the starter".
        who: &'static str,
    },
    /// The recorder does not take a lambda.
    #[error("the recorder refuses the lambda: {why}")]
    Refused {
        /// Why, in its words.
        why: String,
    },
    /// The recorder does not answer.
    #[error("the recorder has not answered for {seconds} s")]
    Silent {
        /// How long it was waited for.
        seconds: u64,
    },
    /// A frame is longer than any may be.
    #[error("frame `{frame}` from {who} has {bytes} bytes, above the maximum of {FRAME_MAX}")]
    TooLong {
        /// Whose frame it is.
        who: &'static str,
        /// Its name.
        frame: &'static str,
        /// What its head claims.
        bytes: u64,
    },
    /// A frame that there is none of, or not here.
    #[error("frame {tag} from {who} is not known here")]
    Unknown {
        /// Whose frame it is.
        who: &'static str,
        /// Its tag.
        tag: u8,
    },
    /// A frame comes where another one is due.
    #[error("frame `{frame}` from {who} comes where `{due}` is due")]
    Unexpected {
        /// Whose frame it is.
        who: &'static str,
        /// Its name.
        frame: &'static str,
        /// What should have come.
        due: &'static str,
    },
    /// The payload of a frame is not what it should be.
    #[error("frame `{frame}` from {who} cannot be read: {why}")]
    Malformed {
        /// Whose frame it is.
        who: &'static str,
        /// Its name.
        frame: &'static str,
        /// What is wrong with it.
        why: String,
    },
    /// A wake in a frame is none.
    #[error("frame `wake` from {who} is none")]
    Wake {
        /// Whose frame it is.
        who: &'static str,
        /// What is wrong with it.
        source: Malformed,
    },
    /// A lambda was announced without its socket.
    #[error("frame `add` came without a socket")]
    NoSocket,
    /// The socket fails.
    #[error("cannot talk to {who}")]
    Socket {
        /// Who is at the other end.
        who: &'static str,
        /// What the system said.
        source: io::Error,
    },
}

impl LinkError {
    /// What the system says of a socket to `who`.
    pub(super) fn of(who: &'static str, error: Errno) -> LinkError {
        match error {
            Errno::PIPE | Errno::CONNRESET => LinkError::Gone { who },
            error => LinkError::Socket { who, source: error.into() },
        }
    }
}

impl Explain for LinkError {
    fn help(&self) -> Option<String> {
        match self {
            LinkError::Refused { .. } => {
                Some("build the lambda again, and start recorder and lambda anew".to_owned())
            }
            LinkError::Unknown { .. } => Some("use recorder and runtime of one version".to_owned()),
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
