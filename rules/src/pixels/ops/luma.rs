//! Computes the brightness of an image: mean luma, histogram and grey image.

use super::pixels::PixelFormat;
use crate::pixels::{PixelError, Roi, View};

/// Number of byte positions that are summed in parallel. 48 bytes are whole pixels of 1, 2, 3 and 4
/// bytes and whole vector registers of 16 bytes, so that one loop serves every encoding and
/// vectorises.
const LANES: usize = 48;

/// Groups of [`LANES`] bytes after which 16 bit sums must be reset: 257 * 255 = 65,535.
const GROUPS: usize = 257;

/// Returns the mean luma of `roi`, or of the whole image, from 0 to 255.
///
/// Luma is (299 R + 587 G + 114 B) / 1000; the value itself for mono8; the value / 257 for mono16;
/// Y for yuv422, which is assumed to be of full range. Alpha is ignored. The sums are exact
/// and are divided once, so the result is the `f64` nearest to the true mean.
///
/// # Errors
///
/// [`PixelError::Roi`] if no pixel is in `roi`, [`PixelError::Raw`] for a Bayer image,
/// [`PixelError::Stopped`].
///
/// Source: luma weights of ITU-R BT.601.
pub fn mean_luma(view: &View<'_>, roi: Option<Roi>) -> Result<f64, PixelError> {
    let pixels = PixelFormat::of(view, "mean luma")?;
    let roi = view.clip(roi)?;
    let mut lanes = [0; LANES];
    for row in view.rows_of(roi) {
        view.check_stop(row.len())?;
        add_bytes(row, &mut lanes);
    }
    // Sums per byte of a pixel: lane `i` holds byte `i % bytes_per_pixel` of some pixels.
    let mut bytes = [0_u64; 4];
    for (lane, sum) in lanes.iter().enumerate() {
        bytes[lane % view.encoding().bytes_per_pixel()] += sum;
    }
    let colour =
        |red: usize, blue: usize| (299 * bytes[red] + 587 * bytes[1] + 114 * bytes[blue], 1000);
    // At most 65,535^2 pixels of 255 * 1000: below 2^51, so neither `u64` nor `f64` rounds.
    let (sum, scale) = match pixels {
        PixelFormat::Grey8 | PixelFormat::Yuyv => (bytes[0], 1),
        PixelFormat::Uyvy => (bytes[1], 1),
        PixelFormat::Grey16 { high } => (256 * bytes[high] + bytes[1 - high], 257),
        PixelFormat::Rgb | PixelFormat::Rgba => colour(0, 2),
        PixelFormat::Bgr | PixelFormat::Bgra => colour(2, 0),
    };
    let count = u64::from(roi.width) * u64::from(roi.height);
    Ok(sum as f64 / (scale * count) as f64)
}

/// Adds each byte of `row` to the lane of its position, modulo [`LANES`].
fn add_bytes(row: &[u8], lanes: &mut [u64; LANES]) {
    for block in row.chunks(LANES * GROUPS) {
        let (groups, rest) = block.as_chunks::<LANES>();
        let mut partial = [0_u16; LANES];
        for group in groups {
            for (sum, byte) in partial.iter_mut().zip(group) {
                // Cannot wrap, see `GROUPS`; a checked addition would not vectorise.
                *sum = sum.wrapping_add(u16::from(*byte));
            }
        }
        for (lane, sum) in lanes.iter_mut().zip(partial) {
            *lane += u64::from(sum);
        }
        for (lane, byte) in lanes.iter_mut().zip(rest) {
            *lane += u64::from(*byte);
        }
    }
}

/// Counts the pixels of each grey level, as of [`to_gray`], in `roi` or the whole image.
///
/// # Errors
///
/// [`PixelError::Roi`] if no pixel is in `roi`, [`PixelError::Raw`] for a Bayer image,
/// [`PixelError::Stopped`].
pub fn histogram(view: &View<'_>, roi: Option<Roi>) -> Result<[u32; 256], PixelError> {
    let pixels = PixelFormat::of(view, "histogram")?;
    let roi = view.clip(roi)?;
    // 65,535^2 pixels of one level fit a `u32`.
    let mut counts = [0; 256];
    let mut levels = [0; 512];
    for row in view.rows_of(roi) {
        view.check_stop(row.len())?;
        let pixel = view.encoding().bytes_per_pixel();
        for piece in row.chunks(levels.len() * pixel) {
            let levels = &mut levels[..piece.len() / pixel];
            pixels.grey(piece, levels);
            for level in levels {
                counts[usize::from(*level)] += 1;
            }
        }
    }
    Ok(counts)
}

