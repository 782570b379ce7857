//! Downscales images.
//!
//! Each axis is scaled by itself. Divide the axis of `from` pixels into `from * to` pieces: an old
//! pixel has `to` of them, a new one `from`, and the weight of an old pixel in a new one is the
//! number of pieces that they share. So the result is an exact fraction, rounded once.

use std::array;

use super::{Colours, Image, ImageError};

/// Bytes of a row that one iteration of the loop weights.
const TURN: usize = 64;

/// Pixels of a row that one iteration of the loop adds up.
const PIXELS: usize = 16;

/// Returns the number of bytes that [`downscale`] of `image` to `width` x `height` writes: three
/// per pixel of a coloured image, one per pixel of a grey one.
///
/// # Errors
///
/// [`ImageError::ResizeTo`] if a side is 0 or longer than before.
pub fn downscaled(image: &Image<'_>, width: u32, height: u32) -> Result<usize, ImageError> {
    if !(1..=image.width()).contains(&width) || !(1..=image.height()).contains(&height) {
        return Err(ImageError::ResizeTo {
            from: (image.width(), image.height()),
            to: (width, height),
        });
    }
    // No more than the image has.
    Ok(width as usize * height as usize * image.pixel())
}

/// Writes the image in `width` x `height` pixels to `out`, without padding: rgb8 for a coloured
/// image (also bgr8), mono8 for a grey one. The bytes equal those of
/// [`Frame::resize`](crate::Frame::resize) where no side grows.
///
/// A new pixel is the mean of the area that it covers, computed exactly and rounded to nearest
/// (halves up). Allocates 12 bytes for each byte in a row of the old image, and 8 for each pixel in
/// a row of the new one.
///
/// # Errors
///
/// As [`downscaled`], and [`ImageError::Output`] if `out` has another length.
pub fn downscale(
    image: &Image<'_>,
    width: u32,
    height: u32,
    out: &mut [u8],
) -> Result<(), ImageError> {
    let needed = downscaled(image, width, height)?;
    if out.len() != needed {
        return Err(ImageError::Output { needed, found: out.len() });
    }
    let across = Axis::new(image.width(), width);
    let down = Axis::new(image.height(), height);
    let rounded = RoundedDivision::to(u64::from(down.from) * u64::from(across.from));
    let edges: Vec<Edge> = (0..=width).map(|x| across.edge(x)).collect();
    let mut columns = vec![0_u32; image.width * image.pixel()];
    let mut sums = vec![0_u64; columns.len() + 2 * image.pixel()];
    for (y, line) in (0..height).zip(out.chunks_exact_mut(width as usize * image.pixel())) {
        let taps = down.taps(y);
        columns.fill(0);
        for (source, row) in (taps.first..=taps.last).zip(image.rows_from(taps.first as usize)) {
            add_weighted(row, down.weight(taps, source), &mut columns);
        }
        let row = PixelRow { columns: &columns, sums: &mut sums, edges: &edges, across, rounded };
        match image.colours {
            Colours::Grey => row.blend(line, |[grey]| [grey]),
            Colours::Rgb => row.blend(line, |rgb: [u8; 3]| rgb),
            Colours::Bgr => row.blend(line, |[blue, green, red]| [red, green, blue]),
        }
    }
    Ok(())
}

/// Adds `row`, times `weight`, to `columns`. The weights of a column add up to less than 2^16, so
/// no sum reaches 2^24. Checked arithmetic would prevent vectorisation.
fn add_weighted(row: &[u8], weight: u32, columns: &mut [u32]) {
    let add =
        |sum: &mut u32, byte: &u8| *sum = sum.wrapping_add(weight.wrapping_mul(u32::from(*byte)));
    let (turns, rest) = row.as_chunks::<TURN>();
    let (column_turns, column_rest) = columns.as_chunks_mut::<TURN>();
    for (sums, bytes) in column_turns.iter_mut().zip(turns) {
        for (sum, byte) in sums.iter_mut().zip(bytes) {
            add(sum, byte);
        }
    }
    for (sum, byte) in column_rest.iter_mut().zip(rest) {
        add(sum, byte);
    }
}

