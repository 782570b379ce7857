//! Bilinear interpolation, bit for bit as `INTER_LINEAR` of OpenCV on bytes.
//!
//! A new pixel is blended from two pixels of two rows, without the mean of those in between: that
//! is how the models were trained. Weights are in 1/2048. A row is first blended across, to 1/128
//! of a level, and two such rows then down.
//!
//! Source: `HResizeLinear`, `VResizeLinear` and `resizeGeneric_` in `imgproc/src/resize.cpp` of
//! OpenCV 4.

use gleaner_rules::pixels::{Encoding, View};

use crate::vision::error::VisionError;

/// Sum of two weights.
const ONE: u16 = 2048;

/// Bits of the 11 of a weight that are dropped after the blend across, so that 16 bits suffice.
const DROPPED_BITS: u32 = 4;

/// A new pixel between two old ones of its axis. At an edge, both are the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Blend {
    first: u32,
    second: u32,
    /// Weights of both, in 1/2048.
    weights: [u16; 2],
}

impl Blend {
    /// Returns the blend of the new pixel `at` if `from` old ones become `to`.
    fn of(at: u32, from: u32, to: u32) -> Self {
        let scale = 1.0 / (f64::from(to) / f64::from(from));
        let position = ((f64::from(at) + 0.5) * scale - 0.5) as f32;
        let first = position.floor();
        let part = position - first;
        // A position of -0.5 at the start becomes two times pixel 0, as does the last at the end.
        let pixel = |index: f32| (index.max(0.0) as u32).min(from - 1);
        let weight = |part: f32| (part * f32::from(ONE)).round_ties_even() as u16;
        Self {
            first: pixel(first),
            second: pixel(first + 1.0),
            weights: [weight(1.0 - part), weight(part)],
        }
    }
}

/// A blend of two neighbours in a row of at least two pixels, read with one check of bounds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Neighbours {
    first: u32,
    weights: [u16; 2],
}

impl Neighbours {
    /// Returns the same blend in a row of `width` pixels.
    fn of(Blend { first, second, weights }: Blend, width: u32) -> Self {
        if first != second {
            Self { first, weights }
        } else if first + 1 < width {
            Self { first, weights: [ONE, 0] }
        } else {
            Self { first: first.saturating_sub(1), weights: [0, ONE] }
        }
    }
}

/// A row of the frame, blended across.
#[derive(Debug, Default)]
struct BlendedRow {
    /// Number of the row in the frame.
    source: Option<u32>,
    /// Levels of each new pixel, in 1/128.
    levels: Vec<[u16; 4]>,
}

/// The left or the right old pixels of all columns.
#[derive(Debug, Default)]
struct BlendSide {
    pixels: Vec<[u8; 4]>,
    /// The weight of each byte of a pixel.
    weights: Vec<[u16; 4]>,
}

/// Buffers of a resize, to be used again.
#[derive(Debug, Default)]
pub(crate) struct Bilinear {
    /// The left old pixel of each column.
    columns: Vec<u32>,
    /// The left and the right old pixel of each column, and their weights for each byte.
    sides: [BlendSide; 2],
    rows: [BlendedRow; 2],
    /// A row of the frame, if it has to be changed before it is blended.
    changed: Vec<u8>,
    /// A row of the result.
    line: Vec<[u8; 4]>,
}

/// Order of the bytes of pixels that can be resized.
#[derive(Debug, Clone, Copy)]
pub(crate) enum PixelOrder {
    Grey,
    Rgb,
    Bgr,
    Rgba,
    Bgra,
    Uyvy,
    Yuyv,
}

impl PixelOrder {
    pub(crate) fn of(encoding: Encoding) -> Result<Self, VisionError> {
        match encoding {
            Encoding::Mono8 => Ok(Self::Grey),
            Encoding::Rgb8 => Ok(Self::Rgb),
            Encoding::Bgr8 => Ok(Self::Bgr),
            Encoding::Rgba8 => Ok(Self::Rgba),
            Encoding::Bgra8 => Ok(Self::Bgra),
            Encoding::Yuv422Uyvy => Ok(Self::Uyvy),
            Encoding::Yuv422Yuyv => Ok(Self::Yuyv),
            Encoding::Mono16 | Encoding::Bayer8(_) | Encoding::Bayer16(_) => {
                Err(VisionError::Encoding { encoding })
            }
        }
    }
}

pub(crate) struct Resize<'a> {
    buffers: &'a mut Bilinear,
    view: &'a View<'a>,
    order: PixelOrder,
    bgr: bool,
    height: u32,
}

