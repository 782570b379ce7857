//! Resizes images.
//!
//! Each axis is resampled with integer weights, so that a result is an exact fraction, rounded
//! once:
//!
//! - smaller or equal: the mean of the area that a new pixel covers. With the axis of `from` pixels
//!   divided into `from * to` pieces, an old pixel has `to` of them, a new one `from`, and the
//!   weight of an old pixel is the number of pieces that they share.
//! - larger: linear interpolation between the two old pixels around the centre of the new one, with
//!   the centre in units of 1 / (2 `to`) of an old pixel. Beyond the outermost centres the edge is
//!   repeated.
//!
//! The cheaper order of the axes is used: rows are added up before their width changes, but if the
//! height grows, the width of each old row is changed once, for several new rows. Sums are exact,
//! so both orders give the same bytes.

use super::pixels::PixelFormat;
use super::rounded::RoundedDivision;
use crate::pixels::{Encoding, PixelError, View};

/// Largest width and height of a resized image, in pixels.
pub const MAX_RESIZED_SIDE: u32 = 16_384;

/// Returns the encoding and the length in bytes of the result of [`resize`] of `view` to `width` x
/// `height`: rgb8 for a colour image and mono8 for a grey one.
///
/// # Errors
///
/// [`PixelError::ResizeTo`] if a side is 0 or above [`MAX_RESIZED_SIDE`], [`PixelError::Raw`] for a
/// Bayer image.
pub fn resized(view: &View<'_>, width: u32, height: u32) -> Result<(Encoding, usize), PixelError> {
    PixelFormat::of(view, "resize")?;
    let fits = |side| (1..=MAX_RESIZED_SIDE).contains(&side);
    if !fits(width) || !fits(height) {
        return Err(PixelError::ResizeTo { width, height });
    }
    let encoding = if view.encoding().is_grey() { Encoding::Mono8 } else { Encoding::Rgb8 };
    // At most 3 * 2^28.
    Ok((encoding, width as usize * height as usize * encoding.bytes_per_pixel()))
}

/// Returns the cost of [`resize`], in bytes that could be copied in the same time: a byte of the
/// old image counts 3, of yuv422 64, and a byte of the new one 16. If the height does not grow,
/// each new row processes sums as wide as the old one, which count 8 each.
///
/// # Errors
///
/// As for [`resized`].
pub fn resize_work(view: &View<'_>, width: u32, height: u32) -> Result<u64, PixelError> {
    let (encoding, out) = resized(view, width, height)?;
    let old_row = u64::from(view.width()) * encoding.bytes_per_pixel() as u64;
    let sums = if height > view.height() { 0 } else { u64::from(height) * old_row };
    let old = if view.encoding().is_paired() { 64 } else { 3 };
    Ok(old * u64::from(view.height()) * view.row(0).len() as u64 + 16 * out as u64 + 8 * sums)
}

/// Writes the image in `width` x `height` pixels to `out`, without padding, in the encoding that
/// [`resized`] returns, which this function returns, too.
///
/// Each axis is resampled by itself: the mean of the covered area if it shrinks, linear
/// interpolation if it grows, both exact and rounded to nearest (half up). Of mono16 the high byte
/// is used, yuv422 is assumed to be BT.601 of full range, alpha is ignored. It allocates 5 bytes
/// per value of one row of the old image, 8 per value of one row of the new image, and 16 for each
/// of its columns.
///
/// # Errors
///
/// As for [`resized`], [`PixelError::Output`] if `out` has another length, [`PixelError::Stopped`].
pub fn resize(
    view: &View<'_>,
    width: u32,
    height: u32,
    out: &mut [u8],
) -> Result<Encoding, PixelError> {
    let pixels = PixelFormat::of(view, "resize")?;
    let (encoding, needed) = resized(view, width, height)?;
    if out.len() != needed {
        return Err(PixelError::Output { operation: "resize", needed, found: out.len() });
    }
    let across = Axis { from: view.width(), to: width };
    let down = Axis { from: view.height(), to: height };
    match encoding.bytes_per_pixel() {
        1 => Resize::<1>::new(pixels, across, down).fill(view, out)?,
        _ => Resize::<3>::new(pixels, across, down).fill(view, out)?,
    }
    Ok(encoding)
}

/// A resize of images with `CHANNELS` numbers per pixel.
struct Resize<const CHANNELS: usize> {
    pixels: PixelFormat,
    down: Axis,
    /// Weights of each new column.
    across: Vec<Taps>,
    rounded: RoundedDivision,
    /// Buffer for an old row whose pixels have to be rearranged.
    row: Vec<u8>,
}

