//! An image in memory, with a validated size.

use super::{Encoding, PixelError, StopCheck};

/// Largest width and height of an image, in pixels.
pub const MAX_SIDE: u32 = 65_535;

/// An image with a validated size, step and length.
///
/// Only [`View::new`] creates one, so code that uses a view does not have to check again.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    width: u32,
    height: u32,
    step: usize,
    encoding: Encoding,
    big_endian: bool,
    data: &'a [u8],
    stop_check: Option<&'a StopCheck<'a>>,
}

impl<'a> View<'a> {
    /// Creates a view of the image of `width` x `height` pixels in `data`, where a row starts every
    /// `step` bytes, as in `sensor_msgs/msg/Image`. `big_endian` is the order of 16 bit values, and
    /// ignored for other encodings. Bytes after each row and after the image are ignored; padding
    /// after the last row may be missing.
    ///
    /// # Errors
    ///
    /// [`PixelError::Size`], [`PixelError::Step`], [`PixelError::Data`] or
    /// [`PixelError::OddWidth`], with the conflicting numbers.
    pub fn new(
        width: u32,
        height: u32,
        step: u32,
        encoding: Encoding,
        big_endian: bool,
        data: &'a [u8],
    ) -> Result<Self, PixelError> {
        check_size(width, height)?;
        if encoding.is_paired() && !width.is_multiple_of(2) {
            return Err(PixelError::OddWidth { width, encoding });
        }
        // At most 65,535 * 4: fits even where a `usize` has 32 bits.
        let row = width as usize * encoding.bytes_per_pixel();
        if (step as usize) < row {
            let needed = row;
            return Err(PixelError::Step { width, height, encoding, step, needed });
        }
        let needed = (step as usize)
            .checked_mul(height as usize - 1)
            .and_then(|before_last| before_last.checked_add(row))
            .unwrap_or(usize::MAX);
        if data.len() < needed {
            let found = data.len();
            return Err(PixelError::Data { width, height, encoding, step, needed, found });
        }
        let data = &data[..needed];
        Ok(Self {
            width,
            height,
            step: step as usize,
            encoding,
            big_endian,
            data,
            stop_check: None,
        })
    }

    #[must_use]
    pub fn with_stop_check(self, stop_check: &'a StopCheck<'a>) -> Self {
        Self { stop_check: Some(stop_check), ..self }
    }

    /// Checks whether an operation may process `bytes` further bytes.
    pub(super) fn check_stop(&self, bytes: usize) -> Result<(), PixelError> {
        self.stop_check.map_or(Ok(()), |stop_check| stop_check.check(bytes))
    }

    /// Returns the pixels per row, 1 to [`MAX_SIDE`].
    pub const fn width(&self) -> u32 {
        self.width
    }

    /// Returns the number of rows, 1 to [`MAX_SIDE`].
    pub const fn height(&self) -> u32 {
        self.height
    }

    /// Returns the bytes from the start of a row to the start of the next.
    pub const fn step(&self) -> usize {
        self.step
    }

    /// Returns all rows; the last one without padding.
    pub const fn bytes(&self) -> &'a [u8] {
        self.data
    }

    pub const fn encoding(&self) -> Encoding {
        self.encoding
    }

    /// Returns whether 16 bit values have their high byte first.
    pub const fn big_endian(&self) -> bool {
        self.big_endian
    }

    /// Returns the pixels of row `y`, without the padding; empty if there is no such row.
    pub fn row(&self, y: u32) -> &'a [u8] {
        let start = (y as usize).saturating_mul(self.step);
        let pixels = self.width as usize * self.encoding.bytes_per_pixel();
        self.data.get(start..).and_then(|rest| rest.get(..pixels)).unwrap_or(&[])
    }

    /// Returns the part of `roi` inside the image; the whole image without a region.
    ///
    /// # Errors
    ///
    /// [`PixelError::Roi`] if no pixel of the image is in the region.
    pub fn clip(&self, roi: Option<Roi>) -> Result<Roi, PixelError> {
        let (width, height) = (self.width, self.height);
        let Some(roi) = roi else {
            return Ok(Roi { x: 0, y: 0, width, height });
        };
        if roi.x >= width || roi.y >= height || roi.width == 0 || roi.height == 0 {
            return Err(PixelError::Roi { roi, width, height });
        }
        Ok(Roi {
            width: roi.width.min(width - roi.x),
            height: roi.height.min(height - roi.y),
            ..roi
        })
    }

    /// Returns the bytes of `roi`, a result of [`View::clip`], row by row from the top.
    pub(super) fn rows_of(&self, roi: Roi) -> impl Iterator<Item = &'a [u8]> + use<'a> {
        let view = *self;
        let pixel = view.encoding.bytes_per_pixel();
        let bytes = roi.x as usize * pixel..(roi.x + roi.width) as usize * pixel;
        (roi.y..roi.y + roi.height).map(move |y| view.row(y).get(bytes.clone()).unwrap_or(&[]))
    }
}

