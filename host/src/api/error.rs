//! Why a read of data failed, in words for the lambda's author.

use gleaner_image::{ImageError, PixelError};
use gleaner_messages::{CdrError, PathError};
use gleaner_rules::clamps::WrongField;
use gleaner_rules::frames::NoRoom;
use gleaner_rules::refused;

/// Why a read of data failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
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
    OutOfRange(PixelError),
    #[error("the deadline is over")]
    OutOfTime,
}
