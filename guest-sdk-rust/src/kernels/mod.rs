//! Arithmetic on pixels and signals inside of a lambda.
//!
//! Each kernel is a plain function over slices, tested natively as any Rust code. The same source
//! becomes vector instructions of 128 bits in a component, which `gleaner build` compiles with
//! `simd128`, and on the machine it is tested on. Loops handle 64 bytes and more at a time: fuel
//! and deadline are checked once for each turn, so that this costs little.
//!
//! Kernels on pixels compute in integers and give, bit for bit, what the operation of the same name
//! on a [`Frame`](crate::Frame) gives. Ask the frame first: the host reads its pixels where they
//! are, while a kernel needs them copied into the lambda. Kernels are for pixels that the lambda
//! has anyway, or has changed. `docs/kernels.md` says what each way costs.
//!
//! Never: a call to the host; memory taken in a loop, except where a function says so; pixels other
//! than rgb8, bgr8 and mono8.

pub mod downscale;
#[cfg(feature = "fft")]
pub mod fft;
pub mod histogram;
pub mod luma;
pub mod mean;

use std::fmt;

use crate::data::{Encoding, FrameInfo, Roi, bytes_per_pixel, encoding_name};

/// Largest width and height of an image, in pixels; as the host's.
pub const MAX_SIDE: u32 = 65_535;

/// Pixels that lie in the lambda's memory, once their size has been checked.
///
/// ```
/// use gleaner_sdk::data::Encoding;
/// use gleaner_sdk::kernels::{Image, luma};
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

/// What the bytes of a pixel are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Colours {
    Grey,
    Rgb,
    Bgr,
}

impl<'a> Image<'a> {
    /// The image of `width` x `height` pixels in `data`, where a row starts every `step` bytes.
    /// Bytes behind a row and behind the image are ignored; those behind the last row may be
    /// missing.
    ///
    /// # Errors
    ///
    /// [`ImageError::Encoding`] unless the pixels are rgb8, bgr8 or mono8; [`ImageError::Size`] if
    /// a side is 0 or above [`MAX_SIDE`]; [`ImageError::Step`] and [`ImageError::Data`] if rows or
    /// image do not fit.
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

    /// The pixels of a frame in `data`, as [`Frame::copy_to`](crate::Frame::copy_to) has put them
    /// there.
    ///
    /// # Errors
    ///
    /// As [`Image::new`].
    pub fn of(info: &FrameInfo, data: &'a [u8]) -> Result<Self, ImageError> {
        Self::new(info.width, info.height, info.step, info.encoding, data)
    }

    /// The part of the image in `roi`, clipped to it as the host does.
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

    /// Pixels in a row, 1 to [`MAX_SIDE`].
    pub fn width(&self) -> u32 {
        self.width as u32
    }

    /// Rows, 1 to [`MAX_SIDE`].
    pub fn height(&self) -> u32 {
        self.height as u32
    }

    /// Bytes of a pixel: 1 or 3.
    fn pixel(&self) -> usize {
        if self.colours == Colours::Grey { 1 } else { 3 }
    }

    /// The rows from top to bottom, without padding.
    fn rows(&self) -> impl Iterator<Item = &'a [u8]> + use<'a> {
        self.rows_from(0)
    }

    /// The rows from row `first` on, without padding.
    fn rows_from(&self, first: usize) -> impl Iterator<Item = &'a [u8]> + use<'a> {
        let row = self.width * self.pixel();
        self.data.chunks(self.step).take(self.height).skip(first).map(move |whole| &whole[..row])
    }
}

/// Why bytes are no image, or an image cannot become another.
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
                "kernels read rgb8, bgr8 and mono8, not {name}; the operations of a frame read it, and its `to_gray` and `resize` \
                 make one that kernels read"
            ),
            Self::Size { width, height } => {
                write!(f, "an image of {width}x{height} pixels; each side has 1 to {MAX_SIDE}")
            }
            Self::Step { step, needed } => {
                write!(f, "a row takes {needed} bytes, but one starts every {step}")
            }
            Self::Data { needed } => write!(f, "the image takes {needed} bytes, there are fewer"),
            Self::Roi { roi, width, height } => {
                let Roi { x, y, width: across, height: down } = roi;
                write!(
                    f,
                    "no pixel of the image of {width}x{height} is in the region of {across}x{down} at ({x}, {y})"
                )
            }
            Self::Output { needed, found } => {
                write!(f, "the result takes {needed} bytes; the place for it has {found}")
            }
            Self::ResizeTo { from, to } => write!(
                f,
                "{}x{} pixels cannot become {}x{}: each side has 1 pixel at least and no more than before",
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
    fn what_does_not_fit_is_refused_with_its_numbers() {
        let refused = |width, height, step, encoding, bytes| {
            Image::new(width, height, step, encoding, &vec![0; bytes]).unwrap_err().to_string()
        };
        assert_eq!(
            refused(2, 2, 5, Encoding::Rgb8, 99),
            "a row takes 6 bytes, but one starts every 5"
        );
        assert_eq!(
            refused(2, 2, 8, Encoding::Bgr8, 13),
            "the image takes 14 bytes, there are fewer"
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
    fn a_last_row_needs_no_padding_and_a_part_begins_anywhere() {
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
