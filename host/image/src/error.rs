//! Why an image cannot be read, in the words that a user sees.

use std::fmt;

use super::{Encoding, Format, Header, Roi};

/// An image, or a request about one, that makes no sense or costs too much.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// A name that is no encoding which we read.
    #[error("encoding `{name}` is not supported; supported are {supported}")]
    UnknownEncoding {
        /// What the message says, at most 40 characters of it.
        name: String,
        /// The names that are understood.
        supported: String,
    },
    /// Nothing to see, or more than any camera delivers.
    #[error("image says it is {width}x{height}; each side must be 1 to {max}", max = super::MAX_SIDE)]
    Size {
        /// Pixels per row.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// The rows overlap.
    #[error("image of {width}x{height} {} says a row has {step} bytes; it needs {needed}", encoding.name())]
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
    #[error("image of {width}x{height} {} with {step} bytes per row needs {needed} bytes; it has {found}", encoding.name())]
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
    #[error("image of {} is {width} pixels wide; two pixels share a colour, so the width must be even", encoding.name())]
    OddWidth {
        /// Pixels per row.
        width: u32,
        /// What a pixel is.
        encoding: Encoding,
    },
    /// A region without a pixel.
    #[error("region {}x{} at ({}, {}) has no pixel in the image of {width}x{height}", roi.width, roi.height, roi.x, roi.y)]
    Roi {
        /// The region.
        roi: Roi,
        /// Pixels per row of the image.
        width: u32,
        /// Rows of the image.
        height: u32,
    },
    /// An operation on colours, asked of an image that has none yet.
    #[error("{operation} of a raw image ({}): its pixels have no colour until it is debayered", encoding.name())]
    Raw {
        /// What was asked.
        operation: &'static str,
        /// What a pixel is.
        encoding: Encoding,
    },
    /// A result of no size, or of an absurd one.
    #[error("resize to {width}x{height}: each side must be 1 to {max}", max = super::ops::MAX_RESIZED_SIDE)]
    ResizeTo {
        /// Pixels per row that were asked for.
        width: u32,
        /// Rows that were asked for.
        height: u32,
    },
    /// The caller's memory does not fit the result.
    #[error("{operation} makes {needed} bytes; the place for them has {found}")]
    Output {
        /// What was asked.
        operation: &'static str,
        /// Bytes of the result.
        needed: usize,
        /// Bytes of the caller's slice.
        found: usize,
    },
    /// Bytes that are no image file.
    #[error("data is neither JPEG nor PNG: its {len} bytes start with {start:02x?}")]
    NotAnImage {
        /// Bytes that are there.
        len: usize,
        /// The first eight of them.
        start: Vec<u8>,
    },
    /// A file which is small, of an image which is not.
    #[error("image says it is {width}x{height} ({} as rgb8); this input's decoded_size is {}", Rounded::up(*needed), Rounded::down(*allowed))]
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
    #[error("{format} of {width}x{height} needs {} to decode, besides its pixels; {} is allowed", Rounded::up(*needed), Rounded::down(*allowed))]
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
    /// The caller's [`Pace`](super::Pace) ended an operation.
    #[error("stopped by the caller before the end")]
    Stopped,
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

/// What kind of refusal an [`ImageError`] is, to a caller that answers for others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageErrorKind {
    /// The image, or the operation on such an image, makes no sense or costs too much.
    Unreadable,
    /// The region or the size that was asked for.
    OutOfRange,
    /// The caller ended it.
    Stopped,
}

impl ImageError {
    /// The kind: each error has to say which it is.
    pub fn kind(&self) -> ImageErrorKind {
        match self {
            Self::Roi { .. } | Self::ResizeTo { .. } => ImageErrorKind::OutOfRange,
            Self::Stopped => ImageErrorKind::Stopped,
            Self::UnknownEncoding { .. }
            | Self::Size { .. }
            | Self::Step { .. }
            | Self::Data { .. }
            | Self::OddWidth { .. }
            | Self::Raw { .. }
            | Self::Output { .. }
            | Self::NotAnImage { .. }
            | Self::Bomb { .. }
            | Self::WorkingMemory { .. }
            | Self::OtherImage { .. }
            | Self::CutOff { .. }
            | Self::Unsupported { .. }
            | Self::Damaged { .. }
            | Self::Jpeg { .. }
            | Self::Png { .. } => ImageErrorKind::Unreadable,
        }
    }
}

/// `name` for a message: a hostile one must not fill the log.
pub(super) fn shortened(name: &str) -> String {
    const LONGEST: usize = 40;
    match name.char_indices().nth(LONGEST) {
        None => name.to_owned(),
        Some((end, _)) => format!("{}…", &name[..end]),
    }
}

/// A number of bytes for people: exact below 1 MiB, then in tenths of a MiB. What is needed rounds up
/// and what is allowed rounds down, so that a message never says "8 MiB, and 8 MiB is allowed".
struct Rounded {
    bytes: u64,
    tenths: u64,
}

const MIB: u64 = 1 << 20;

impl Rounded {
    fn up(bytes: u64) -> Self {
        let tenths = (bytes / MIB * 10).saturating_add((bytes % MIB * 10).div_ceil(MIB));
        Self { bytes, tenths }
    }

    fn down(bytes: usize) -> Self {
        let bytes = bytes as u64;
        let tenths = (bytes / MIB * 10).saturating_add(bytes % MIB * 10 / MIB);
        Self { bytes, tenths }
    }
}

impl fmt::Display for Rounded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.bytes, self.tenths) {
            (bytes, _) if bytes < MIB => write!(f, "{bytes} bytes"),
            (_, tenths) if tenths % 10 == 0 => write!(f, "{} MiB", tenths / 10),
            (_, tenths) => write!(f, "{}.{} MiB", tenths / 10, tenths % 10),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_rounded_against_the_one_who_asks() {
        assert_eq!(Rounded::down(8 << 20).to_string(), "8 MiB");
        assert_eq!(Rounded::up((8 << 20) + 1).to_string(), "8.1 MiB");
        assert_eq!(Rounded::down((8 << 20) - 1).to_string(), "7.9 MiB");
        assert_eq!(Rounded::up(12_870_750_000).to_string(), "12274.6 MiB");
        assert_eq!(Rounded::up(768).to_string(), "768 bytes");
        assert_eq!(Rounded::up(u64::MAX).to_string(), "17592186044416 MiB");
    }
}