impl Bilinear {
    /// Begins the resize of `view` to `width` x `height` pixels, with blue first if `bgr`.
    pub(crate) fn begin<'a>(
        &'a mut self,
        view: &'a View<'a>,
        (width, height): (u32, u32),
        bgr: bool,
    ) -> Result<Resize<'a>, VisionError> {
        let order = PixelOrder::of(view.encoding())?;
        self.columns.clear();
        self.columns.reserve(width as usize);
        let [left, right] = &mut self.sides;
        for side in [&mut *left, &mut *right] {
            side.weights.clear();
            side.weights.reserve(width as usize);
            side.pixels.resize(width as usize, [0; 4]);
        }
        let old_width = view.width();
        for x in 0..width {
            let Neighbours { first, weights } =
                Neighbours::of(Blend::of(x, old_width, width), old_width);
            self.columns.push(first);
            left.weights.push([weights[0]; 4]);
            right.weights.push([weights[1]; 4]);
        }
        for row in &mut self.rows {
            row.source = None;
            row.levels.resize(width as usize, [0; 4]);
        }
        self.line.resize(width as usize, [0; 4]);
        Ok(Resize { buffers: self, view, order, bgr, height })
    }
}

impl Resize<'_> {
    /// Returns the place of the first, second and third channel of the tensor in a pixel of
    /// [`row`](Self::row).
    pub(crate) fn channels(&self) -> [usize; 3] {
        match (self.order, self.bgr) {
            (PixelOrder::Grey, _) => [0; 3],
            (PixelOrder::Bgr | PixelOrder::Bgra, true)
            | (PixelOrder::Rgb | PixelOrder::Rgba | PixelOrder::Uyvy | PixelOrder::Yuyv, false) => {
                [0, 1, 2]
            }
            _ => [2, 1, 0],
        }
    }

    /// Returns row `y` of the result. The bytes of its pixels are in the order of the frame.
    pub(crate) fn row(&mut self, y: u32) -> &[[u8; 4]] {
        let Blend { first, mut second, weights } = Blend::of(y, self.view.height(), self.height);
        if weights[1] == 0 {
            // It has no part in the result, as in every row of a third of the size.
            second = first;
        }
        if self.buffers.rows[0].source != Some(first) {
            self.buffers.rows.swap(0, 1);
        }
        self.blend_across(0, first);
        if second != first {
            self.blend_across(1, second);
        }
        let Bilinear { rows: [upper, lower], line, .. } = &mut *self.buffers;
        let lower = if second == first { &upper.levels } else { &lower.levels };
        let (upper, lower) = (upper.levels.as_flattened(), lower.as_flattened());
        blend_down(upper, lower, weights, line.as_flattened_mut());
        line
    }

    /// Puts row `source` of the frame, blended across, into a buffer, unless it is there.
    fn blend_across(&mut self, index: usize, source: u32) {
        let Bilinear { columns, sides, rows, changed, .. } = &mut *self.buffers;
        let row = &mut rows[index];
        if row.source == Some(source) {
            return;
        }
        row.source = Some(source);
        let pixels = self.view.row(source);
        let pixels = match self.order {
            PixelOrder::Uyvy => to_rgb::<0, 1, 2, 3>(pixels, changed),
            PixelOrder::Yuyv => to_rgb::<1, 0, 3, 2>(pixels, changed),
            // A single pixel becomes its own neighbour.
            _ if self.view.width() == 1 => {
                changed.clear();
                changed.extend_from_slice(pixels);
                changed.extend_from_slice(pixels);
                changed
            }
            _ => pixels,
        };
        let levels = &mut row.levels;
        match self.order {
            PixelOrder::Grey => take_sides::<1>(pixels, columns, sides),
            PixelOrder::Rgba | PixelOrder::Bgra => take_sides::<4>(pixels, columns, sides),
            _ => take_sides::<3>(pixels, columns, sides),
        }
        blend_sides(sides, levels.as_flattened_mut());
    }
}

/// Copies the two old pixels of each column, of `BYTES` bytes. What follows them does not count.
fn take_sides<const BYTES: usize>(row: &[u8], columns: &[u32], sides: &mut [BlendSide; 2]) {
    let [left, right] = sides;
    let pixels = left.pixels.iter_mut().zip(&mut right.pixels);
    for (column, (left, right)) in columns.iter().zip(pixels) {
        let rest = row.get(*column as usize * BYTES..).unwrap_or_default();
        let word = match rest.first_chunk() {
            Some(bytes) => u64::from_le_bytes(*bytes),
            None => rest.iter().rev().fold(0, |word, byte| word << 8 | u64::from(*byte)),
        };
        *left = (word as u32).to_le_bytes();
        *right = ((word >> (8 * BYTES)) as u32).to_le_bytes();
    }
}

