//! Why a read of data failed, in words for the lambda's author.

use gleaner_messages::{CdrError, PathError};

use gleaner_image::ImageError;

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
}

fn list(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { format!("`{}`", names.join("`, `")) }
}