impl<const CHANNELS: usize> Resize<CHANNELS> {
    fn new(pixels: PixelFormat, across: Axis, down: Axis) -> Self {
        let rounded = RoundedDivision::to(u64::from(down.total()) * u64::from(across.total()));
        let row = vec![0; across.from as usize * CHANNELS];
        Self {
            pixels,
            down,
            across: (0..across.to).map(|x| across.taps(x)).collect(),
            rounded,
            row,
        }
    }

    fn fill(self, view: &View<'_>, out: &mut [u8]) -> Result<(), PixelError> {
        if self.down.to > self.down.from {
            self.grow_down(view, out)
        } else {
            self.shrink_down(view, out)
        }
    }

    /// Adds up the old rows of each new one, then blends the sums across.
    fn shrink_down(mut self, view: &View<'_>, out: &mut [u8]) -> Result<(), PixelError> {
        let mut columns = vec![0_u32; self.row.len()];
        for (y, line) in (0..).zip(out.chunks_exact_mut(self.across.len() * CHANNELS)) {
            view.check_stop(line.len())?;
            columns.fill(0);
            let taps = self.down.taps(y);
            for source in taps.first..=taps.last {
                view.check_stop(columns.len())?;
                add_weighted(
                    self.pixels.row::<CHANNELS>(view.row(source), &mut self.row),
                    taps.weight(source),
                    &mut columns,
                );
            }
            let (columns, _) = columns.as_chunks::<CHANNELS>();
            for (pixel, taps) in line.as_chunks_mut::<CHANNELS>().0.iter_mut().zip(&self.across) {
                *pixel = taps.blend(columns).map(|sum| self.rounded.divide(sum));
            }
        }
        Ok(())
    }

    /// Blends each old row across, then two of them into each new row.
    fn grow_down(mut self, view: &View<'_>, out: &mut [u8]) -> Result<(), PixelError> {
        let width = self.across.len() * CHANNELS;
        // The last two blended rows, the upper one first.
        let mut blended = [vec![0_u32; width], vec![0_u32; width]];
        let mut next = 0;
        for (y, line) in (0..).zip(out.chunks_exact_mut(width)) {
            let taps = self.down.taps(y);
            while next <= taps.last {
                view.check_stop(self.row.len() + width)?;
                blended.swap(0, 1);
                let row = self.pixels.row::<CHANNELS>(view.row(next), &mut self.row);
                let (row, _) = row.as_chunks::<CHANNELS>();
                for (sums, taps) in
                    blended[1].as_chunks_mut::<CHANNELS>().0.iter_mut().zip(&self.across)
                {
                    // Below 2^8 * 2^16.
                    *sums = taps.blend(row).map(|sum| sum as u32);
                }
                next += 1;
            }
            view.check_stop(width)?;
            // At the edge there is only one old row, the lower one.
            let upper = if taps.first == taps.last { &blended[1] } else { &blended[0] };
            let (head, tail) = (u64::from(taps.head), u64::from(taps.tail));
            for ((byte, upper), lower) in line.iter_mut().zip(upper).zip(&blended[1]) {
                // Below 2^24 * 2^15, as the weights add up to at most 2^15.
                *byte = self.rounded.divide(
                    head.wrapping_mul(u64::from(*upper))
                        .wrapping_add(tail.wrapping_mul(u64::from(*lower))),
                );
            }
        }
        Ok(())
    }
}

/// Adds `row`, times `weight`, to `columns`. Weights of a column add up to less than 2^16, so no
/// sum reaches 2^24; checked arithmetic would not vectorise.
fn add_weighted(row: &[u8], weight: u32, columns: &mut [u32]) {
    // Vector instructions have products of 16 bits.
    let weight = weight as u16;
    for (sum, value) in columns.iter_mut().zip(row) {
        *sum = sum.wrapping_add(u32::from(weight).wrapping_mul(u32::from(*value)));
    }
}

/// One axis of an image and its new length.
#[derive(Debug, Clone, Copy)]
struct Axis {
    from: u32,
    to: u32,
}

/// Old pixels `first..=last` and their weights in a new pixel.
#[derive(Debug, Clone, Copy)]
struct Taps {
    first: u32,
    last: u32,
    head: u32,
    middle: u32,
    tail: u32,
}

impl Taps {
    fn weight(self, source: u32) -> u32 {
        if source == self.first {
            self.head
        } else if source == self.last {
            self.tail
        } else {
            self.middle
        }
    }

