//! Errors of reads, with texts for the lambda's author.

use gleaner_messages::{CdrError, PathError};
use gleaner_pixels::ImageError;
use gleaner_rules::clamps::WrongField;
use gleaner_rules::frames::NoRoom;
use gleaner_rules::refused;

use super::fuel::OutOfFuel;

#[derive(Debug, thiserror::Error)]
pub enum DataError {
    #[error("{}", refused::no_such_input(asked, known))]
    NoSuchInput { asked: String, known: Vec<String> },
    #[error("{0}")]
    NoSuchField(PathError),
    #[error(transparent)]
    WrongField(#[from] WrongField),
    #[error("{}", refused::malformed(topic, type_name, source))]
    Malformed { topic: String, type_name: String, source: CdrError },
    #[error("{}", refused::no_image_type(topic, type_name))]
    NoImageType { topic: String, type_name: String },
    #[error("{}", refused::not_a_frame(topic, source))]
    NotAFrame { topic: String, source: ImageError },
    #[error("{}", refused::too_large(topic, source))]
    TooLarge { topic: String, source: ImageError },
    #[error("{}", refused::no_slot(topic, input))]
    NoSlot { topic: String, input: String },
    #[error(transparent)]
    NoRoom(#[from] NoRoom),
    #[error("{0}")]
    OutOfRange(ImageError),
    #[error(
        "{bytes} bytes of a {kind} of `{topic}` are requested; one call returns at most {most}: \
         read it in pieces, by `offset` and `len`"
    )]
    TooLong { kind: &'static str, topic: String, bytes: usize, most: usize },
    #[error(
        "the lambda keeps too many samples of input `{input}`: raise `hold` of this [[input]], or \
         keep fewer"
    )]
    OutOfHolds { input: String },
    #[error("the deadline has passed")]
    OutOfTime,
    #[error(transparent)]
    OutOfFuel(#[from] OutOfFuel),
}

/// Cases of `data-error` in `wit/types.wit`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
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
    /// The case that the lambda receives.
    pub fn kind(&self) -> DataErrorKind {
        match self {
            Self::NoSuchInput { .. } => DataErrorKind::NoSuchInput,
            Self::NoSuchField(_) => DataErrorKind::NoSuchField,
            Self::WrongField { .. } => DataErrorKind::WrongField,
            Self::Malformed { .. } => DataErrorKind::Malformed,
            Self::NoImageType { .. } | Self::NotAFrame { .. } => DataErrorKind::NotAFrame,
            Self::TooLarge { .. } | Self::NoSlot { .. } | Self::NoRoom(_) => DataErrorKind::NoRoom,
            Self::OutOfRange(_) | Self::TooLong { .. } => DataErrorKind::OutOfRange,
            // A guest that can be interrupted is ended instead.
            Self::OutOfHolds { .. } | Self::OutOfTime | Self::OutOfFuel(_) => DataErrorKind::NoRoom,
        }
    }
}
