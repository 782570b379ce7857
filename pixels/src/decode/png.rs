//! Decodes PNG: the crate `png` returns rows one by one, which become rgb8 or mono16.

use std::io::{Cursor, ErrorKind};

use gleaner_rules::pixels::{Encoding, StopCheck, check_size};
use png::{BitDepth, ColorType, Decoder, DecodingError, InterlaceInfo, Limits, Transformations};

use super::{Format, ImageError, ImageHeader};

pub(super) const MAGIC: [u8; 8] = *b"\x89PNG\r\n\x1a\n";

/// Colour type of grey pixels without alpha, in the header.
const GREY: u8 = 0;

/// Returns the header of `data`, which starts with [`MAGIC`].
pub(super) fn header(data: &[u8]) -> Result<ImageHeader, ImageError> {
    let Some((chunk, _)) = data.get(MAGIC.len()..).and_then(|rest| rest.split_first_chunk::<18>())
    else {
        return Err(truncated(data));
    };
    let [start @ .., w3, w2, w1, w0, h3, h2, h1, h0, depth, color] = chunk;
    if start != b"\0\0\0\x0dIHDR" {
        return Err(damaged(MAGIC.len(), "no header where one is required"));
    }
    let width = u32::from_be_bytes([*w3, *w2, *w1, *w0]);
    let height = u32::from_be_bytes([*h3, *h2, *h1, *h0]);
    check_size(width, height)?;
    let format = Format::Png;
    let encoding = match (*depth, *color) {
        (16, GREY) => Encoding::Mono16,
        (16, _) => {
            let what = "of 16 bits per value with colour or alpha";
            return Err(ImageError::Unsupported { format, what });
        }
        _ => Encoding::Rgb8,
    };
    Ok(ImageHeader { format, width, height, encoding })
}

/// Decodes `data` into `out`, which has the length that `header` requires, with at most `allowed`
/// bytes of memory for chunks. The decoder holds a few rows of at most 8 bytes per pixel, so it
/// needs no more.
pub(super) fn decode(
    data: &[u8],
    header: &ImageHeader,
    allowed: usize,
    out: &mut [u8],
    pace: &StopCheck<'_>,
) -> Result<(), ImageError> {
    let &ImageHeader { width, height, encoding, .. } = header;
    let refused = |cause| match cause {
        DecodingError::IoError(error) if error.kind() == ErrorKind::UnexpectedEof => {
            truncated(data)
        }
        cause => ImageError::Png { width, height, cause },
    };
    let mut decoder = Decoder::new_with_limits(Cursor::new(data), Limits { bytes: allowed });
    if encoding == Encoding::Rgb8 {
        // 8 bits per value, and colours instead of palette indices.
        decoder.set_transformations(Transformations::normalize_to_color8());
    }
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let mut reader = decoder.read_info().map_err(refused)?;
    let color = reader.output_color_type();
    let pixel = encoding.bytes_per_pixel();
    let stride = pixel * width as usize;
    // Both parsers must read the same header.
    let len = match reader.output_line_size(width) {
        Some(len) if reader.info().size() == (width, height) => len,
        _ => return Err(damaged(MAGIC.len(), "its header is ambiguous")),
    };
    let mut line = vec![0; len];
    let mut pixels = vec![0; stride];
    let mut rows = 0;
    while let Some(interlace) = reader.read_row(&mut line).map_err(refused)? {
        // Inflating takes several times as long as other work on as many bytes.
        pace.check(8 * stride)?;
        match interlace {
            InterlaceInfo::Null(_) => {
                let Some(row) = out.chunks_exact_mut(stride).nth(rows) else {
                    break;
                };
                convert(color, &line, row);
                rows += 1;
            }
            InterlaceInfo::Adam7(pass) => {
                convert(color, &line, &mut pixels);
                png::expand_interlaced_row(out, stride, &pixels, &pass, 8 * pixel as u8);
            }
        }
    }
    // The checksums of the last chunks are checked, too.
    reader.finish().map_err(refused)
}

