//! Computes with pixels and signals inside of a lambda.
//!
//! Each kernel is a plain function over slices that native tests can call. The compiler vectorises
//! the same source to 128-bit instructions, in a component (`gleaner build` compiles with
//! `simd128`) and natively. One iteration of a loop handles 64 bytes or more: fuel and deadline are
//! checked once per iteration, so that the check costs little.
//!
//! Kernels on pixels compute with integers. Their results equal those of the operation of the same
//! name on a [`Frame`](crate::Frame), bit for bit. Prefer the operation on the frame: the host
//! reads the pixels in place, while a kernel needs a copy of them in the lambda. Use kernels for
//! pixels that the lambda has copied anyway, or has changed. `docs/kernels.md` compares the costs.
//!
//! Kernels never call the host, and allocate memory only where documented. Kernels on pixels read
//! rgb8, bgr8 and mono8 only.
// Its code is compiled and run with the examples of this crate.
#![cfg_attr(all(doctest, feature = "fft"), doc = include_str!("../../../docs/kernels.md"))]

pub mod downscale;
#[cfg(feature = "fft")]
pub mod fft;
pub mod histogram;
pub mod luma;
pub mod mean;

use std::fmt;

pub use crate::data::{Encoding, Roi};
use crate::data::{FrameInfo, bytes_per_pixel, encoding_name};

/// Maximum width and height of an image, in pixels; the same as in the host.
pub const MAX_SIDE: u32 = 65_535;

/// An image in the memory of the lambda, with a validated size.
///
/// ```
/// use gleaner_sdk::kernels::{Encoding, Image, luma};
///
/// // Two pixels, red and white, and two bytes of padding.
/// let image = Image::new(2, 1, 8, Encoding::Rgb8, &[255, 0, 0, 255, 255, 255, 0, 0]).unwrap();
/// assert_eq!(luma::mean_luma(&image), (76.245 + 255.0) / 2.0);
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Image<'a> {
    width: usize,
    height: usize,
    step: usize,
    colours: Colours,
    data: &'a [u8],
}

/// Channels of a pixel, in the order of its bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Colours {
    Grey,
    Rgb,
    Bgr,
}

impl<'a> Image<'a> {
    /// Creates an image of `width` x `height` pixels over `data`; a row starts every `step` bytes.
    /// Padding after a row and bytes after the image are ignored; the last row needs no padding.
    ///
    /// # Errors
    ///
    /// [`ImageError::Encoding`] unless the pixels are rgb8, bgr8 or mono8; [`ImageError::Size`] if
    /// a side is 0 or above [`MAX_SIDE`]; [`ImageError::Step`] if `step` is too small for a row;
    /// [`ImageError::Data`] if `data` is too short.
    pub fn new(
        width: u32,
        height: u32,
        step: u32,
        encoding: Encoding,
        data: &'a [u8],
    ) -> Result<Self, ImageError> {
        let colours = match encoding {
            Encoding::Mono8 => Colours::Grey,
            Encoding::Rgb8 => Colours::Rgb,
            Encoding::Bgr8 => Colours::Bgr,
            _ => return Err(ImageError::Encoding { name: encoding_name(encoding) }),
        };
        if !(1..=MAX_SIDE).contains(&width) || !(1..=MAX_SIDE).contains(&height) {
            return Err(ImageError::Size { width, height });
        }
        let row = width * bytes_per_pixel(encoding);
        if step < row {
            return Err(ImageError::Step { step, needed: row });
        }
        // Below 2^48, which may be more than a lambda's `usize`.
        let needed = u64::from(step) * u64::from(height - 1) + u64::from(row);
        let data = usize::try_from(needed).ok().and_then(|needed| data.get(..needed));
        let (width, height, step) = (width as usize, height as usize, step as usize);
        let data = data.ok_or(ImageError::Data { needed })?;
        Ok(Self { width, height, step, colours, data })
    }

    /// Creates an image over the pixels of a frame that [`Frame::copy_to`](crate::Frame::copy_to)
    /// copied to `data`.
    ///
    /// # Errors
    ///
    /// As [`Image::new`].
    pub fn of(info: &FrameInfo, data: &'a [u8]) -> Result<Self, ImageError> {
        Self::new(info.width, info.height, info.step, info.encoding, data)
    }

    /// Returns the part of the image in `roi`, which is clipped to the image, as in the host.
    ///
    /// # Errors
    ///
    /// [`ImageError::Roi`] if no pixel of the image is in `roi`.
    pub fn part(&self, roi: Roi) -> Result<Self, ImageError> {
        let [x, y, width, height] = [roi.x, roi.y, roi.width, roi.height].map(|side| side as usize);
        if x >= self.width || y >= self.height || width == 0 || height == 0 {
            return Err(ImageError::Roi {
                roi,
                width: self.width as u32,
                height: self.height as u32,
            });
        }
        let data = &self.data[y * self.step + x * self.pixel()..];
        Ok(Self {
            width: width.min(self.width - x),
            height: height.min(self.height - y),
            data,
            ..*self
        })
    }

