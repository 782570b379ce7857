//! Why pixels are no image, or an operation on them has no result, in the words that a user sees.

use std::fmt;

use super::ops::MAX_RESIZED_SIDE;
use super::{Encoding, MAX_SIDE, Roi};

/// An image that contradicts itself, or a request about one that makes no sense.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PixelError {
    /// A name that is no encoding which we read.
    UnknownEncoding {
        /// What the message says, at most 40 characters of it.
        name: String,
        /// The names that are understood.
        supported: String,
    },
    /// No pixels, or more than any camera delivers.
    Size {
        /// Pixels per row.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// The rows overlap.
    Step {
        /// Pixels per row.
        width: u32,
        /// Rows.
        height: u32,
        /// What a pixel is.
        encoding: Encoding,
        /// Bytes from a row to the next, as the message says.
        step: u32,
        /// Bytes that the pixels of a row fill.
        needed: usize,
    },
    /// Fewer bytes than the size asks for.
    Data {
        /// Pixels per row.
        width: u32,
        /// Rows.
        height: u32,
        /// What a pixel is.
        encoding: Encoding,
        /// Bytes from a row to the next.
        step: u32,
        /// Bytes up to the end of the last row.
        needed: usize,
        /// Bytes that are there.
        found: usize,
    },
    /// A pixel without the neighbour that holds the other half of its colour.
    OddWidth {
        /// Pixels per row.
        width: u32,
        /// What a pixel is.
        encoding: Encoding,
    },
    /// A region without a pixel.
    Roi {
        /// The region.
        roi: Roi,
        /// Pixels per row of the image.
        width: u32,
        /// Rows of the image.
        height: u32,
    },
    /// An operation on colours, asked of an image that has none yet.
    Raw {
        /// What was asked.
        operation: &'static str,
        /// What a pixel is.
        encoding: Encoding,
    },
    /// A result of no size, or of an absurd one.
    ResizeTo {
        /// Pixels per row that were asked for.
        width: u32,
        /// Rows that were asked for.
        height: u32,
    },
    /// The caller's memory does not fit the result.
    Output {
        /// What was asked.
        operation: &'static str,
        /// Bytes of the result.
        needed: usize,
        /// Bytes of the caller's slice.
        found: usize,
    },
    /// The caller's [`StopCheck`](super::StopCheck) ended an operation.
    Stopped,
}

/// What kind of refusal a [`PixelError`] is, to a caller that answers for others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelErrorKind {
    /// The image, or the operation on such an image, makes no sense or costs too much.
    Unreadable,
    /// The region or the size that was asked for.
    OutOfRange,
    /// The caller ended it.
    Stopped,
}

impl PixelError {
    /// Returns the kind. Each error has to say which it is.
    pub const fn kind(&self) -> PixelErrorKind {
        match self {
            Self::Roi { .. } | Self::ResizeTo { .. } => PixelErrorKind::OutOfRange,
            Self::Stopped => PixelErrorKind::Stopped,
            Self::UnknownEncoding { .. }
            | Self::Size { .. }
            | Self::Step { .. }
            | Self::Data { .. }
            | Self::OddWidth { .. }
            | Self::Raw { .. }
            | Self::Output { .. } => PixelErrorKind::Unreadable,
        }
    }
}

impl fmt::Display for PixelError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UnknownEncoding { name, supported } => {
                write!(f, "encoding `{name}` is not supported; supported are {supported}")
            }
            Self::Size { width, height } => {
                write!(f, "image says it is {width}x{height}; each side must be 1 to {MAX_SIDE}")
            }
            Self::Step { width, height, encoding, step, needed } => {
                let name = encoding.name();
                write!(
                    f,
                    "image of {width}x{height} {name} says a row has {step} bytes; it needs {needed}"
                )
            }
            Self::Data { width, height, encoding, step, needed, found } => {
                write!(
                    f,
                    "image of {width}x{height} {} with {step} bytes per row ",
                    encoding.name()
                )?;
                write!(f, "needs {needed} bytes; it has {found}")
            }
            Self::OddWidth { width, encoding } => {
                write!(f, "image of {} is {width} pixels wide; ", encoding.name())?;
                write!(f, "two pixels share a colour, so the width must be even")
            }
            Self::Roi { roi: Roi { x, y, width: across, height: down }, width, height } => {
                write!(
                    f,
                    "region {across}x{down} at ({x}, {y}) has no pixel in the image of {width}x{height}"
                )
            }
            Self::Raw { operation, encoding } => {
                write!(f, "{operation} of a raw image ({}): ", encoding.name())?;
                write!(f, "its pixels have no colour until it is debayered")
            }
            Self::ResizeTo { width, height } => {
                write!(f, "resize to {width}x{height}: each side must be 1 to {MAX_RESIZED_SIDE}")
            }
            Self::Output { operation, needed, found } => {
                write!(f, "{operation} makes {needed} bytes; the place for them has {found}")
            }
            Self::Stopped => write!(f, "stopped by the caller before the end"),
        }
    }
}

impl std::error::Error for PixelError {}

/// `name` for a message: a hostile one must not fill the log.
pub(super) fn shortened(name: &str) -> String {
    const LONGEST: usize = 40;
    match name.char_indices().nth(LONGEST) {
        None => name.to_owned(),
        Some((end, _)) => format!("{}…", &name[..end]),
    }
}
