//! How bright pixels are.

use std::hint::black_box;

use super::{Colours, Image, ImageError};

/// Byte positions that are summed side by side: whole pixels of 1 and 3 bytes, and whole vectors of
/// 16.
const LANES: usize = 48;

/// Bytes that are summed in a turn of the loop: four for each lane. An array of arrays, so that the
/// distance of each vector from the first stands in the instruction that loads it.
type Turn = [[u8; LANES]; 4];

/// Turns after which sums of 16 bits must be emptied: 64 * 4 * 255 = 65,280.
const TURNS: usize = 64;

/// Pixels of one turn in [`grey`].
const PIXELS: usize = 32;

/// Mean luma, 0 to 255: what [`Frame::mean_luma`](crate::Frame::mean_luma) says, bit for bit.
///
/// Luma is (299 R + 587 G + 114 B) / 1000, and the value itself for mono8. The sums are exact and
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

/// Sum of each byte of a pixel over the image, in their order; of a grey one, the first alone.
pub(super) fn sums(image: &Image<'_>) -> [u64; 3] {
    let mut lanes = [0; LANES];
    if image.step == image.width * image.pixel() {
        // Without padding all rows are one, and sums are emptied less often.
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

/// Sums of at most [`TURNS`] turns. By itself, since together with what surrounds it the compiler
/// finds no vectors in it.
///
/// Two bytes at a time are a number of 16 bits: the upper bytes are summed, and the whole numbers.
/// What the upper bytes make of the latter is taken off at the end; modulo 2^16, since that sum
/// wraps. A checked addition would not become a vector's.
#[inline(never)]
fn short_sums(turns: &[Turn]) -> [u16; LANES] {
    let mut whole = [0_u16; LANES / 2];
    let mut upper = [0_u16; LANES / 2];
    for turn in turns {
        // Or some compilers sum over turns instead, and gather single bytes for that. It changes no
        // result.
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

/// Writes the image as mono8 to `out`, without padding, width * height bytes: what
/// [`Frame::to_gray`](crate::Frame::to_gray) makes, byte for byte. A grey level is the luma of
/// [`mean_luma`], rounded down.
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

/// Writes the grey level of each pixel in `row` to `levels`, which has a byte for each.
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

/// (299 R + 587 G + 114 B) / 1000, rounded down.
fn luma_of(red: u8, green: u8, blue: u8) -> u8 {
    let thousandths = 299 * u32::from(red) + 587 * u32::from(green) + 114 * u32::from(blue);
    // A division by 8 and one by 125, as vectors have none: 33,555 / 2^22 exceeds 1 / 125 by so
    // little that no quotient of numbers up to 255,000 / 8 changes. No product reaches 2^31.
    (((thousandths >> 3) * 33_555) >> 22) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sum_of_weights_is_divided_as_by_division() {
        for thousandths in 0..=255_000_u32 {
            assert_eq!(((thousandths >> 3) * 33_555) >> 22, thousandths / 1000);
        }
        assert_eq!(luma_of(255, 255, 255), 255);
        assert_eq!(luma_of(1, 1, 0), 0); // 0.886
    }

    #[test]
    fn white_does_not_overflow_however_long_a_row_is() {
        use crate::data::Encoding;
        for encoding in [Encoding::Mono8, Encoding::Rgb8] {
            let white = vec![255; 3 * 65_535];
            let image = Image::new(65_535, 1, 3 * 65_535, encoding, &white).unwrap();
            assert_eq!(mean_luma(&image), 255.0);
        }
    }

    #[test]
    fn a_place_of_another_size_is_refused() {
        let image = Image::new(2, 1, 2, crate::data::Encoding::Mono8, &[1, 2]).unwrap();
        let refused = to_gray(&image, &mut [0; 3]).unwrap_err();
        assert_eq!(refused.to_string(), "the result takes 2 bytes; the place for it has 3");
    }
}
