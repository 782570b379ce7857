//! Valid image messages: raw ones in four encodings, and four compressed files.

use gleaner_messages::CdrWriter;
use jpeg_encoder::{ColorType, Encoder};

const WIDTH: u16 = 64;
const HEIGHT: u16 = 48;

pub(super) fn raw() -> Vec<Vec<u8>> {
    let encodings = [("rgb8", 3), ("mono16", 2), ("yuv422", 2), ("bayer_rggb8", 1)];
    let image = |(encoding, bytes)| {
        let step = u32::from(WIDTH) * bytes;
        let mut cdr = CdrWriter::new();
        cdr.time(5_000_000_007)
            .string("camera")
            .u32(HEIGHT.into())
            .u32(WIDTH.into())
            .string(encoding)
            .u8(0)
            .u32(step);
        with_bytes(cdr, &pixels(bytes as usize))
    };
    encodings.map(image).into()
}

pub(super) fn coded() -> Vec<Vec<u8>> {
    let (rgb, progressive) = (jpeg(ColorType::Rgb, 3, false), jpeg(ColorType::Rgb, 3, true));
    let files = [
        ("jpeg", rgb),
        ("jpeg", progressive),
        ("jpeg", jpeg(ColorType::Luma, 1, false)),
        ("png", png()),
    ];
    let image = |(format, file): (&str, Vec<u8>)| {
        let mut cdr = CdrWriter::new();
        cdr.time(5_000_000_007).string("camera").string(format);
        with_bytes(cdr, &file)
    };
    files.map(image).into()
}

fn with_bytes(mut cdr: CdrWriter, bytes: &[u8]) -> Vec<u8> {
    cdr.u32(bytes.len() as u32);
    [cdr.bytes(), bytes].concat()
}

/// Pixels that differ from their neighbours.
fn pixels(bytes_per_pixel: usize) -> Vec<u8> {
    (0..usize::from(WIDTH) * usize::from(HEIGHT) * bytes_per_pixel)
        .map(|n| (n * 7 + n / 11) as u8)
        .collect()
}

fn jpeg(colour: ColorType, bytes_per_pixel: usize, progressive: bool) -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = Encoder::new(&mut file, 80);
    encoder.set_progressive(progressive);
    encoder
        .encode(&pixels(bytes_per_pixel), WIDTH, HEIGHT, colour)
        .expect("the number of pixels matches the size");
    file
}

fn png() -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, WIDTH.into(), HEIGHT.into());
    encoder.set_color(png::ColorType::Rgb);
    let mut writer = encoder.write_header().expect("memory takes what is written to it");
    writer.write_image_data(&pixels(3)).expect("the number of pixels matches the size");
    writer.finish().expect("memory takes what is written to it");
    file
}