/// A row of old pixels that becomes one of new pixels.
struct PixelRow<'a> {
    columns: &'a [u32],
    /// Place for the sums of all old pixels before each one, and one more.
    sums: &'a mut [u64],
    edges: &'a [Edge],
    across: Axis,
    rounded: RoundedDivision,
}

impl PixelRow<'_> {
    /// Writes new pixels of `N` bytes; `arrange` reorders the bytes of a pixel.
    ///
    /// The sum of a new pixel is the difference of the sums before its two edges, so that the
    /// number of its old pixels decides no branch.
    fn blend<const N: usize>(self, line: &mut [u8], arrange: impl Fn([u8; N]) -> [u8; N]) {
        let columns = self.columns.as_chunks::<N>().0;
        let sums = self.sums.as_chunks_mut::<N>().0;
        add_up(columns, &mut sums[1..=columns.len()]);
        let scale = u64::from(self.across.to);
        let before = |edge: &Edge| {
            let [sum, next] = [sums[edge.pixel as usize], sums[edge.pixel as usize + 1]];
            let part = u64::from(edge.pieces);
            // Below 2^16 pieces of 2^16 pixels of 2^24; checks would only take time.
            array::from_fn(|at| {
                let pixel = next[at].wrapping_sub(sum[at]);
                scale.wrapping_mul(sum[at]).wrapping_add(part.wrapping_mul(pixel))
            })
        };
        let mut left: [u64; N] = [0; N];
        for (edge, pixel) in self.edges[1..].iter().zip(line.as_chunks_mut::<N>().0) {
            let right = before(edge);
            *pixel =
                arrange(array::from_fn(|at| self.rounded.divide(right[at].wrapping_sub(left[at]))));
            left = right;
        }
    }
}

/// Writes the sum of all columns up to each one.
fn add_up<const N: usize>(columns: &[[u32; N]], sums: &mut [[u64; N]]) {
    let mut total = [0_u64; N];
    let mut add = |(sum, column): (&mut [u64; N], &[u32; N])| {
        *sum = array::from_fn(|at| total[at].wrapping_add(u64::from(column[at])));
        total = *sum;
    };
    let (turns, rest) = columns.as_chunks::<PIXELS>();
    let (sum_turns, sum_rest) = sums.as_chunks_mut::<PIXELS>();
    for (sums, columns) in sum_turns.iter_mut().zip(turns) {
        sums.iter_mut().zip(columns).for_each(&mut add);
    }
    sum_rest.iter_mut().zip(rest).for_each(&mut add);
}

/// An axis of an image and its new length, as a fraction in lowest terms.
#[derive(Clone, Copy)]
struct Axis {
    from: u32,
    to: u32,
}

/// Old pixels `first..=last` of a new one, and the weights of the two.
#[derive(Clone, Copy)]
struct Taps {
    first: u32,
    last: u32,
    head: u32,
    tail: u32,
}

/// The left edge of a new pixel: an old pixel, and the pieces of it before the edge.
#[derive(Clone, Copy)]
struct Edge {
    pixel: u32,
    pieces: u32,
}

impl Axis {
    fn new(from: u32, to: u32) -> Self {
        let (mut divisor, mut rest) = (from, to);
        while rest > 0 {
            (divisor, rest) = (rest, divisor % rest);
        }
        Self { from: from / divisor, to: to / divisor }
    }

    /// Returns the old pixels in new pixel `at`; their weights add up to `from`. No product exceeds
    /// the square of [`MAX_SIDE`](super::MAX_SIDE), which fits a `u32`.
    fn taps(self, at: u32) -> Taps {
        let Self { from, to } = self;
        let (start, end) = (at * from, (at + 1) * from);
        let (first, last) = (start / to, (end - 1) / to);
        Taps { first, last, head: end.min((first + 1) * to) - start, tail: end - last * to }
    }