    /// Returns the width in pixels, 1 to [`MAX_SIDE`].
    pub fn width(&self) -> u32 {
        self.width as u32
    }

    /// Returns the height in pixels, 1 to [`MAX_SIDE`].
    pub fn height(&self) -> u32 {
        self.height as u32
    }

    /// Returns the bytes per pixel: 1 or 3.
    fn pixel(&self) -> usize {
        if self.colours == Colours::Grey { 1 } else { 3 }
    }

    /// Returns the rows from top to bottom, without padding.
    fn rows(&self) -> impl Iterator<Item = &'a [u8]> + use<'a> {
        self.rows_from(0)
    }

    /// Returns the rows from row `first` to the last, without padding.
    fn rows_from(&self, first: usize) -> impl Iterator<Item = &'a [u8]> + use<'a> {
        let row = self.width * self.pixel();
        self.data.chunks(self.step).take(self.height).skip(first).map(move |whole| &whole[..row])
    }
}

/// Reason why bytes are not an image, or an image cannot be converted.
#[derive(Clone, Copy, Debug)]
#[allow(missing_docs)]
pub enum ImageError {
    Encoding { name: &'static str },
    Size { width: u32, height: u32 },
    Step { step: u32, needed: u32 },
    Data { needed: u64 },
    Roi { roi: Roi, width: u32, height: u32 },
    Output { needed: usize, found: usize },
    ResizeTo { from: (u32, u32), to: (u32, u32) },
}

impl fmt::Display for ImageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Encoding { name } => write!(
                f,
                "kernels read rgb8, bgr8 and mono8, not {name}; use the operations of a frame, or \
                 its `to_gray` or `resize` for a frame that kernels can read"
            ),
            Self::Size { width, height } => {
                write!(f, "an image of {width}x{height} pixels; each side must be 1 to {MAX_SIDE}")
            }
            Self::Step { step, needed } => {
                write!(f, "a row takes {needed} bytes, but one starts every {step}")
            }
            Self::Data { needed } => {
                write!(f, "the image takes {needed} bytes; the data has fewer")
            }
            Self::Roi { roi, width, height } => {
                let Roi { x, y, width: across, height: down } = roi;
                write!(
                    f,
                    "no pixel of the image of {width}x{height} is in the region of \
                     {across}x{down} at ({x}, {y})"
                )
            }
            Self::Output { needed, found } => {
                write!(f, "the result takes {needed} bytes; the output has {found}")
            }
            Self::ResizeTo { from, to } => write!(
                f,
                "{}x{} pixels cannot become {}x{}: each side must be at least 1 pixel and not \
                 larger than before",
                from.0, from.1, to.0, to.1
            ),
        }
    }
}

impl std::error::Error for ImageError {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_that_do_not_fit_are_refused_with_their_numbers() {
        let refused = |width, height, step, encoding, bytes| {
            Image::new(width, height, step, encoding, &vec![0; bytes]).unwrap_err().to_string()
        };
        assert_eq!(
            refused(2, 2, 5, Encoding::Rgb8, 99),
            "a row takes 6 bytes, but one starts every 5"
        );
        assert_eq!(
            refused(2, 2, 8, Encoding::Bgr8, 13),
            "the image takes 14 bytes; the data has fewer"
        );
        assert!(refused(65_536, 1, 65_536, Encoding::Mono8, 65_536).contains("65536x1 pixels"));
        assert!(refused(0, 1, 0, Encoding::Mono8, 0).contains("0x1 pixels"));
        assert!(
            refused(65_535, 65_535, u32::MAX, Encoding::Mono8, 9)
                .starts_with("the image takes 281")
        );
        assert!(refused(2, 2, 4, Encoding::Yuv422, 99).contains("not yuv422"));
    }

    #[test]
    fn the_last_row_needs_no_padding_and_a_part_starts_anywhere() {
        let data = [1, 2, 3, 0, 4, 5, 6];
        let image = Image::new(3, 2, 4, Encoding::Mono8, &data).unwrap();
        assert_eq!(image.rows().collect::<Vec<_>>(), [[1, 2, 3], [4, 5, 6]]);
        let part = image.part(Roi { x: 1, y: 1, width: 9, height: 9 }).unwrap();
        assert_eq!(
            (part.width(), part.height(), part.rows().collect::<Vec<_>>()),
            (2, 1, vec![&[5, 6][..]])
        );
        let left = image.part(Roi { x: 0, y: 0, width: 1, height: 2 }).unwrap();
        assert_eq!(left.rows().collect::<Vec<_>>(), [[1], [4]]);
        let outside = image.part(Roi { x: 3, y: 0, width: 1, height: 1 }).unwrap_err();
        assert_eq!(
            outside.to_string(),
            "no pixel of the image of 3x2 is in the region of 1x1 at (3, 0)"
        );
    }
}