/// Converts the pixels of `line` to rgb8, or those of 16 bits, which are grey, to little-endian.
fn convert((color, depth): (ColorType, BitDepth), line: &[u8], out: &mut [u8]) {
    if depth == BitDepth::Sixteen {
        return each::<2, 2>(line, out, |pixel| [pixel[1], pixel[0]]);
    }
    match color {
        ColorType::Grayscale => each::<1, 3>(line, out, |pixel| [pixel[0]; 3]),
        ColorType::GrayscaleAlpha => each::<2, 3>(line, out, |pixel| [pixel[0]; 3]),
        ColorType::Rgb | ColorType::Indexed => each::<3, 3>(line, out, |pixel| *pixel),
        ColorType::Rgba => each::<4, 3>(line, out, |pixel| [pixel[0], pixel[1], pixel[2]]),
    }
}

/// Converts each pixel of `FROM` bytes to one of `TO` bytes.
fn each<const FROM: usize, const TO: usize>(
    line: &[u8],
    out: &mut [u8],
    converted: impl Fn(&[u8; FROM]) -> [u8; TO],
) {
    for (out, pixel) in out.as_chunks_mut::<TO>().0.iter_mut().zip(line.as_chunks::<FROM>().0) {
        *out = converted(pixel);
    }
}

fn truncated(data: &[u8]) -> ImageError {
    ImageError::Truncated { format: Format::Png, len: data.len() }
}

fn damaged(at: usize, what: &'static str) -> ImageError {
    ImageError::Damaged { format: Format::Png, at, what }
}

#[cfg(test)]
mod tests {
    use png::{BitDepth, Encoder};

    use gleaner_rules::pixels::PixelError;

    use super::*;
    use crate::decode::samples::{self, HEIGHT, WIDTH, colour};
    use crate::decode::tests::{NOT_SUPPORTED, assert_close, decoded, rgb8_header};
    use crate::decode::{decode_rgb8, probe};

    static PALETTE: [u8; 9] = [1, 2, 3, 40, 50, 60, 255, 254, 253];

    /// Encodes a PNG of `WIDTH` x `HEIGHT` pixels.
    fn png(color: ColorType, depth: BitDepth, data: &[u8]) -> Vec<u8> {
        let mut file = Vec::new();
        let mut encoder = Encoder::new(&mut file, WIDTH, HEIGHT);
        encoder.set_color(color);
        encoder.set_depth(depth);
        if color == ColorType::Indexed {
            encoder.set_palette(&PALETTE[..]);
        }
        let mut writer = encoder.write_header().unwrap();
        writer.write_image_data(data).unwrap();
        writer.finish().unwrap();
        file
    }

    fn pixels<const N: usize>(of: impl Fn(usize, usize) -> [u8; N]) -> Vec<u8> {
        let (width, height) = (WIDTH as usize, HEIGHT as usize);
        (0..width * height).flat_map(|at| of(at % width, at / width)).collect()
    }