    /// Returns the weighted sum of old pixels. Values below 2^24 give sums below 2^40.
    fn blend<T: Copy + Into<u64>, const CHANNELS: usize>(
        &self,
        old: &[[T; CHANNELS]],
    ) -> [u64; CHANNELS] {
        let times = |values: &[T; CHANNELS], weight: u32| {
            values.map(|value| value.into().wrapping_mul(u64::from(weight)))
        };
        let add = |sums: &mut [u64; CHANNELS], values: [u64; CHANNELS]| {
            sums.iter_mut().zip(values).for_each(|(sum, value)| *sum = sum.wrapping_add(value));
        };
        let [first, last] = [self.first, self.last].map(|at| at as usize);
        let mut sums = times(&old[first], self.head);
        if last > first {
            if last > first + 1 {
                let mut middle = [0; CHANNELS];
                old[first + 1..last]
                    .iter()
                    .for_each(|values| add(&mut middle, values.map(Into::into)));
                add(&mut sums, middle.map(|sum| sum.wrapping_mul(u64::from(self.middle))));
            }
            add(&mut sums, times(&old[last], self.tail));
        }
        sums
    }
}

impl Axis {
    /// Returns the sum of the weights of any new pixel: at most 65,535.
    fn total(self) -> u32 {
        if self.to <= self.from { self.from } else { 2 * self.to }
    }

    /// Returns the weights of the old pixels in new pixel `at`. All products are below 65,535 *
    /// 16,384 or 2 * 16,384^2, so they fit a `u32`.
    fn taps(self, at: u32) -> Taps {
        let Self { from, to } = self;
        if to <= from {
            let (start, end) = (at * from, (at + 1) * from);
            let (first, last) = (start / to, (end - 1) / to);
            let head = end.min((first + 1) * to) - start;
            return Taps { first, last, head, middle: to, tail: end - last * to };
        }
        // The middle of the new pixel, from the middle of the first old one.
        let middle = ((2 * at + 1) * from).saturating_sub(to);
        let (first, past) = (middle / (2 * to), middle % (2 * to));
        let last = (first + 1).min(from - 1);
        let tail = if last == first { 0 } else { past };
        Taps { first, last, head: 2 * to - tail, middle: 0, tail }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pixels::ops::noise;

    fn mono(width: u32, height: u32, data: &[u8]) -> View<'_> {
        View::new(width, height, width, Encoding::Mono8, false, data).unwrap()
    }

    fn resized_to(view: &View<'_>, width: u32, height: u32) -> Vec<u8> {
        let mut out = vec![0; resized(view, width, height).unwrap().1];
        resize(view, width, height, &mut out).unwrap();
        out
    }

    /// Returns the weight of old pixel `i` in new pixel `o`, computed independently in floating
    /// point: the overlap of two intervals, or the distance to the centre.
    fn reference_weight(from: u32, to: u32, i: u32, o: u32) -> f64 {
        let scale = f64::from(from) / f64::from(to);
        let i = f64::from(i);
        if to <= from {
            let (start, end) = (f64::from(o) * scale, f64::from(o + 1) * scale);
            return (end.min(i + 1.0) - start.max(i)).max(0.0) / scale;
        }
        let middle = (f64::from(o) + 0.5) * scale - 0.5;
        let middle = middle.clamp(0.0, f64::from(from - 1));
        (1.0 - (middle - i).abs()).max(0.0)
    }

    #[test]
    fn every_size_agrees_with_floating_point() {
        let data = noise(7, 7 * 5);
        let view = mono(7, 5, &data);
        for (width, height) in [(3, 2), (7, 5), (1, 1), (6, 4), (14, 10), (20, 3), (2, 17), (8, 6)]
        {
            let result = resized_to(&view, width, height);
            for y in 0..height {
                for x in 0..width {
                    let mut value = 0.0;
                    for (sy, row) in (0..5).zip(data.chunks(7)) {
                        for (sx, level) in (0..7).zip(row) {
                            value += reference_weight(7, width, sx, x)
                                * reference_weight(5, height, sy, y)
                                * f64::from(*level);
                        }
                    }
                    let got = f64::from(result[(y * width + x) as usize]);
                    assert!((got - value).abs() <= 0.5 + 1e-9, "{width}x{height}: {got}, {value}");
                }
            }
        }
    }

