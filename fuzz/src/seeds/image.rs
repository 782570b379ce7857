//! Seeds: small images in every common file variant, and pixels in every encoding.

use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use png::{BitDepth, ColorType as Png};

use crate::image::{ENCODINGS, mode};

/// Names of chunks and segments.
pub const WORDS: &[&str] = &[
    "IHDR",
    "PLTE",
    "IDAT",
    "IEND",
    "tRNS",
    "acTL",
    "fcTL",
    "fdAT",
    "iCCP",
    "tEXt",
    "zTXt",
    "eXIf",
    "JFIF\0",
    "Exif\0\0",
    "Adobe",
    "ICC_PROFILE\0",
    "MPF\0",
];

const SIDE: u16 = 12;

pub fn all() -> Vec<Vec<u8>> {
    let mut seeds = Vec::new();
    for sampling in [SamplingFactor::F_1_1, SamplingFactor::F_2_1, SamplingFactor::F_2_2] {
        seeds.extend([false, true].map(|progressive| jpeg(ColorType::Rgb, sampling, progressive)));
    }
    seeds.extend(
        [false, true].map(|progressive| jpeg(ColorType::Luma, SamplingFactor::F_1_1, progressive)),
    );
    for (colour, channels) in
        [(Png::Grayscale, 1), (Png::GrayscaleAlpha, 2), (Png::Rgb, 3), (Png::Rgba, 4)]
    {
        seeds.push(png(colour, BitDepth::Eight, channels));
    }
    seeds.push(png(Png::Grayscale, BitDepth::Sixteen, 2));
    seeds.push(png(Png::Indexed, BitDepth::Eight, 1));
    seeds.extend((0..ENCODINGS.len()).map(raw));
    seeds
}

/// Pixels that differ from their neighbours.
fn pixels(bytes_per_pixel: usize) -> Vec<u8> {
    (0..usize::from(SIDE).pow(2) * bytes_per_pixel).map(|at| (at * 7 % 251) as u8).collect()
}

fn jpeg(colour: ColorType, sampling: SamplingFactor, progressive: bool) -> Vec<u8> {
    let mut file = vec![mode::FILE];
    let mut encoder = Encoder::new(&mut file, 70);
    encoder.set_sampling_factor(sampling);
    encoder.set_progressive(progressive);
    let channels = if colour == ColorType::Luma { 1 } else { 3 };
    encoder
        .encode(&pixels(channels), SIDE, SIDE, colour)
        .expect("the number of pixels matches the size");
    file
}

fn png(colour: Png, depth: BitDepth, bytes_per_pixel: usize) -> Vec<u8> {
    let mut file = vec![mode::FILE];
    let mut encoder = png::Encoder::new(&mut file, SIDE.into(), SIDE.into());
    encoder.set_color(colour);
    encoder.set_depth(depth);
    if colour == Png::Indexed {
        encoder
            .set_palette((0..=255).flat_map(|level| [level, 255 - level, 7]).collect::<Vec<u8>>());
    }
    let mut writer = encoder.write_header().expect("writing to memory succeeds");
    writer
        .write_image_data(&pixels(bytes_per_pixel))
        .expect("the number of pixels matches the size");
    writer.finish().expect("writing to memory succeeds");
    file
}

fn raw(encoding: usize) -> Vec<u8> {
    let mut seed = vec![mode::RAW, encoding as u8];
    for number in [4_u16, 3, 16] {
        seed.extend(number.to_le_bytes());
    }
    seed.push(0);
    for number in [1_u16, 1, 2, 2] {
        seed.extend(number.to_le_bytes());
    }
    seed.extend([8, 2]);
    seed.extend((0..48).map(|at| at * 5));
    seed
}
