//! Errors of reading an image, worded for users.

use gleaner_rules::pixels::{PixelError, PixelErrorKind};
use gleaner_rules::refused;
use gleaner_rules::text::RoundedBytes;

use super::{Format, ImageHeader};

/// An image, or a request about one, that is invalid or too expensive.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// Pixels that are not an image, an operation on them without a result, or one that the caller
    /// stopped.
    #[error(transparent)]
    Pixels(#[from] PixelError),
    /// A `CompressedImage` with a format that is not decoded, or does not match its bytes.
    #[error("format `{format}`: {why}")]
    MessageFormat {
        /// The format, or the start of a long one.
        format: String,
        /// The reason and the way out.
        why: String,
    },
    #[error("data is neither JPEG nor PNG: its {len} bytes start with {start:02x?}")]
    NotAnImage { len: usize, start: Vec<u8> },
    /// A small file of a huge image.
    #[error("{}", refused::too_many_pixels((*width, *height), *needed, *allowed as u64))]
    Bomb {
        width: u32,
        height: u32,
        /// Bytes as rgb8.
        needed: u64,
        /// Bytes that the input may have.
        allowed: usize,
    },
    #[error(
        "{format} of {width}x{height} needs {} to decode, besides its pixels; {} is allowed",
        RoundedBytes::up(*needed),
        RoundedBytes::down(*allowed as u64)
    )]
    WorkingMemory { format: Format, width: u32, height: u32, needed: u64, allowed: usize },
    #[error("{found} where a {expected} was expected")]
    OtherImage { expected: ImageHeader, found: ImageHeader },
    #[error("{format} is truncated: its {len} bytes end before the image does")]
    Truncated { format: Format, len: usize },
    #[error("{format} is {what}, which is not supported: publish baseline JPEG, or PNG of 8 bits")]
    Unsupported { format: Format, what: &'static str },
    #[error("{format} is damaged at byte {at}: {what}")]
    Damaged { format: Format, at: usize, what: &'static str },
    #[error(
        "resize of mono16 would keep 8 of its 16 bits: call `to_gray` first, or read its pixels"
    )]
    ResizeOfMono16,
    /// The JPEG decoder failed. Its cause is in the text: a lambda's author sees one line.
    #[error("cannot decode the JPEG of {width}x{height}: {cause}")]
    Jpeg { width: u32, height: u32, cause: zune_jpeg::errors::DecodeErrors },
    #[error("cannot decode the PNG of {width}x{height}: {cause}")]
    Png { width: u32, height: u32, cause: png::DecodingError },
}

impl ImageError {
    /// Returns the kind; listed without a wildcard, so that each new error is classified.
    pub fn kind(&self) -> PixelErrorKind {
        match self {
            Self::Pixels(error) => error.kind(),
            Self::MessageFormat { .. }
            | Self::NotAnImage { .. }
            | Self::Bomb { .. }
            | Self::WorkingMemory { .. }
            | Self::OtherImage { .. }
            | Self::Truncated { .. }
            | Self::Unsupported { .. }
            | Self::Damaged { .. }
            | Self::ResizeOfMono16
            | Self::Jpeg { .. }
            | Self::Png { .. } => PixelErrorKind::Unreadable,
        }
    }
}
