//! Computes the luma of pixels: mean luma and grey images.

use std::hint::black_box;

use super::{Colours, Image, ImageError};

/// Byte positions that are summed in parallel: a multiple of 1, 3 (bytes of a pixel) and 16 (bytes
/// of a vector).
const LANES: usize = 48;

/// Bytes that one iteration of the loop sums: four for each lane. An array of arrays, so that the
/// offset of each vector is an immediate of its load instruction.
type Turn = [[u8; LANES]; 4];

/// Iterations after which the 16-bit sums must be emptied: 64 * 4 * 255 = 65,280.
const TURNS: usize = 64;

/// Pixels of one iteration in [`grey`].
const PIXELS: usize = 32;

/// Returns the mean luma, 0 to 255. The result equals that of
/// [`Frame::mean_luma`](crate::Frame::mean_luma), bit for bit.
///
/// Luma is (299 R + 587 G + 114 B) / 1000, or the value itself for mono8. The sums are exact, and
/// divided once.
///
/// Source: luma weights of ITU-R BT.601.
pub fn mean_luma(image: &Image<'_>) -> f64 {
    let [first, second, third] = sums(image);
    // At most 65,535^2 pixels of 255 * 1000: below 2^51, so neither `u64` nor `f64` rounds.
    let (sum, scale) = match image.colours {
        Colours::Grey => (first, 1),
        Colours::Rgb => (299 * first + 587 * second + 114 * third, 1000),
        Colours::Bgr => (114 * first + 587 * second + 299 * third, 1000),
    };
    sum as f64 / (scale * image.width as u64 * image.height as u64) as f64
}

/// Returns the sum of each byte of a pixel over the image, in the order of the bytes; for a grey
/// image only the first is used.
pub(super) fn sums(image: &Image<'_>) -> [u64; 3] {
    let mut lanes = [0; LANES];
    if image.step == image.width * image.pixel() {
        // Without padding, all rows are one block, and the sums are emptied less often.
        add_bytes(&image.data[..image.step * image.height], &mut lanes);
    } else {
        image.rows().for_each(|row| add_bytes(row, &mut lanes));
    }
    let mut sums = [0; 3];
    for (lane, sum) in lanes.iter().enumerate() {
        sums[lane % image.pixel()] += sum;
    }
    sums
}

/// Adds each byte of `row` to the lane of its position, modulo [`LANES`].
fn add_bytes(row: &[u8], lanes: &mut [u64; LANES]) {
    for block in row.chunks(size_of::<Turn>() * TURNS) {
        let turns = block.as_chunks().0.as_chunks().0;
        let rest = &block[size_of_val(turns)..];
        for (lane, sum) in lanes.iter_mut().zip(short_sums(turns)) {
            *lane += u64::from(sum);
        }
        for (position, byte) in rest.iter().enumerate() {
            lanes[position % LANES] += u64::from(*byte);
        }
    }
}

/// Returns the sums of at most [`TURNS`] blocks. Not inlined, since the compiler does not vectorise
/// it inside of its caller.
///
/// Two bytes at a time are read as a 16-bit number. The upper bytes and the whole numbers are
/// summed; at the end the share of the upper bytes is subtracted from the latter, modulo 2^16,
/// since that sum wraps. A checked addition would prevent vectorisation.
#[inline(never)]
fn short_sums(turns: &[Turn]) -> [u16; LANES] {
    let mut whole = [0_u16; LANES / 2];
    let mut upper = [0_u16; LANES / 2];
    for turn in turns {
        // Without this, some compilers sum over the blocks instead, and gather single bytes for
        // that. It does not change the result.
        let turn = black_box(turn);
        for group in turn {
            for (lane, bytes) in group.as_chunks::<2>().0.iter().enumerate() {
                let number = u16::from_le_bytes(*bytes);
                whole[lane] = whole[lane].wrapping_add(number);
                upper[lane] = upper[lane].wrapping_add(number >> 8);
            }
        }
    }
    std::array::from_fn(|lane| {
        let (whole, upper) = (whole[lane / 2], upper[lane / 2]);
        if lane % 2 == 1 { upper } else { whole.wrapping_sub(upper << 8) }
    })
}

/// Writes the image as mono8 to `out`, width * height bytes without padding. The bytes equal those
/// of [`Frame::to_gray`](crate::Frame::to_gray). A grey level is the luma of [`mean_luma`], rounded
/// down.
///
/// # Errors
///
/// [`ImageError::Output`] if `out` has another length.
pub fn to_gray(image: &Image<'_>, out: &mut [u8]) -> Result<(), ImageError> {
    let needed = image.width * image.height;
    if out.len() != needed {
        return Err(ImageError::Output { needed, found: out.len() });
    }
    for (row, levels) in image.rows().zip(out.chunks_exact_mut(image.width)) {
        grey(image.colours, row, levels);
    }
    Ok(())
}

/// Writes the grey level of each pixel in `row` to `levels`, one byte per pixel.
pub(super) fn grey(colours: Colours, row: &[u8], levels: &mut [u8]) {
    match colours {
        Colours::Grey => levels.copy_from_slice(row),
        Colours::Rgb => weigh::<0, 2>(row, levels),
        Colours::Bgr => weigh::<2, 0>(row, levels),
    }
}

fn weigh<const RED: usize, const BLUE: usize>(row: &[u8], levels: &mut [u8]) {
    let (groups, rest) = row.as_chunks::<{ 3 * PIXELS }>();
    let (grey_groups, grey_rest) = levels.as_chunks_mut::<PIXELS>();
    for (group, levels) in groups.iter().zip(grey_groups) {
        *levels = std::array::from_fn(|at| {
            luma_of(group[3 * at + RED], group[3 * at + 1], group[3 * at + BLUE])
        });
    }
    for (pixel, level) in rest.as_chunks::<3>().0.iter().zip(grey_rest) {
        *level = luma_of(pixel[RED], pixel[1], pixel[BLUE]);
    }
}

/// Returns (299 R + 587 G + 114 B) / 1000, rounded down.
fn luma_of(red: u8, green: u8, blue: u8) -> u8 {
    let thousandths = 299 * u32::from(red) + 587 * u32::from(green) + 114 * u32::from(blue);
    // Divides by 8 and then by 125, without the division that vectors lack: 33,555 / 2^22 exceeds
    // 1 / 125 by so little that no quotient of numbers up to 255,000 / 8 changes. No product
    // reaches 2^31.
    (((thousandths >> 3) * 33_555) >> 22) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn multiplication_and_shift_equal_division_for_every_sum() {
        for thousandths in 0..=255_000_u32 {
            assert_eq!(((thousandths >> 3) * 33_555) >> 22, thousandths / 1000);
        }
        assert_eq!(luma_of(255, 255, 255), 255);
        assert_eq!(luma_of(1, 1, 0), 0); // 0.886
    }

    #[test]
    fn white_does_not_overflow_in_the_longest_row() {
        use crate::data::Encoding;
        for encoding in [Encoding::Mono8, Encoding::Rgb8] {
            let white = vec![255; 3 * 65_535];
            let image = Image::new(65_535, 1, 3 * 65_535, encoding, &white).unwrap();
            assert_eq!(mean_luma(&image), 255.0);
        }
    }

    #[test]
    fn an_output_of_another_size_is_refused() {
        let image = Image::new(2, 1, 2, crate::data::Encoding::Mono8, &[1, 2]).unwrap();
        let refused = to_gray(&image, &mut [0; 3]).unwrap_err();
        assert_eq!(refused.to_string(), "the result takes 2 bytes; the output has 3");
    }
}
