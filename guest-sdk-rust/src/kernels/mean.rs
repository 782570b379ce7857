//! Computes mean values of numbers and of the colours of an image.

use std::hint::black_box;

use super::luma::sums;
use super::{Colours, Image};

/// Number of parallel sums.
const LANES: usize = 16;

/// Groups of values, one for each sum, that one iteration of the loop adds.
const GROUPS: usize = 8;

/// The values of one iteration. An array of arrays, so that the offset of each vector is an
/// immediate of its load instruction.
type SumBlock<T> = [[[T; 2]; LANES / 2]; GROUPS];

/// Returns the arithmetic mean of `values`, of any number type that fits an `f64`, in the unit of
/// the values; none if there are none.
///
/// Sixteen parallel sums are added up in a fixed order, so the result is the same on every machine.
/// It may differ in its last bits from a sum from left to right, such as
/// [`Column::mean`](crate::Column::mean), and is more exact.
pub fn mean<T: Copy + Into<f64>>(values: &[T]) -> Option<f64> {
    let turns: &[SumBlock<T>] = values.as_chunks().0.as_chunks().0.as_chunks().0;
    let mut lanes = long_sums(turns);
    for group in values[turns.len() * GROUPS * LANES..].chunks(LANES) {
        for (lane, value) in lanes.iter_mut().zip(group) {
            *lane += (*value).into();
        }
    }
    (!values.is_empty()).then(|| lanes.iter().sum::<f64>() / values.len() as f64)
}

/// Returns the sums of every sixteenth value. Not inlined, since the compiler does not vectorise it
/// inside of its caller.
///
/// The sums stay in memory. In a component, additions happen only where their result is needed: in
/// registers, that would be after the last load, and most loaded values would go through the stack.
#[inline(never)]
fn long_sums<T: Copy + Into<f64>>(turns: &[SumBlock<T>]) -> [f64; LANES] {
    let mut lanes = [[0.0_f64; 2]; LANES / 2];
    for turn in turns {
        let [a, b, c, d, e, f, g, h] = black_box(&mut lanes);
        add_pairs::<T, 0>(turn, a);
        add_pairs::<T, 1>(turn, b);
        add_pairs::<T, 2>(turn, c);
        add_pairs::<T, 3>(turn, d);
        add_pairs::<T, 4>(turn, e);
        add_pairs::<T, 5>(turn, f);
        add_pairs::<T, 6>(turn, g);
        add_pairs::<T, 7>(turn, h);
    }
    std::array::from_fn(|lane| lanes.as_flattened()[lane])
}

#[inline(always)]
fn add_pairs<T: Copy + Into<f64>, const AT: usize>(turn: &SumBlock<T>, lanes: &mut [f64; 2]) {
    let [mut even, mut odd] = *lanes;
    for group in turn {
        let [first, second] = group[AT].map(Into::into);
        even += first;
        odd += second;
    }
    *lanes = [even, odd];
}

/// Returns the means of red, green and blue, each 0 to 255; for a mono8 image, three times the mean
/// grey level. The sums are exact.
pub fn mean_rgb(image: &Image<'_>) -> [f64; 3] {
    let count = (image.width * image.height) as f64;
    let [first, second, third] = sums(image).map(|sum| sum as f64 / count);
    match image.colours {
        Colours::Grey => [first; 3],
        Colours::Rgb => [first, second, third],
        Colours::Bgr => [third, second, first],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::Encoding;

    #[test]
    fn the_mean_includes_all_values_for_any_count() {
        for count in 1..300_i32 {
            // 1 + 2 + ... + n = n (n + 1) / 2
            let expected = Some(f64::from(count + 1) / 2.0);
            assert_eq!(mean(&(1..=count).map(f64::from).collect::<Vec<_>>()), expected);
            assert_eq!(mean(&(1..=count as u16).collect::<Vec<_>>()), expected);
        }
        assert_eq!(mean::<f32>(&[]), None);
    }

    #[test]
    fn colours_are_in_the_order_of_the_encoding() {
        let pixels = [1, 2, 3, 5, 6, 7];
        let image = |encoding| Image::new(2, 1, 6, encoding, &pixels).unwrap();
        assert_eq!(mean_rgb(&image(Encoding::Rgb8)), [3.0, 4.0, 5.0]);
        assert_eq!(mean_rgb(&image(Encoding::Bgr8)), [5.0, 4.0, 3.0]);
        assert_eq!(mean_rgb(&image(Encoding::Mono8)), [1.5; 3]);
    }
}