/// Writes the image as mono8 to `out`, without padding: width * height bytes.
///
/// A grey level is (299 R + 587 G + 114 B) / 1000 rounded down, the value of mono8, the high byte
/// of mono16, or Y of yuv422.
///
/// # Errors
///
/// [`PixelError::Output`] if `out` has another length, [`PixelError::Raw`] for a Bayer image,
/// [`PixelError::Stopped`].
pub fn to_gray(view: &View<'_>, out: &mut [u8]) -> Result<(), PixelError> {
    let pixels = PixelFormat::of(view, "grey image")?;
    let width = view.width() as usize;
    // The view has at least one byte for each pixel, so their number is a `usize`.
    let needed = width * view.height() as usize;
    if out.len() != needed {
        return Err(PixelError::Output { operation: "grey image", needed, found: out.len() });
    }
    for (y, levels) in (0..view.height()).zip(out.chunks_exact_mut(width)) {
        let row = view.row(y);
        view.check_stop(row.len())?;
        pixels.grey(row, levels);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pixels::Encoding;
    use crate::pixels::ops::{noise, work};

    const WHOLE: Option<Roi> = None;

    /// Returns the luma of a pixel in floating point, by the definition of its encoding.
    fn reference(encoding: &str, big_endian: bool, p: &[u8]) -> f64 {
        let f = |at: usize| f64::from(p[at]);
        match encoding {
            "mono8" | "yuyv" => f(0),
            "uyvy" => f(1),
            "mono16" if big_endian => (f(0) * 256.0 + f(1)) * 255.0 / 65_535.0,
            "mono16" => (f(1) * 256.0 + f(0)) * 255.0 / 65_535.0,
            "rgb8" | "rgba8" => 0.299 * f(0) + 0.587 * f(1) + 0.114 * f(2),
            "bgr8" | "bgra8" => 0.114 * f(0) + 0.587 * f(1) + 0.299 * f(2),
            other => panic!("no reference for {other}"),
        }
    }

    const READABLE: [&str; 8] =
        ["mono8", "mono16", "rgb8", "bgr8", "rgba8", "bgra8", "uyvy", "yuyv"];

    #[test]
    fn the_mean_equals_the_mean_in_floating_point() {
        for name in READABLE {
            for big_endian in [false, true] {
                let encoding = Encoding::from_ros(name).unwrap();
                let pixel = encoding.bytes_per_pixel();
                // Wider than a block of 16 bit sums, with a remainder, and padded by 5 bytes.
                let (width, height) = (LANES * GROUPS / pixel + 38, 3);
                let step = width * pixel + 5;
                let data = noise(1, step * height);
                let (w, h, s) = (width as u32, height as u32, step as u32);
                let view = View::new(w, h, s, encoding, big_endian, &data).unwrap();
                let everything = Roi { x: 0, y: 0, width: w, height: h };
                let middle = Roi { x: 3, y: 1, width: w - 10, height: 1 };
                for roi in [everything, middle] {
                    let mut sum = 0.0;
                    for y in roi.y..roi.y + roi.height {
                        for x in roi.x..roi.x + roi.width {
                            let at = y as usize * step + x as usize * pixel;
                            sum += reference(name, big_endian, &data[at..at + pixel]);
                        }
                    }
                    let mean = sum / f64::from(roi.width * roi.height);
                    let result = mean_luma(&view, Some(roi)).unwrap();
                    assert!((result - mean).abs() < 1e-9, "{name}: {result} is not {mean}");
                }
            }
        }
    }

    #[test]
    fn white_is_255_in_every_encoding_and_size() {
        for name in READABLE {
            let encoding = Encoding::from_ros(name).unwrap();
            let step = 30_000 * encoding.bytes_per_pixel();
            let data = vec![255; step * 2];
            let view = View::new(30_000, 2, step as u32, encoding, false, &data).unwrap();
            assert_eq!(mean_luma(&view, WHOLE).unwrap(), 255.0, "{name}");
            assert_eq!(histogram(&view, WHOLE).unwrap()[255], 60_000, "{name}");
        }
    }

    #[test]
    fn four_pixels_by_hand() {
        let data = [255, 0, 0, 0, 255, 0, 99, 99, 0, 0, 255, 10, 20, 30];
        let view = View::new(2, 2, 8, Encoding::Rgb8, false, &data).unwrap();
        // 76.245, 149.685, 29.07 and 18.15: a sum of 273.15.
        assert_eq!(mean_luma(&view, WHOLE).unwrap(), 273.15 / 4.0);
        let mut grey = [0; 4];
        to_gray(&view, &mut grey).unwrap();
        assert_eq!(grey, [76, 149, 29, 18]);
        let right = Some(Roi { x: 1, y: 0, width: 1, height: 9 });
        assert_eq!(mean_luma(&view, right).unwrap(), (149.685 + 18.15) / 2.0);
        assert_eq!(work(&view, right).unwrap(), 6);
    }

    #[test]
    fn sixteen_bits_are_read_in_the_order_that_the_message_states() {
        let data = [0x01, 0x80];
        let view = |big_endian| View::new(1, 1, 2, Encoding::Mono16, big_endian, &data).unwrap();
        assert_eq!(mean_luma(&view(true), WHOLE).unwrap(), 384.0 / 257.0);
        assert_eq!(mean_luma(&view(false), WHOLE).unwrap(), 32_769.0 / 257.0);
        let mut grey = [0];
        to_gray(&view(true), &mut grey).unwrap();
        assert_eq!(grey, [0x01]);
        to_gray(&view(false), &mut grey).unwrap();
        assert_eq!(grey, [0x80]);
    }

    #[test]
    fn the_histogram_counts_the_levels_of_the_grey_image() {
        for name in READABLE {
            let encoding = Encoding::from_ros(name).unwrap();
            let step = 1_030 * encoding.bytes_per_pixel() + 3;
            let data = noise(1, step * 4);
            let view = View::new(1_030, 4, step as u32, encoding, false, &data).unwrap();
            let mut grey = vec![0; 1_030 * 4];
            to_gray(&view, &mut grey).unwrap();
            let counts = histogram(&view, WHOLE).unwrap();
            for (level, count) in counts.iter().enumerate() {
                let expected = grey.iter().filter(|g| usize::from(**g) == level).count();
                assert_eq!(*count as usize, expected, "{name}, level {level}");
            }
        }
    }

    #[test]
    fn a_region_may_start_between_the_halves_of_a_pair() {
        let data = [90, 1, 91, 2, 92, 3, 93, 4];
        let view = View::new(4, 1, 8, Encoding::Yuv422Uyvy, false, &data).unwrap();
        let roi = Some(Roi { x: 1, y: 0, width: 2, height: 1 });
        assert_eq!(mean_luma(&view, roi).unwrap(), 2.5);
        assert_eq!(histogram(&view, roi).unwrap()[2..4], [1, 1]);
    }

    #[test]
    fn raw_images_are_refused_by_name() {
        for name in ["bayer_rggb8", "bayer_grbg16"] {
            let encoding = Encoding::from_ros(name).unwrap();
            let view = View::new(2, 2, 4, encoding, false, &[0; 8]).unwrap();
            assert_eq!(
                mean_luma(&view, WHOLE).unwrap_err().to_string(),
                format!(
                    "mean luma of a raw image ({name}): \
                     its pixels have no colour until it is debayered"
                )
            );
            assert!(histogram(&view, WHOLE).is_err());
            assert!(to_gray(&view, &mut [0; 4]).is_err());
        }
    }

    #[test]
    fn an_output_of_another_length_is_refused() {
        let view = View::new(2, 2, 2, Encoding::Mono8, false, &[0; 4]).unwrap();
        for len in [0, 3, 5] {
            assert_eq!(
                to_gray(&view, &mut vec![0; len]).unwrap_err().to_string(),
                format!("grey image needs 4 bytes; the output has {len}")
            );
        }
    }

    #[test]
    fn a_region_outside_is_refused() {
        let view = View::new(2, 2, 2, Encoding::Mono8, false, &[0; 4]).unwrap();
        let outside = Some(Roi { x: 2, y: 0, width: 1, height: 1 });
        assert!(matches!(mean_luma(&view, outside), Err(PixelError::Roi { .. })));
        assert!(matches!(histogram(&view, outside), Err(PixelError::Roi { .. })));
    }
}
