//! Errors of a feed.

use std::error::Error;
use std::fmt;
use std::io;

use gleaner_base::{Exit, Explain};
use gleaner_protocol::ingress::RefusedTopic;
use gleaner_protocol::link::LinkError;

#[derive(Debug, thiserror::Error)]
pub enum FeedError {
    /// The ingress has ended, or closed the connection. Held samples stay valid.
    #[error("the ingress has ended, or closed the connection")]
    Gone,
    #[error("the ingress has not sent {awaited} for {seconds} s")]
    Silent {
        /// The message, such as "topic 3".
        awaited: String,
        seconds: u64,
    },
    #[error("{}", text(reason))]
    Refused { id: u32, reason: RefusedTopic, source: Option<RefusalCause> },
    /// A message contradicts an earlier one, or does not match its descriptor.
    #[error("a message of the ingress is invalid: {reason}")]
    Malformed { reason: String },
    #[error("cannot map the control page")]
    Control { source: io::Error },
    #[error("cannot communicate with the ingress")]
    Socket { source: LinkError },
}

#[derive(Debug)]
pub struct RefusalCause {
    text: String,
    source: Option<Box<RefusalCause>>,
}

impl fmt::Display for RefusalCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl Error for RefusalCause {
    fn source(&self) -> Option<&(dyn Error + 'static)> {
        self.source.as_deref().map(|cause| cause as _)
    }
}

/// Returns a refusal as text, without its causes.
fn text(reason: &RefusedTopic) -> String {
    match reason {
        RefusedTopic::NoSuchTopic { .. } => "the source has no such topic".to_owned(),
        RefusedTopic::WrongType { found } => {
            format!("the topic has type `{found}`, not the one that was granted")
        }
        RefusedTopic::Other(lines) => {
            lines.first().cloned().unwrap_or_else(|| "the ingress refuses the topic".to_owned())
        }
    }
}

impl FeedError {
    /// Returns the error of a topic that cannot be read.
    pub fn refused(id: u32, reason: RefusedTopic) -> FeedError {
        let causes = match &reason {
            RefusedTopic::Other(lines) => lines.get(1..).unwrap_or_default(),
            _ => &[],
        };
        let source = causes.iter().rev().fold(None, |source, text| {
            Some(RefusalCause { text: text.clone(), source: source.map(Box::new) })
        });
        FeedError::Refused { id, reason, source }
    }

    pub(crate) fn malformed(reason: impl Into<String>) -> FeedError {
        FeedError::Malformed { reason: reason.into() }
    }
}

impl From<LinkError> for FeedError {
    fn from(error: LinkError) -> Self {
        match error {
            LinkError::Gone { .. } => FeedError::Gone,
            source => FeedError::Socket { source },
        }
    }
}

impl Explain for FeedError {
    fn help(&self) -> Option<String> {
        match self {
            FeedError::Refused { reason: RefusedTopic::NoSuchTopic { known, nearest }, .. } => {
                Some(match nearest {
                    Some(nearest) => format!("the most similar topic is `{nearest}`"),
                    None => format!("the source has {} topics", known.len()),
                })
            }
            FeedError::Socket { source } => source.help(),
            _ => None,
        }
    }

    fn exit(&self) -> Exit {
        match self {
            FeedError::Gone | FeedError::Silent { .. } => Exit::Unreachable,
            FeedError::Refused { .. } => Exit::Usage,
            FeedError::Malformed { .. } | FeedError::Control { .. } => Exit::Internal,
            FeedError::Socket { source } => source.exit(),
        }
    }
}
