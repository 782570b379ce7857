//! Counts the pixels of each grey level.

use super::luma::grey;
use super::{Colours, Image};

/// Pixels whose grey levels are computed at a time.
const PIECE: usize = 512;

/// Levels that one iteration of the loop counts.
const TURN: usize = 32;

/// Number of tables, which are used in turn: reading a counter right after writing it is slow.
const TABLES: usize = 4;

/// Returns the number of pixels at each grey level of [`to_gray`](super::luma::to_gray). The result
/// equals that of [`Frame::histogram`](crate::Frame::histogram).
pub fn histogram(image: &Image<'_>) -> [u32; 256] {
    // 65,535^2 pixels of one level still fit a `u32`.
    let mut tables = [[0_u32; 256]; TABLES];
    for row in image.rows() {
        if image.colours == Colours::Grey {
            count(row, &mut tables);
            continue;
        }
        let mut levels = [0; PIECE];
        for piece in row.chunks(PIECE * image.pixel()) {
            let levels = &mut levels[..piece.len() / image.pixel()];
            grey(image.colours, piece, levels);
            count(levels, &mut tables);
        }
    }
    std::array::from_fn(|level| tables.iter().map(|table| table[level]).sum())
}

fn count(levels: &[u8], tables: &mut [[u32; 256]; TABLES]) {
    let (turns, rest) = levels.as_chunks::<TURN>();
    for turn in turns {
        for (at, level) in turn.iter().enumerate() {
            let count = &mut tables[at % TABLES][usize::from(*level)];
            *count = count.wrapping_add(1);
        }
    }
    for level in rest {
        tables[0][usize::from(*level)] += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::Encoding;

    #[test]
    fn every_pixel_is_counted_once_at_its_level() {
        let levels = (0..1000_u32).map(|at| (at * at % 251) as u8).collect::<Vec<_>>();
        let image = Image::new(333, 3, 333, Encoding::Mono8, &levels).unwrap();
        let counts = histogram(&image);
        for (level, count) in counts.iter().enumerate() {
            let expected =
                levels[..999].iter().filter(|found| usize::from(**found) == level).count();
            assert_eq!(*count as usize, expected, "level {level}");
        }
    }
}