    /// Returns the left edge of new pixel `at`.
    fn edge(self, at: u32) -> Edge {
        let pieces = at * self.from;
        Edge { pixel: pieces / self.to, pieces: pieces % self.to }
    }

    fn weight(self, taps: Taps, source: u32) -> u32 {
        if source == taps.first {
            taps.head
        } else if source == taps.last {
            taps.tail
        } else {
            self.to
        }
    }
}

/// Division of a sum of weighted bytes by the sum of weights, rounded to nearest.
#[derive(Clone, Copy)]
struct RoundedDivision {
    total: u64,
    /// 2^[`SHIFT`](Self::SHIFT) / `total`, rounded up; none if a product with it is not exact
    /// enough.
    factor: Option<u64>,
}

impl RoundedDivision {
    const SHIFT: u32 = 55;

    /// A sum and half of `total` are below 256 * total. The factor is too large by less than 1,
    /// which moves the quotient by less than 256 * total / 2^55. Up to a total of 2^23 that is at
    /// most 1 / total, too little to reach the next whole number; and no product exceeds 2^63 +
    /// 2^31.
    fn to(total: u64) -> Self {
        let factor = (total <= 1 << 23).then(|| (1_u64 << Self::SHIFT).div_ceil(total));
        Self { total, factor }
    }

    fn divide(self, sum: u64) -> u8 {
        let sum = sum + self.total / 2;
        match self.factor {
            // A check would multiply with 128 bits, by a call in a component.
            Some(factor) => (sum.wrapping_mul(factor) >> Self::SHIFT) as u8,
            None => (sum / self.total) as u8,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::Encoding;

    #[test]
    fn multiplication_by_the_factor_equals_division() {
        for total in [
            1,
            2,
            3,
            7,
            1000,
            65_535,
            2_073_600,
            (1 << 23) - 1,
            1 << 23,
            (1 << 23) + 1,
            4_294_836_225,
        ] {
            let rounded = RoundedDivision::to(total);
            for level in 0..=255 {
                // Around the places where the result changes.
                let edge = level * total + total.div_ceil(2);
                for sum in (edge.saturating_sub(2)..edge + 2).filter(|sum| *sum <= 255 * total) {
                    assert_eq!(
                        u64::from(rounded.divide(sum)),
                        (sum + total / 2) / total,
                        "{sum} / {total}"
                    );
                }
            }
        }
    }

    #[test]
    fn half_the_size_is_the_mean_of_four_rounded_to_nearest() {
        let image = Image::new(4, 2, 4, Encoding::Mono8, &[0, 1, 10, 20, 0, 1, 30, 41]).unwrap();
        let mut out = [0; 2];
        downscale(&image, 2, 1, &mut out).unwrap();
        assert_eq!(out, [1, 25]); // 0.5 and 25.25
    }

    #[test]
    fn blue_and_red_are_swapped_for_bgr8() {
        let image = Image::new(1, 1, 3, Encoding::Bgr8, &[1, 2, 3]).unwrap();
        let mut out = [0; 3];
        downscale(&image, 1, 1, &mut out).unwrap();
        assert_eq!(out, [3, 2, 1]);
    }

    #[test]
    fn larger_sizes_and_outputs_of_another_length_are_refused() {
        let image = Image::new(2, 1, 2, Encoding::Mono8, &[1, 2]).unwrap();
        let refused = |width, height, out| {
            downscale(&image, width, height, &mut vec![0; out]).unwrap_err().to_string()
        };
        assert!(refused(3, 1, 3).starts_with("2x1 pixels cannot become 3x1"));
        assert!(refused(0, 1, 0).starts_with("2x1 pixels cannot become 0x1"));
        assert_eq!(refused(1, 1, 2), "the result takes 1 bytes; the output has 2");
    }
}