/// Blends across. No condition is in its loop, so a CPU does several bytes at once.
fn blend_sides([left, right]: &[BlendSide; 2], levels: &mut [u16]) {
    let left = left.pixels.as_flattened().iter().zip(left.weights.as_flattened());
    let right = right.pixels.as_flattened().iter().zip(right.weights.as_flattened());
    let part = |byte: &u8, weight: &u16| u32::from(*byte) * u32::from(*weight);
    for (level, (left, right)) in levels.iter_mut().zip(left.zip(right)) {
        // At most 255 * 2048 / 16 = 32,640.
        *level = ((part(left.0, left.1) + part(right.0, right.1)) >> DROPPED_BITS) as u16;
    }
}

/// Blends two rows down, and rounds to whole levels.
fn blend_down(upper: &[u16], lower: &[u16], [above, below]: [u16; 2], line: &mut [u8]) {
    // The high half of a product without signs: CPUs compute eight at once.
    let share = |level: u16, weight: u16| ((u32::from(level) * u32::from(weight)) >> 16) as u16;
    for ((level, upper), lower) in line.iter_mut().zip(upper).zip(lower) {
        // Quarters of a level, at most 1020. A check of the sums would cost more than the rest.
        let quarters = share(*upper, above).wrapping_add(share(*lower, below));
        *level = (quarters.wrapping_add(2) >> 2) as u8;
    }
}

/// Converts pairs of pixels, whose U, left Y, V and right Y are at the given offsets, to colours:
/// luma and chroma of full range, as `resize` of `gleaner_rules` does; a test compares them.
fn to_rgb<'a, const U: usize, const LEFT: usize, const V: usize, const RIGHT: usize>(
    row: &[u8],
    rgb: &'a mut Vec<u8>,
) -> &'a [u8] {
    const HALF: i32 = 1 << 15;
    let (pairs, _) = row.as_chunks::<4>();
    rgb.resize(6 * pairs.len(), 0);
    for (rgb, pair) in rgb.as_chunks_mut::<6>().0.iter_mut().zip(pairs) {
        let (u, v) = (i32::from(pair[U]) - 128, i32::from(pair[V]) - 128);
        // Rounded here, once for both pixels, as their luma is whole.
        let shifts = [
            (HALF + 91_881 * v) >> 16,
            (HALF - 22_554 * u - 46_802 * v) >> 16,
            (HALF + 116_130 * u) >> 16,
        ];
        // Sums that saturate need no branch, which a CPU would often predict wrongly.
        let up = shifts.map(|shift| shift.clamp(0, 255) as u8);
        let down = shifts.map(|shift| (-shift).clamp(0, 255) as u8);
        let colour = |y: u8| [0, 1, 2].map(|at| y.saturating_add(up[at]).saturating_sub(down[at]));
        let ([r0, g0, b0], [r1, g1, b1]) = (colour(pair[LEFT]), colour(pair[RIGHT]));
        *rgb = [r0, g0, b0, r1, g1, b1];
    }
    rgb
}

#[cfg(test)]
mod tests {
    use gleaner_rules::pixels::ops;

    use super::*;

    #[test]
    fn weights_of_a_blend_make_a_whole() {
        for from in 1..60 {
            for to in 1..60 {
                for at in 0..to {
                    let Blend { first, second, weights: [a, b] } = Blend::of(at, from, to);
                    assert_eq!(a + b, 2048, "{at} of {from} to {to}");
                    assert!(first <= second && second <= first + 1 && second < from);
                }
            }
        }
        assert_eq!(Blend::of(8191, 65_535, 8192).second, 65_531);
    }

    #[test]
    fn every_level_passes_both_blends_unchanged() {
        for level in 0..=255_u8 {
            for part in 0..=2048 {
                let weights = [2048 - part, part];
                let across = ((u32::from(level) * 2048) >> DROPPED_BITS) as u16;
                let mut line = [0];
                blend_down(&[across], &[across], weights, &mut line);
                assert_eq!(line, [level], "{part}");
            }
        }
    }

    #[test]
    fn yuv_becomes_the_same_colour_as_in_operations_on_frames() {
        let levels: Vec<u8> = (0..=255).step_by(5).collect();
        for u in &levels {
            for v in &levels {
                let row: Vec<u8> =
                    levels.chunks_exact(2).flat_map(|y| [*u, y[0], *v, y[1]]).collect();
                let width = row.len() as u32 / 2;
                let encoding = Encoding::Yuv422Uyvy;
                let view = View::new(width, 1, 2 * width, encoding, false, &row).unwrap();
                let mut expected = vec![0; 3 * width as usize];
                ops::resize(&view, width, 1, &mut expected).unwrap();
                assert_eq!(to_rgb::<0, 1, 2, 3>(&row, &mut Vec::new()), expected);
            }
        }
    }
}
