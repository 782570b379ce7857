//! Errors of images and of operations on them, with their messages for users.

use std::fmt;

use super::ops::MAX_RESIZED_SIDE;
use super::{Encoding, MAX_SIDE, Roi};

/// An invalid image, or an invalid request on an image.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PixelError {
    UnknownEncoding {
        /// The name in the message, cut to 40 characters.
        name: String,
        supported: String,
    },
    /// A side of the image is 0 or too long.
    Size { width: u32, height: u32 },
    /// The step is too small, so the rows would overlap.
    Step {
        width: u32,
        height: u32,
        encoding: Encoding,
        /// Bytes from a row to the next, by the message.
        step: u32,
        /// Bytes of the pixels of a row.
        needed: usize,
    },
    /// Too few bytes for the size.
    Data {
        width: u32,
        height: u32,
        encoding: Encoding,
        /// Bytes from a row to the next.
        step: u32,
        /// Bytes up to the end of the last row.
        needed: usize,
        /// Available bytes.
        found: usize,
    },
    /// A pixel without the neighbour that has the other half of its colour.
    OddWidth { width: u32, encoding: Encoding },
    /// A region without a pixel.
    Roi {
        roi: Roi,
        /// Pixels per row of the image.
        width: u32,
        height: u32,
    },
    /// An operation on colours of an image that is not debayered.
    Raw { operation: &'static str, encoding: Encoding },
    /// A size of 0, or too large a size, for the result.
    ResizeTo {
        /// Requested pixels per row.
        width: u32,
        height: u32,
    },
    /// The length of the caller's slice is not that of the result.
    Output {
        operation: &'static str,
        /// Bytes of the result.
        needed: usize,
        /// Bytes of the caller's slice.
        found: usize,
    },
    /// The caller's [`StopCheck`](super::StopCheck) ended the operation.
    Stopped,
}

/// The kind of a [`PixelError`], for conversion to other errors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelErrorKind {
    /// The image is invalid, or does not support the operation.
    Unreadable,
    /// The requested region or size is invalid.
    OutOfRange,
    Stopped,
}

impl PixelError {
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
                write!(f, "image size is {width}x{height}; each side must be 1 to {MAX_SIDE}")
            }
            Self::Step { width, height, encoding, step, needed } => {
                let name = encoding.name();
                write!(
                    f,
                    "image of {width}x{height} {name} has a step of {step} bytes; \
                     a row needs {needed}"
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
                    "region {across}x{down} at ({x}, {y}) has no pixel \
                     in the image of {width}x{height}"
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
                write!(f, "{operation} needs {needed} bytes; the output has {found}")
            }
            Self::Stopped => write!(f, "stopped by the caller before the end"),
        }
    }
}

impl std::error::Error for PixelError {}
