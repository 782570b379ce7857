//! Decodes JPEG and PNG bytes to rgb8, or to mono16.
//!
//! [`probe`] finds the format and the size that the header claims, from the first bytes alone;
//! [`decode`] decodes into memory of the caller. `zune-jpeg` and `png` decode the pixels; this
//! module adds a cost that is known in advance.
//!
//! Nothing is allocated before the size is compared with the caller's limit, a truncated file never
//! passes as a whole image, and no pixels of an earlier image stay in the output.

mod error;
mod jpeg;
mod message;
mod paced;
mod png;
#[cfg(test)]
mod samples;
#[cfg(test)]
mod tests;

use std::fmt;

pub use error::ImageError;
pub use message::probe_message;

use gleaner_rules::pixels::{Encoding, PixelError, StopCheck};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// JPEG (ITU-T T.81), baseline or progressive.
    Jpeg,
    /// PNG (ISO/IEC 15948).
    Png,
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Jpeg => "JPEG",
            Self::Png => "PNG",
        })
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageHeader {
    pub format: Format,
    /// Pixels per row, 1 to [`MAX_SIDE`](crate::MAX_SIDE).
    pub width: u32,
    /// Rows, 1 to [`MAX_SIDE`](crate::MAX_SIDE).
    pub height: u32,
    /// Layout of the decoded pixels: rgb8, or mono16 for a grey PNG of 16 bits.
    pub encoding: Encoding,
}

impl ImageHeader {
    /// Returns the bytes of the image as rgb8; `None` if this machine cannot count them.
    pub fn rgb8_len(&self) -> Option<usize> {
        usize::try_from(self.width)
            .ok()?
            .checked_mul(usize::try_from(self.height).ok()?)?
            .checked_mul(3)
    }

    /// Returns the bytes of the decoded image, as [`rgb8_len`](Self::rgb8_len).
    pub fn decoded_len(&self) -> Option<usize> {
        self.rgb8_len().map(|len| len / 3 * self.encoding.bytes_per_pixel())
    }
}

impl fmt::Display for ImageHeader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {}x{}", self.format, self.width, self.height)
    }
}

/// Returns the header of `data`, by its magic bytes. Allocates and decodes nothing.
///
/// # Errors
///
/// [`ImageError::NotAnImage`] for other bytes, [`PixelError::Size`] for an image without pixels,
/// [`ImageError::Unsupported`] for a kind of JPEG or PNG that is not decoded, and
/// [`ImageError::Truncated`] or [`ImageError::Damaged`] if there is no readable header.
pub fn probe(data: &[u8]) -> Result<ImageHeader, ImageError> {
    match format_of(data)? {
        Format::Jpeg => jpeg::header(data),
        Format::Png => png::header(data),
    }
}

/// Decodes `data`, whose header [`probe`] returned, into `out`: rows from the top, without padding,
/// [`ImageHeader::decoded_len`] bytes of the header's encoding. Grey of 8 bits becomes equal red,
/// green and blue; alpha is dropped; values of 16 bits are little-endian. The caller may stop it by
/// `pace`, but not in the last step of a progressive JPEG, from coefficients to pixels.
///
/// `max_bytes` is the limit for an image of this input as rgb8, its `decoded_size`. It also bounds
/// the allocations of the decoder: 4 MiB plus four times `max_bytes`, copies of the file's own
/// metadata, and one of a JPEG without Huffman tables.
///
/// A JPEG has no checksum: changed bytes can decode to a wrong picture. So can a file whose camera
/// wrote the end too early: the rest is then made up. A PNG whose pixels were changed is refused.
/// After an error the content of `out` is undefined.
///
/// # Errors
///
/// [`ImageError::Bomb`] if the image is larger than `max_bytes`, before any memory is touched;
/// [`ImageError::WorkingMemory`] if the decoder would need too much; [`PixelError::Output`] if
/// `out` has another length; [`ImageError::OtherImage`] if `header` is not that of `data`;
/// [`ImageError::Truncated`], [`ImageError::Damaged`], [`ImageError::Unsupported`],
/// [`ImageError::Jpeg`] or [`ImageError::Png`] if the file is broken or unsupported;
/// [`PixelError::Stopped`].
pub fn decode(
    data: &[u8],
    header: &ImageHeader,
    max_bytes: usize,
    out: &mut [u8],
    pace: &StopCheck<'_>,
) -> Result<(), ImageError> {
    let found = probe(data)?;
    if found != *header {
        return Err(ImageError::OtherImage { expected: *header, found });
    }
    let ImageHeader { format, width, height, .. } = found;
    let needed = match (found.rgb8_len(), found.decoded_len()) {
        (Some(limited), Some(needed)) if limited <= max_bytes => needed,
        _ => {
            let needed = 3 * u64::from(width) * u64::from(height);
            return Err(ImageError::Bomb { width, height, needed, allowed: max_bytes });
        }
    };
    if out.len() != needed {
        return Err(PixelError::Output { operation: "decoding", needed, found: out.len() }.into());
    }
    let allowed = max_bytes.saturating_mul(4).saturating_add(4 << 20);
    // Pixels that a broken file does not write are black, not earlier content.
    out.fill(0);
    match format {
        Format::Jpeg => jpeg::decode(data, &found, allowed, out, pace),
        Format::Png => png::decode(data, &found, allowed, out, pace),
    }
}

/// As [`decode`], for callers that need 8 bits per value and do not stop it.
///
/// # Errors
///
/// As [`decode`], and [`ImageError::Unsupported`] for an image of 16 bits.
pub fn decode_rgb8(
    data: &[u8],
    header: &ImageHeader,
    max_bytes: usize,
    out: &mut [u8],
) -> Result<(), ImageError> {
    if header.encoding != Encoding::Rgb8 {
        let what = "of 16 bits per value where 8 are needed";
        return Err(ImageError::Unsupported { format: header.format, what });
    }
    decode(data, header, max_bytes, out, &StopCheck::new(&|| true))
}

fn format_of(data: &[u8]) -> Result<Format, ImageError> {
    if data.starts_with(&jpeg::MAGIC) {
        Ok(Format::Jpeg)
    } else if data.starts_with(&png::MAGIC) {
        Ok(Format::Png)
    } else {
        let start = data.iter().take(8).copied().collect();
        Err(ImageError::NotAnImage { len: data.len(), start })
    }
}