/// Refuses an image without pixels, or with too many.
pub fn check_size(width: u32, height: u32) -> Result<(), PixelError> {
    let fits = |side| (1..=MAX_SIDE).contains(&side);
    if fits(width) && fits(height) { Ok(()) } else { Err(PixelError::Size { width, height }) }
}

/// A rectangle of pixels; its corner (`x`, `y`) counts from the top left of the image.
///
/// Of a region that is partly outside the image, the part inside counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Roi {
    /// Pixels left of the region.
    pub x: u32,
    /// Rows above the region.
    pub y: u32,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(width: u32, height: u32, step: u32, encoding: Encoding, bytes: usize) -> String {
        View::new(width, height, step, encoding, false, &vec![0; bytes]).unwrap_err().to_string()
    }

    #[test]
    fn rows_have_no_padding() {
        let data = [1, 2, 3, 9, 4, 5, 6];
        let view = View::new(3, 2, 4, Encoding::Mono8, false, &data).unwrap();
        assert_eq!(view.row(0), [1, 2, 3]);
        assert_eq!(view.row(1), [4, 5, 6]);
        assert!(view.row(2).is_empty());
        assert!(view.row(u32::MAX).is_empty());
    }

    #[test]
    fn an_image_without_pixels_is_refused() {
        assert_eq!(
            refusal(0, 480, 0, Encoding::Rgb8, 9),
            "image size is 0x480; each side must be 1 to 65535"
        );
        assert!(View::new(3, 0, 9, Encoding::Rgb8, false, &[0; 9]).is_err());
    }

    #[test]
    fn an_excessive_size_is_refused() {
        assert_eq!(
            refusal(65_536, 1, 65_536, Encoding::Mono8, 65_536),
            "image size is 65536x1; each side must be 1 to 65535"
        );
        assert!(View::new(1, u32::MAX, 1, Encoding::Mono8, false, &[0; 9]).is_err());
    }

    #[test]
    fn rows_that_overlap_are_refused() {
        assert_eq!(
            refusal(2, 2, 5, Encoding::Rgb8, 100),
            "image of 2x2 rgb8 has a step of 5 bytes; a row needs 6"
        );
    }

    #[test]
    fn missing_bytes_are_refused_except_after_the_last_row() {
        assert_eq!(
            refusal(2, 2, 8, Encoding::Rgb8, 13),
            "image of 2x2 rgb8 with 8 bytes per row needs 14 bytes; it has 13"
        );
        assert!(View::new(2, 2, 8, Encoding::Rgb8, false, &[0; 14]).is_ok());
    }

    #[test]
    fn the_largest_step_does_not_overflow() {
        let message = refusal(65_535, 65_535, u32::MAX, Encoding::Rgba8, 10);
        assert!(message.contains("it has 10"), "{message}");
    }

    #[test]
    fn half_a_pair_of_yuv422_is_refused() {
        assert_eq!(
            refusal(3, 1, 6, Encoding::Yuv422Uyvy, 6),
            "image of uyvy is 3 pixels wide; two pixels share a colour, so the width must be even"
        );
    }

    #[test]
    fn a_region_is_cut_at_the_edges_of_the_image() {
        let view = View::new(4, 3, 4, Encoding::Mono8, false, &[0; 12]).unwrap();
        let roi = Roi { x: 3, y: 1, width: u32::MAX, height: u32::MAX };
        assert_eq!(view.clip(Some(roi)).unwrap(), Roi { x: 3, y: 1, width: 1, height: 2 });
        assert_eq!(view.clip(None).unwrap(), Roi { x: 0, y: 0, width: 4, height: 3 });
    }

    #[test]
    fn a_region_without_a_pixel_is_refused() {
        let view = View::new(4, 3, 4, Encoding::Mono8, false, &[0; 12]).unwrap();
        for (x, y, width, height) in [(4, 0, 1, 1), (0, 3, 1, 1), (0, 0, 0, 1), (0, 0, 1, 0)] {
            let roi = Roi { x, y, width, height };
            assert_eq!(
                view.clip(Some(roi)).unwrap_err().to_string(),
                format!("region {width}x{height} at ({x}, {y}) has no pixel in the image of 4x3")
            );
        }
    }
}
