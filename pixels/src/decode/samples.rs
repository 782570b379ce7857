//! Tiny image files. The JPEGs were written by Pillow (libjpeg-turbo) at quality 90, so that the
//! decoder is tested against another implementation. Colour images are 24x16 pixels of [`colour`].

pub(super) const WIDTH: u32 = 24;

pub(super) const HEIGHT: u32 = 16;

/// Returns the colour of a pixel before encoding.
pub(super) fn colour(x: usize, y: usize) -> [u8; 3] {
    [80 + 4 * x, 60 + 5 * y, 200 - 3 * x - 2 * y].map(|value| value as u8)
}

/// Baseline, 4:2:0.
pub(super) const BASELINE: &[u8] = include_bytes!("../../tests/data/baseline.jpg");

/// The pixels of [`BASELINE`], encoded with the Huffman tables of ITU-T T.81, annex K.3.
pub(super) const STANDARD_SCAN: &[u8] = include_bytes!("../../tests/data/standard_scan.bin");

/// Progressive, 4:2:2, ten scans.
pub(super) const PROGRESSIVE: &[u8] = include_bytes!("../../tests/data/progressive.jpg");

/// Baseline, grey: only the red of [`colour`].
pub(super) const GREY: &[u8] = include_bytes!("../../tests/data/grey.jpg");

/// Baseline, 8x8, four components.
pub(super) const CMYK: &[u8] = include_bytes!("../../tests/data/cmyk.jpg");

/// PNG of 8 bits per value, interlaced (Adam7), which the encoder of `png` cannot write.
pub(super) const INTERLACED: &[u8] = include_bytes!("../../tests/data/interlaced.png");

/// The values of [`DEPTH`], row by row.
pub(super) const DEPTH_VALUES: [u16; 8] = [0, 1, 255, 256, 1_000, 2_308, 40_000, 65_535];

/// PNG of 16-bit grey, 4x2 pixels, by Pillow.
pub(super) const DEPTH: &[u8] = include_bytes!("../../tests/data/depth.png");

/// As [`DEPTH`], interlaced; Pillow reads the same values.
pub(super) const DEPTH_INTERLACED: &[u8] = include_bytes!("../../tests/data/depth_interlaced.png");
