//! Decodes JPEG and PNG bytes to rgb8.
//!
//! [`probe`] finds the format and the size that the header claims, from the first bytes alone;
//! [`decode_rgb8`] decodes into memory of the caller. `zune-jpeg` and `png` decode the pixels; this
//! module adds a cost that is known in advance.
//!
//! Nothing is allocated before the size is compared with the caller's limit, a truncated file never
//! passes as a whole image, and no pixels of an earlier image stay in the output.

mod jpeg;
mod paced;
mod png;
#[cfg(test)]
mod samples;
#[cfg(test)]
mod tests;

use std::fmt;

use super::{ImageError, PixelError, StopCheck};

/// Format of an image file.
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

/// Content of the header of an image file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageHeader {
    /// Format of the file.
    pub format: Format,
    /// Pixels per row, 1 to [`MAX_SIDE`](super::MAX_SIDE).
    pub width: u32,
    /// Rows, 1 to [`MAX_SIDE`](super::MAX_SIDE).
    pub height: u32,
}

impl ImageHeader {
    /// Returns the bytes of the image as rgb8; `None` if this machine cannot count them.
    pub fn rgb8_len(&self) -> Option<usize> {
        usize::try_from(self.width)
            .ok()?
            .checked_mul(usize::try_from(self.height).ok()?)?
            .checked_mul(3)
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
/// [`ImageError::Unsupported`] for a kind of JPEG that cameras do not send, and
/// [`ImageError::Truncated`] or [`ImageError::Damaged`] if there is no readable header.
pub fn probe(data: &[u8]) -> Result<ImageHeader, ImageError> {
    match format_of(data)? {
        Format::Jpeg => jpeg::header(data),
        Format::Png => png::header(data),
    }
}

/// Decodes `data`, whose header [`probe`] returned, into `out`: rows from the top, without padding,
/// [`ImageHeader::rgb8_len`] bytes. Grey becomes equal red, green and blue; alpha is dropped; 16
/// bit values keep their high byte.
///
/// `max_bytes` is the limit for an image of this input as rgb8, its `decoded_size`. It also bounds
/// the allocations of the decoder: 4 MiB plus four times `max_bytes`, and copies of the file's own
/// metadata.
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
/// [`ImageError::Jpeg`] or [`ImageError::Png`] if the file is broken or unsupported.
pub fn decode_rgb8(
    data: &[u8],
    header: &ImageHeader,
    max_bytes: usize,
    out: &mut [u8],
) -> Result<(), ImageError> {
    decode_rgb8_paced(data, header, max_bytes, out, &StopCheck::new(&|| true))
}

/// As [`decode_rgb8`], for a caller that may want to stop it. The last step of a progressive JPEG,
/// from coefficients to pixels, cannot be stopped.
///
/// # Errors
///
/// As [`decode_rgb8`], and [`PixelError::Stopped`].
pub fn decode_rgb8_paced(
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
    let ImageHeader { format, width, height } = found;
    let needed = match found.rgb8_len() {
        Some(needed) if needed <= max_bytes => needed,
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

/// Returns the format of `data` by its magic bytes.
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
