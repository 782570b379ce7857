//! Why a read of data failed, in words for the lambda's author.

use gleaner_transport::message::{CdrError, PathError};

use gleaner_image::ImageError;

use super::fuel::OutOfFuel;

/// Why a read of data failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum DataError {
    #[error("no input `{asked}`; the manifest has {}", list(known))]
    NoSuchInput { asked: String, known: Vec<String> },
    #[error("{0}")]
    NoSuchField(PathError),
    #[error("field `{path}` {why}")]
    WrongField { path: String, why: String },
    #[error("a sample of `{topic}` contradicts its type `{type_name}`: {source}")]
    Malformed { topic: String, type_name: String, source: CdrError },
    #[error("a sample of `{topic}` is no image: its type is `{type_name}`")]
    NoImageType { topic: String, type_name: String },
    #[error("a sample of `{topic}` is no image that can be read: {source}")]
    NotAFrame { topic: String, source: ImageError },
    #[error("an image of `{topic}` is too large: {source}")]
    TooLarge { topic: String, source: ImageError },
    #[error(
        "every slot for decoded images of `{topic}` is held; drop frames that are not needed, or raise `hold` of input `{input}`"
    )]
    NoSlot { topic: String, input: String },
    #[error(
        "{asked} bytes for a new frame, {left} are left; drop frames that are not needed, or raise `memory` in [limits]"
    )]
    NoMemory { asked: usize, left: usize },
    #[error("the lambda holds {allowed} frames; drop frames that are not needed, or raise `frames` in [limits]")]
    TooManyFrames { allowed: usize },
    #[error("{0}")]
    OutOfRange(ImageError),
    #[error("the deadline is over")]
    OutOfTime,
    #[error(transparent)]
    OutOfFuel(#[from] OutOfFuel),
}

/// Which of the refusals of `wit/types.wit` a lambda gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum DataErrorKind {
    NoSuchInput,
    NoSuchField,
    WrongField,
    Malformed,
    NotAFrame,
    NoRoom,
    OutOfRange,
}

impl DataErrorKind {
    /// The name in the WIT.
    pub fn name(self) -> &'static str {
        match self {
            Self::NoSuchInput => "no-such-input",
            Self::NoSuchField => "no-such-field",
            Self::WrongField => "wrong-field",
            Self::Malformed => "malformed",
            Self::NotAFrame => "not-a-frame",
            Self::NoRoom => "no-room",
            Self::OutOfRange => "out-of-range",
        }
    }
}

impl DataError {
    /// The refusal that a lambda gets.
    pub fn kind(&self) -> DataErrorKind {
        match self {
            Self::NoSuchInput { .. } => DataErrorKind::NoSuchInput,
            Self::NoSuchField(_) => DataErrorKind::NoSuchField,
            Self::WrongField { .. } => DataErrorKind::WrongField,
            Self::Malformed { .. } => DataErrorKind::Malformed,
            Self::NoImageType { .. } | Self::NotAFrame { .. } => DataErrorKind::NotAFrame,
            Self::TooLarge { .. } | Self::NoSlot { .. } | Self::NoMemory { .. } | Self::TooManyFrames { .. } => {
                DataErrorKind::NoRoom
            }
            Self::OutOfRange(_) => DataErrorKind::OutOfRange,
            // Whoever can end a guest ends it instead.
            Self::OutOfTime | Self::OutOfFuel(_) => DataErrorKind::NoRoom,
        }
    }
}

fn list(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { format!("`{}`", names.join("`, `")) }
}
