//! Why an image cannot be read, in the words that a user sees.

use gleaner_rules::pixels::{PixelError, PixelErrorKind};
use gleaner_rules::refused;
use gleaner_rules::text::Rounded;

use super::{Format, Header};

/// An image, or a request about one, that makes no sense or costs too much.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// Pixels that are no image, an operation on them without a result, or one that the caller
    /// ended.
    #[error(transparent)]
    Pixels(#[from] PixelError),
    /// Bytes that are no image file.
    #[error("data is neither JPEG nor PNG: its {len} bytes start with {start:02x?}")]
    NotAnImage {
        /// Bytes that are there.
        len: usize,
        /// The first eight of them.
        start: Vec<u8>,
    },
    /// A file which is small, of an image which is not.
    #[error("{}", refused::too_many_pixels((*width, *height), *needed, *allowed as u64))]
    Bomb {
        /// Pixels per row.
        width: u32,
        /// Rows.
        height: u32,
        /// Bytes as rgb8.
        needed: u64,
        /// Bytes that the input may have.
        allowed: usize,
    },
    /// A file whose decoder would need far more memory than its pixels.
    #[error("{format} of {width}x{height} needs {} to decode, besides its pixels; {} is allowed", Rounded::up(*needed), Rounded::down(*allowed as u64))]
    WorkingMemory {
        /// What the file is.
        format: Format,
        /// Pixels per row.
        width: u32,
        /// Rows.
        height: u32,
        /// Bytes that the decoder would allocate.
        needed: u64,
        /// Bytes that it may.
        allowed: usize,
    },
    /// The bytes are not those whose header was read.
    #[error("{found} where a {expected} was announced")]
    OtherImage {
        /// The header that the caller brought.
        expected: Header,
        /// The header of the bytes.
        found: Header,
    },
    /// The file stops in the middle.
    #[error("{format} is cut off: its {len} bytes end before the image does")]
    CutOff {
        /// What the file is.
        format: Format,
        /// Bytes that are there.
        len: usize,
    },
    /// A kind of file that cameras do not send.
    #[error("{format} is {what}, which is not supported")]
    Unsupported {
        /// What the file is.
        format: Format,
        /// The kind.
        what: &'static str,
    },
    /// A file that breaks the rules of its format.
    #[error("{format} is damaged at byte {at}: {what}")]
    Damaged {
        /// What the file is.
        format: Format,
        /// Where.
        at: usize,
        /// What is wrong.
        what: &'static str,
    },
    /// The JPEG decoder gave up.
    #[error("cannot decode the JPEG of {width}x{height}")]
    Jpeg {
        /// Pixels per row.
        width: u32,
        /// Rows.
        height: u32,
        /// Why.
        source: zune_jpeg::errors::DecodeErrors,
    },
    /// The PNG decoder gave up.
    #[error("cannot decode the PNG of {width}x{height}")]
    Png {
        /// Pixels per row.
        width: u32,
        /// Rows.
        height: u32,
        /// Why.
        source: png::DecodingError,
    },
}

impl ImageError {
    /// The kind: each error has to say which it is.
    pub fn kind(&self) -> PixelErrorKind {
        match self {
            Self::Pixels(error) => error.kind(),
            Self::NotAnImage { .. }
            | Self::Bomb { .. }
            | Self::WorkingMemory { .. }
            | Self::OtherImage { .. }
            | Self::CutOff { .. }
            | Self::Unsupported { .. }
            | Self::Damaged { .. }
            | Self::Jpeg { .. }
            | Self::Png { .. } => PixelErrorKind::Unreadable,
        }
    }
}