    #[test]
    fn half_the_size_is_the_mean_of_four_rounded_to_nearest() {
        let view_data = [0, 1, 10, 20, 0, 1, 30, 41];
        assert_eq!(resized_to(&mono(4, 2, &view_data), 2, 1), [1, 25]); // 0.5 and 25.25
    }

    #[test]
    fn twice_the_size_is_linear_between_the_middles() {
        assert_eq!(resized_to(&mono(2, 1, &[0, 100]), 4, 1), [0, 25, 75, 100]);
        assert_eq!(resized_to(&mono(1, 2, &[0, 100]), 1, 4), [0, 25, 75, 100]);
        assert_eq!(resized_to(&mono(1, 1, &[7]), 3, 2), [7; 6]);
    }

    #[test]
    fn the_same_size_is_the_same_image_without_its_padding() {
        let data = noise(7, 3 * 20);
        let view = View::new(5, 3, 20, Encoding::Rgb8, false, &data).unwrap();
        let expected: Vec<u8> = data.chunks(20).flat_map(|row| &row[..15]).copied().collect();
        assert_eq!(resized_to(&view, 5, 3), expected);
    }

    #[test]
    fn every_encoding_becomes_rgb8_or_mono8() {
        for (name, data, encoding, expected) in [
            ("rgb8", &[1, 2, 3, 1, 2, 3][..], Encoding::Rgb8, &[1, 2, 3][..]),
            ("bgr8", &[1, 2, 3, 1, 2, 3], Encoding::Rgb8, &[3, 2, 1]),
            ("rgba8", &[1, 2, 3, 9, 1, 2, 3, 9], Encoding::Rgb8, &[1, 2, 3]),
            ("bgra8", &[1, 2, 3, 9, 1, 2, 3, 9], Encoding::Rgb8, &[3, 2, 1]),
            ("mono8", &[4, 6], Encoding::Mono8, &[5]),
            ("mono16", &[200, 4, 200, 6], Encoding::Mono8, &[5]),
            ("uyvy", &[128, 10, 128, 20], Encoding::Rgb8, &[15, 15, 15]),
            ("yuyv", &[0, 128, 0, 255], Encoding::Rgb8, &[178, 0, 0]), // 1.402 * 127, -90, 0
        ] {
            let from = Encoding::from_ros(name).unwrap();
            let step = data.len() as u32;
            let view = View::new(2, 1, step, from, false, data).unwrap();
            assert_eq!(resized(&view, 1, 1).unwrap(), (encoding, expected.len()), "{name}");
            assert_eq!(resized_to(&view, 1, 1), expected, "{name}");
        }
    }

    #[test]
    fn the_longest_axes_do_not_overflow() {
        let data = vec![255; 65_535];
        let (wide, high) = (mono(65_535, 1, &data), mono(1, 65_535, &data));
        for to in [1, 2, 16_383, 16_384] {
            assert!(resized_to(&wide, to, 1).iter().all(|level| *level == 255));
            assert!(resized_to(&high, 1, to).iter().all(|level| *level == 255));
        }
        let small = mono(16_383, 1, &data[..16_383]);
        assert!(resized_to(&small, 16_384, 1).iter().all(|level| *level == 255));
    }

    #[test]
    fn excessive_sizes_raw_images_and_wrong_outputs_are_refused() {
        let view = mono(2, 2, &[0; 4]);
        for (width, height) in [(0, 1), (1, 0), (16_385, 1), (1, u32::MAX)] {
            assert_eq!(
                resize(&view, width, height, &mut []).unwrap_err().to_string(),
                format!("resize to {width}x{height}: each side must be 1 to 16384")
            );
            assert!(resize_work(&view, width, height).is_err());
        }
        assert_eq!(
            resize(&view, 3, 1, &mut [0; 9]).unwrap_err().to_string(),
            "resize needs 3 bytes; the output has 9"
        );
        let bayer = Encoding::from_ros("bayer_bggr8").unwrap();
        let raw = View::new(2, 2, 2, bayer, false, &[0; 4]).unwrap();
        assert!(matches!(resize(&raw, 1, 1, &mut [0; 3]), Err(PixelError::Raw { .. })));
    }

    #[test]
    fn work_counts_old_and_new_bytes_and_sums() {
        let view = View::new(4, 6, 12, Encoding::Rgb8, false, &[0; 72]).unwrap();
        assert_eq!(resize_work(&view, 2, 3).unwrap(), 3 * 72 + 16 * 18 + 8 * 3 * 12);
        assert_eq!(resize_work(&view, 2, 7).unwrap(), 3 * 72 + 16 * 42);
    }
}
