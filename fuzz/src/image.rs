//! Fuzzes images: compressed files that are decoded, and raw pixels that are processed.
//!
//! An input is a byte for the mode, and then either a JPEG or PNG file, or the fields of an image
//! and its pixels.

use gleaner_pixels::{
    Encoding, ImageError, MAX_SIDE, PixelError, Roi, StopCheck, View, decode, ops, probe,
    probe_message,
};

use crate::budget;
use crate::input::FuzzInput;

pub mod mode {
    /// A file follows.
    pub const FILE: u8 = 0;
    /// Encoding, width, height, step, byte order, a region and a new size follow, then pixels.
    pub const RAW: u8 = 1;
}

/// Limit on decoded bytes, as an input of a lambda has one.
const DECODED_MAX: usize = 1 << 20;

/// The names of all encodings.
pub const ENCODINGS: [&str; 16] = [
    "rgb8",
    "bgr8",
    "rgba8",
    "bgra8",
    "mono8",
    "mono16",
    "uyvy",
    "yuyv",
    "bayer_rggb8",
    "bayer_bggr8",
    "bayer_gbrg8",
    "bayer_grbg8",
    "bayer_rggb16",
    "bayer_bggr16",
    "bayer_gbrg16",
    "bayer_grbg16",
];

/// Decodes a file, or processes pixels. Returns whether the file could be decoded, or the pixels
/// are an image.
pub fn check(data: &[u8]) -> bool {
    let mut input = FuzzInput(data);
    match input.u8() {
        mode::RAW => raw(&mut input),
        _ => file(input.0),
    }
}

fn file(data: &[u8]) -> bool {
    for format in ["", "16UC1; compressedDepth png"] {
        let _ = budget::within(64 << 10, || probe_message(format, data).map(drop));
    }
    let Ok(header) = budget::within(64 << 10, || probe(data)) else { return false };
    let sides = 1..=MAX_SIDE;
    assert!(sides.contains(&header.width) && sides.contains(&header.height), "{header}");
    let len = header.rgb8_len().expect("this machine counts in 64 bits");
    assert_eq!(len as u64, 3 * u64::from(header.width) * u64::from(header.height));
    let to = |out: &mut [u8]| decode(data, &header, DECODED_MAX, out, &StopCheck::new(&|| true));
    if len > DECODED_MAX {
        let refused = budget::within(64 << 10, || to(&mut []));
        assert!(matches!(refused, Err(ImageError::Bomb { .. })), "{refused:?}");
        return false;
    }
    // The documented bound, plus small allocations.
    let memory = (4 << 20) + 4 * DECODED_MAX + 2 * data.len() + (256 << 10);
    let len = header.decoded_len().expect("as above");
    let decoded = |before: u8| {
        let mut out = vec![before; len];
        budget::within(memory, || to(&mut out)).map(|()| out)
    };
    let (first, second) = (decoded(0xaa), decoded(0x55));
    let valid = first.is_ok();
    match (first, second) {
        (Ok(first), Ok(second)) => {
            assert!(first == second, "{header}: pixels of an earlier image remain")
        }
        (Err(_), Err(_)) => {}
        (first, second) => panic!("{header}: {:?}, then {:?}", first.err(), second.err()),
    }
    let mut short = vec![0; len - 1];
    assert!(matches!(to(&mut short), Err(ImageError::Pixels(PixelError::Output { .. }))));
    valid
}

fn raw(input: &mut FuzzInput) -> bool {
    let encoding = ENCODINGS[usize::from(input.u8()) % ENCODINGS.len()];
    let encoding = Encoding::from_ros(encoding).expect("these are names of ROS");
    let (width, height, step) = (input.u16(), input.u16(), input.u16());
    let big_endian = input.u8() & 1 == 1;
    let [x, y, wide, high] = std::array::from_fn(|_| u32::from(input.u16()));
    let roi = Roi { x, y, width: wide, height: high };
    let to = (u32::from(input.u8()), u32::from(input.u8()));
    let view = View::new(width.into(), height.into(), step.into(), encoding, big_endian, input.0);
    let Ok(view) = view else { return false };
    let rows = (0..view.height()).map(|y| view.row(y).len());
    assert_eq!(
        rows.sum::<usize>(),
        usize::from(width) * usize::from(height) * encoding.bytes_per_pixel()
    );
    assert!(view.row(view.height()).is_empty());
    if encoding.is_raw() {
        assert!(ops::mean_luma(&view, None).is_err() && ops::resized(&view, 1, 1).is_err());
        return true;
    }
    budget::within(4 << 20, || {
        grey(&view, None);
        grey(&view, Some(roi));
        resize(&view, to);
        resize(&view, (view.width(), view.height()));
    });
    true
}

/// Checks histogram and mean luma of a region against its grey pixels.
fn grey(view: &View, roi: Option<Roi>) {
    let Ok(inside) = view.clip(roi) else {
        assert!(ops::histogram(view, roi).is_err() && ops::mean_luma(view, roi).is_err());
        return;
    };
    assert!(inside.x + inside.width <= view.width() && inside.y + inside.height <= view.height());
    let counts = ops::histogram(view, roi).expect("the region has pixels");
    let mut grey = vec![0; view.width() as usize * view.height() as usize];
    ops::to_gray(view, &mut grey).expect("the buffer is as large as the image");
    let mut expected = [0_u32; 256];
    let rows = grey
        .chunks_exact(view.width() as usize)
        .skip(inside.y as usize)
        .take(inside.height as usize);
    for level in rows.flat_map(|row| &row[inside.x as usize..][..inside.width as usize]) {
        expected[usize::from(*level)] += 1;
    }
    assert_eq!(counts, expected, "histogram and grey image of {inside:?}");
    let luma = ops::mean_luma(view, roi).expect("the region has pixels");
    let sum: f64 =
        counts.iter().zip(0_u32..).map(|(count, level)| f64::from(*count) * f64::from(level)).sum();
    let pixels = f64::from(inside.width) * f64::from(inside.height);
    // A level of the grey image is rounded, by at most one in each pixel.
    assert!(
        (0.0..=255.0).contains(&luma) && (luma - sum / pixels).abs() <= 1.0,
        "{luma}, not {}",
        sum / pixels
    );
}

fn resize(view: &View, (width, height): (u32, u32)) {
    let Ok((encoding, len)) = ops::resized(view, width, height) else { return };
    assert_eq!(len, width as usize * height as usize * encoding.bytes_per_pixel());
    let mut out = vec![0; len];
    assert_eq!(
        ops::resize(view, width, height, &mut out).expect("size and buffer are right"),
        encoding
    );
    let unchanged = view.encoding() == encoding && (width, height) == (view.width(), view.height());
    if unchanged {
        assert!(
            (0..height).flat_map(|y| view.row(y)).eq(&out),
            "an image of the same size has other pixels"
        );
    }
}
