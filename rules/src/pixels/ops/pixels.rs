//! Converts pixels of each encoding to grey or to red, green and blue.

use crate::pixels::{Encoding, PixelError, View};

/// The format of pixels that are not raw: every encoding with a grey level.
#[derive(Debug, Clone, Copy)]
pub(super) enum PixelFormat {
    Grey8,
    /// `high` is the offset of the high byte in a pixel, 0 or 1.
    Grey16 {
        high: usize,
    },
    Rgb,
    Bgr,
    Rgba,
    Bgra,
    Uyvy,
    Yuyv,
}

impl PixelFormat {
    /// Returns the format of `view`, or the reason why `operation` does not support it.
    pub(super) fn of(view: &View<'_>, operation: &'static str) -> Result<Self, PixelError> {
        Ok(match view.encoding() {
            Encoding::Mono8 => Self::Grey8,
            Encoding::Mono16 => Self::Grey16 { high: usize::from(!view.big_endian()) },
            Encoding::Rgb8 => Self::Rgb,
            Encoding::Bgr8 => Self::Bgr,
            Encoding::Rgba8 => Self::Rgba,
            Encoding::Bgra8 => Self::Bgra,
            Encoding::Yuv422Uyvy => Self::Uyvy,
            Encoding::Yuv422Yuyv => Self::Yuyv,
            encoding @ (Encoding::Bayer8(_) | Encoding::Bayer16(_)) => {
                return Err(PixelError::Raw { operation, encoding });
            }
        })
    }

    /// Writes the grey level of each pixel in `row` to `grey`, which has a byte per pixel.
    pub(super) fn grey(self, row: &[u8], grey: &mut [u8]) {
        match self {
            Self::Grey8 => {
                for (grey, level) in grey.iter_mut().zip(row) {
                    *grey = *level;
                }
            }
            Self::Grey16 { high: 0 } | Self::Yuyv => pick::<0>(row, grey),
            Self::Grey16 { .. } | Self::Uyvy => pick::<1>(row, grey),
            Self::Rgb => luma::<3, 0, 2>(row, grey),
            Self::Bgr => luma::<3, 2, 0>(row, grey),
            Self::Rgba => luma::<4, 0, 2>(row, grey),
            Self::Bgra => luma::<4, 2, 0>(row, grey),
        }
    }

    /// Returns `CHANNELS` values of each pixel in `row`, a whole row: grey, or red, green and blue.
    /// They are in `row` itself or, if they have to be rearranged, in `buffer`, which must be long
    /// enough.
    pub(super) fn row<'a, const CHANNELS: usize>(
        self,
        row: &'a [u8],
        buffer: &'a mut [u8],
    ) -> &'a [u8] {
        match (self, CHANNELS) {
            (Self::Grey8, 1) | (Self::Rgb, 3) => return row,
            (_, 1) => self.grey(row, buffer),
            _ => self.rgb(row, buffer),
        }
        buffer
    }

    /// Writes red, green and blue of each pixel in `row`, a whole row, to `rgb`, which has three
    /// bytes per pixel.
    fn rgb(self, row: &[u8], rgb: &mut [u8]) {
        match self {
            Self::Grey8 => spread::<1, 0, 0, 0>(row, rgb),
            Self::Grey16 { high: 0 } => spread::<2, 0, 0, 0>(row, rgb),
            Self::Grey16 { .. } => spread::<2, 1, 1, 1>(row, rgb),
            Self::Rgb => spread::<3, 0, 1, 2>(row, rgb),
            Self::Bgr => spread::<3, 2, 1, 0>(row, rgb),
            Self::Rgba => spread::<4, 0, 1, 2>(row, rgb),
            Self::Bgra => spread::<4, 2, 1, 0>(row, rgb),
            Self::Uyvy => pairs::<0, 1, 2, 3>(row, rgb),
            Self::Yuyv => pairs::<1, 0, 3, 2>(row, rgb),
        }
    }
}