    #[test]
    fn a_png_of_any_kind_of_8_bits_becomes_rgb8() {
        use BitDepth::{Eight, Four, One};
        let full = |value: u8| [value, 0x55];
        let rgba = |x, y| {
            let [r, g, b] = colour(x, y);
            [r, g, b, x as u8]
        };
        let red = |x, y| colour(x, y)[0];
        let grey = |x, y| [red(x, y); 3];
        type Expected<'a> = &'a dyn Fn(usize, usize) -> [u8; 3];
        let cases: [(ColorType, BitDepth, Vec<u8>, Expected<'_>); 6] = [
            (ColorType::Rgb, Eight, pixels(colour), &colour),
            (ColorType::Rgba, Eight, pixels(rgba), &colour),
            (ColorType::Grayscale, Eight, pixels(|x, y| [red(x, y)]), &grey),
            (ColorType::GrayscaleAlpha, Eight, pixels(|x, y| full(red(x, y))), &grey),
            // 0101… and 0 to 15, 0 to 15: eight and two pixels per byte.
            (ColorType::Grayscale, One, vec![0x55; 48], &|x, _| [(x % 2 * 255) as u8; 3]),
            (ColorType::Grayscale, Four, (0..192).map(|at| (at % 12) as u8).collect(), &|x, _| {
                [(x % 2 * (x / 2) * 17) as u8; 3]
            }),
        ];
        for (color, depth, data, expected) in cases {
            let file = png(color, depth, &data);
            assert_eq!(probe(&file).unwrap(), rgb8_header(Format::Png));
            assert_close(&decoded(&file).unwrap(), 0, expected);
        }
    }

    #[test]
    fn a_grey_png_of_16_bits_keeps_them_and_others_are_refused() {
        for file in [samples::DEPTH, samples::DEPTH_INTERLACED] {
            let header = probe(file).unwrap();
            assert_eq!((header.encoding, header.decoded_len()), (Encoding::Mono16, Some(16)));
            let values = samples::DEPTH_VALUES.map(u16::to_le_bytes).concat();
            assert_eq!(decoded(file).unwrap(), values);
            let error = decode_rgb8(file, &header, 24, &mut [0; 24]).unwrap_err().to_string();
            assert!(error.contains("of 16 bits per value where 8 are needed"), "{error}");
        }
        for (color, bytes) in
            [(ColorType::Rgb, 6), (ColorType::Rgba, 8), (ColorType::GrayscaleAlpha, 4)]
        {
            let data = vec![7; bytes * (WIDTH * HEIGHT) as usize];
            assert_eq!(
                probe(&png(color, BitDepth::Sixteen, &data)).unwrap_err().to_string(),
                format!("PNG is of 16 bits per value with colour or alpha, {NOT_SUPPORTED}")
            );
        }
    }

    #[test]
    fn a_png_with_a_palette_becomes_its_colours() {
        let data = pixels(|x, y| [((x + y) % 3) as u8]);
        let file = png(ColorType::Indexed, BitDepth::Eight, &data);
        assert_close(&decoded(&file).unwrap(), 0, |x, y| {
            let at = (x + y) % 3 * 3;
            [PALETTE[at], PALETTE[at + 1], PALETTE[at + 2]]
        });
    }

    #[test]
    fn an_interlaced_png_is_decoded() {
        assert_close(&decoded(samples::INTERLACED).unwrap(), 0, colour);
    }

    #[test]
    fn a_png_truncated_anywhere_is_refused() {
        for file in [&png(ColorType::Rgb, BitDepth::Eight, &pixels(colour)), samples::INTERLACED] {
            for len in 0..file.len() {
                let error = decoded(&file[..len]).unwrap_err();
                let expected = if len < 8 { "NotAnImage" } else { "Truncated" };
                assert!(format!("{error:?}").starts_with(expected), "{len}: {error:?}");
            }
        }
    }

    #[test]
    fn a_png_with_any_pixel_byte_changed_is_refused() {
        let file = png(ColorType::Rgb, BitDepth::Eight, &pixels(colour));
        let start = file.windows(4).position(|name| name == b"IDAT").unwrap();
        for at in start + 4..file.len() {
            let mut changed = file.clone();
            changed[at] ^= 0x10;
            assert!(decoded(&changed).is_err(), "byte {at}");
        }
    }

    #[test]
    fn a_png_bomb_is_refused_before_memory_is_touched() {
        let mut bomb = png(ColorType::Rgb, BitDepth::Eight, &pixels(colour));
        bomb[16..24].copy_from_slice(&[0, 0, 0xff, 0xff, 0, 0, 0xff, 0xff]);
        let header = probe(&bomb).unwrap();
        let error = decode_rgb8(&bomb, &header, 1 << 20, &mut []).unwrap_err();
        assert!(matches!(error, ImageError::Bomb { needed: 12_884_508_675, .. }), "{error}");
        bomb[16] = 0x80;
        assert!(matches!(probe(&bomb), Err(ImageError::Pixels(PixelError::Size { .. }))));
        bomb[12] = b'X';
        assert!(matches!(probe(&bomb), Err(ImageError::Damaged { .. })));
    }
}