/// Returns the luma of a colour, rounded down. Source: ITU-R BT.601, weights in thousandths.
fn luma_of(red: u8, green: u8, blue: u8) -> u8 {
    ((299 * u32::from(red) + 587 * u32::from(green) + 114 * u32::from(blue)) / 1000) as u8
}

/// Writes byte `AT` of each pixel of two bytes.
fn pick<const AT: usize>(row: &[u8], grey: &mut [u8]) {
    for (grey, pixel) in grey.iter_mut().zip(row.as_chunks::<2>().0) {
        *grey = pixel[AT];
    }
}

/// Writes the luma of each pixel of `BYTES` bytes, with green between red and blue.
fn luma<const BYTES: usize, const RED: usize, const BLUE: usize>(row: &[u8], grey: &mut [u8]) {
    for (grey, pixel) in grey.iter_mut().zip(row.as_chunks::<BYTES>().0) {
        *grey = luma_of(pixel[RED], pixel[1], pixel[BLUE]);
    }
}

/// Writes three bytes of each pixel of `BYTES` bytes.
fn spread<const BYTES: usize, const RED: usize, const GREEN: usize, const BLUE: usize>(
    row: &[u8],
    rgb: &mut [u8],
) {
    for (rgb, pixel) in rgb.as_chunks_mut::<3>().0.iter_mut().zip(row.as_chunks::<BYTES>().0) {
        *rgb = [pixel[RED], pixel[GREEN], pixel[BLUE]];
    }
}

/// Writes the two colours of each pair, whose U, left Y, V and right Y are at the given offsets.
fn pairs<const U: usize, const LEFT: usize, const V: usize, const RIGHT: usize>(
    row: &[u8],
    rgb: &mut [u8],
) {
    for (rgb, pair) in rgb.as_chunks_mut::<6>().0.iter_mut().zip(row.as_chunks::<4>().0) {
        let [r0, g0, b0] = from_yuv(pair[LEFT], pair[U], pair[V]);
        let [r1, g1, b1] = from_yuv(pair[RIGHT], pair[U], pair[V]);
        *rgb = [r0, g0, b0, r1, g1, b1];
    }
}

/// Converts luma and chroma of full range to a colour (Y, U and V from 0 to 255, as in JPEG).
///
/// Source: the inverse of ITU-R BT.601 as in JFIF 1.02, with factors in 1/65536, rounded to
/// nearest.
fn from_yuv(y: u8, u: u8, v: u8) -> [u8; 3] {
    let y = (i32::from(y) << 16) + (1 << 15);
    let (u, v) = (i32::from(u) - 128, i32::from(v) - 128);
    let byte = |value: i32| (value >> 16).clamp(0, 255) as u8;
    [byte(y + 91_881 * v), byte(y - 22_554 * u - 46_802 * v), byte(y + 116_130 * u)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn luma_is_rounded_down() {
        assert_eq!(luma_of(255, 255, 255), 255);
        assert_eq!(luma_of(255, 0, 0), 76); // 76.245
        assert_eq!(luma_of(0, 255, 0), 149); // 149.685
        assert_eq!(luma_of(0, 0, 255), 29); // 29.07
        assert_eq!(luma_of(1, 1, 0), 0); // 0.886
    }

    #[test]
    fn yuv_becomes_the_nearest_colour_of_the_exact_formula() {
        for y in (0..=255).step_by(5) {
            for u in (0..=255).step_by(5) {
                for v in (0..=255).step_by(5) {
                    let (yf, uf, vf) = (f64::from(y), f64::from(u) - 128.0, f64::from(v) - 128.0);
                    let real =
                        [yf + 1.402 * vf, yf - 0.344_136 * uf - 0.714_136 * vf, yf + 1.772 * uf];
                    for (result, real) in from_yuv(y as u8, u as u8, v as u8).iter().zip(real) {
                        let off = (f64::from(*result) - real.clamp(0.0, 255.0)).abs();
                        assert!(off < 0.502, "({y}, {u}, {v}) is off by {off}");
                    }
                }
            }
        }
    }
}
