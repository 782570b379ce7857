//! Tests the results of whole, broken and hostile files.

use super::samples::{
    BASELINE, CMYK, DEPTH_INTERLACED, GREY, HEIGHT, INTERLACED, PROGRESSIVE, STANDARD_SCAN, WIDTH,
    colour,
};
use super::*;

/// End of the error of a kind of file that is not decoded.
pub(super) const NOT_SUPPORTED: &str =
    "which is not supported: publish baseline JPEG, or PNG of 8 bits";

/// Decodes `data` in the two steps that the host takes.
pub(super) fn decoded(data: &[u8]) -> Result<Vec<u8>, ImageError> {
    let header = probe(data)?;
    let len = header.decoded_len().unwrap();
    // Filled, so that pixels which are not written are noticed.
    let mut out = vec![0xaa; len];
    let max_bytes = header.rgb8_len().unwrap();
    decode(data, &header, max_bytes, &mut out, &StopCheck::new(&|| true))?;
    Ok(out)
}

/// Checks that every pixel of `rgb` is within `tolerance` of its `expected` value.
pub(super) fn assert_close(rgb: &[u8], tolerance: u8, expected: impl Fn(usize, usize) -> [u8; 3]) {
    for (at, pixel) in rgb.chunks(3).enumerate() {
        let (x, y) = (at % WIDTH as usize, at / WIDTH as usize);
        for (found, wanted) in pixel.iter().zip(expected(x, y)) {
            assert!(found.abs_diff(wanted) <= tolerance, "({x}, {y}): {found}, not {wanted}");
        }
    }
}

pub(super) fn rgb8_header(format: Format) -> ImageHeader {
    ImageHeader { format, width: WIDTH, height: HEIGHT, encoding: Encoding::Rgb8 }
}

#[test]
fn decoding_stops_when_its_caller_requests_it() {
    for file in [BASELINE, PROGRESSIVE, GREY, INTERLACED] {
        let header = probe(file).unwrap();
        let mut out = vec![0; header.rgb8_len().unwrap()];
        let mut decode = |may_go_on: &dyn Fn() -> bool| {
            super::decode(file, &header, 1 << 20, &mut out, &StopCheck::new(may_go_on))
                .map(|()| out.clone())
        };
        let stopped = decode(&|| false);
        assert!(
            matches!(stopped, Err(ImageError::Pixels(PixelError::Stopped))),
            "{header}: {stopped:?}"
        );
        assert_eq!(decode(&|| true).unwrap(), decoded(file).unwrap(), "{header}");
    }
}

#[test]
fn a_jpeg_decodes_to_the_encoded_colours() {
    for file in [BASELINE, PROGRESSIVE] {
        let header = rgb8_header(Format::Jpeg);
        assert_eq!(probe(file).unwrap(), header);
        // Pillow decodes them with errors of up to 6, and differs from this decoder by up to 2.
        assert_close(&decoded(file).unwrap(), 8, colour);
    }
}

#[test]
fn a_grey_jpeg_becomes_equal_red_green_and_blue() {
    assert_close(&decoded(GREY).unwrap(), 2, |x, y| [colour(x, y)[0]; 3]);
}

#[test]
fn a_jpeg_for_print_is_refused() {
    assert_eq!(
        probe(CMYK).unwrap_err().to_string(),
        format!("JPEG is neither grey nor of three components (CMYK?), {NOT_SUPPORTED}")
    );
}

#[test]
fn a_jpeg_truncated_anywhere_is_refused() {
    for file in [BASELINE, PROGRESSIVE, GREY] {
        for len in 0..file.len() {
            let error = decoded(&file[..len]).unwrap_err();
            let expected = if len < 3 { "NotAnImage" } else { "Truncated" };
            assert!(format!("{error:?}").starts_with(expected), "{len}: {error:?}");
        }
    }
    assert_eq!(
        decoded(&BASELINE[..300]).unwrap_err().to_string(),
        "JPEG is truncated: its 300 bytes end before the image does"
    );
}

#[test]
fn bytes_after_the_end_of_a_jpeg_are_ignored() {
    let mut padded = BASELINE.to_vec();
    padded.extend([0; 100]);
    assert_eq!(decoded(&padded).unwrap(), decoded(BASELINE).unwrap());
}

fn first(file: &[u8], marker: u8) -> usize {
    file.windows(2).position(|pair| pair == [0xff, marker]).unwrap()
}

/// Returns `file` with `replacement` for the bytes after the first marker `marker`.
fn patched(file: &[u8], marker: u8, replacement: &[u8]) -> Vec<u8> {
    let at = first(file, marker) + 2;
    let mut file = file.to_vec();
    file[at..at + replacement.len()].copy_from_slice(replacement);
    file
}

#[test]
fn a_bomb_is_refused_before_memory_is_touched() {
    let bomb = patched(BASELINE, 0xc0, &[0, 17, 8, 0xff, 0xdc, 0xff, 0xdc]);
    let header = probe(&bomb).unwrap();
    assert_eq!(
        decode_rgb8(&bomb, &header, 8 << 20, &mut []).unwrap_err().to_string(),
        "image has a size of 65500x65500 (12274.6 MiB as rgb8); this input's decoded_size is 8 MiB"
    );
}

#[test]
fn a_bomb_for_the_decoder_itself_is_refused() {
    // Small as rgb8, but 32 rows of blocks high where the factors are 4.
    let thin = patched(PROGRESSIVE, 0xc2, &[0, 17, 8, 0, 1, 0xff, 0xff, 3, 1, 0x44]);
    let header = probe(&thin).unwrap();
    let mut out = vec![0; header.rgb8_len().unwrap()];
    let message = decode_rgb8(&thin, &header, out.len(), &mut out).unwrap_err().to_string();
    assert!(message.starts_with("JPEG of 65535x1 needs "), "{message}");
    assert!(message.ends_with("to decode, besides its pixels; 4.7 MiB is allowed"), "{message}");
}

#[test]
fn a_limit_of_exactly_the_size_is_sufficient() {
    let header = probe(BASELINE).unwrap();
    let len = header.rgb8_len().unwrap();
    let mut out = vec![0; len];
    let mut decode = |max_bytes| decode_rgb8(BASELINE, &header, max_bytes, &mut out);
    assert!(decode(len).is_ok());
    assert_eq!(
        decode(len - 1).unwrap_err().to_string(),
        "image has a size of 24x16 (1152 bytes as rgb8); this input's decoded_size is 1151 bytes"
    );
}

#[test]
fn the_header_must_match_the_data_and_the_output_length_the_header() {
    let header = probe(GREY).unwrap();
    let other = ImageHeader { width: 23, ..header };
    assert_eq!(
        decode_rgb8(GREY, &other, 9_999, &mut [0; 1104]).unwrap_err().to_string(),
        "JPEG of 24x16 where a JPEG of 23x16 was expected"
    );
    assert_eq!(
        decode_rgb8(GREY, &header, 9_999, &mut [0; 1151]).unwrap_err().to_string(),
        "decoding needs 1152 bytes; the output has 1151"
    );
}

#[test]
fn kinds_of_jpeg_that_cameras_do_not_send_are_named() {
    for (marker, kind) in [(0xc3, "lossless"), (0xc5, "hierarchical"), (0xc9, "arithmetic-coded")] {
        let mut file = BASELINE.to_vec();
        let at = first(&file, 0xc0);
        file[at + 1] = marker;
        assert_eq!(
            probe(&file).unwrap_err().to_string(),
            format!("JPEG is {kind}, {NOT_SUPPORTED}")
        );
    }
    let twelve = patched(BASELINE, 0xc0, &[0, 17, 12]);
    assert!(matches!(probe(&twelve), Err(ImageError::Unsupported { .. })));
    let no_height = patched(BASELINE, 0xc0, &[0, 17, 8, 0, 0]);
    assert!(matches!(
        probe(&no_height),
        Err(ImageError::Pixels(PixelError::Size { width: 24, height: 0 }))
    ));
}

#[test]
fn a_jpeg_with_endless_scans_is_refused() {
    // The scans of an image, repeated: cheap to send, expensive to decode.
    for file in [BASELINE, PROGRESSIVE] {
        let (start, scans) = file[..file.len() - 2].split_at(first(file, 0xda));
        let mut endless = start.to_vec();
        for _ in 0..70 {
            endless.extend(scans);
        }
        endless.extend([0xff, 0xd9]);
        let error = decoded(&endless).unwrap_err().to_string();
        assert!(error.starts_with("JPEG is damaged at byte "), "{error}");
        assert!(error.ends_with("more scans than such an image can need"), "{error}");
    }
}

#[test]
fn a_jpeg_without_huffman_tables_has_the_pixels_of_the_one_with_them() {
    let head = &BASELINE[..first(BASELINE, 0xc4)];
    let mjpeg = [head, STANDARD_SCAN].concat();
    let rgb = decoded(&mjpeg).unwrap();
    assert_eq!(rgb, decoded(BASELINE).unwrap());
    // Some pixels by Pillow, by their index.
    let pillow: [(usize, [u8; 3]); 5] = [
        (0, [81, 59, 194]),
        (23, [171, 62, 129]),
        (5 * 24 + 7, [108, 84, 168]),
        (8 * 24 + 16, [144, 100, 136]),
        (15 * 24 + 23, [172, 135, 106]),
    ];
    for (at, expected) in pillow {
        let found = &rgb[3 * at..][..3];
        assert!(found.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 3), "{at}: {found:?}");
    }
}

#[test]
fn the_error_of_a_jpeg_carries_its_cause() {
    // Its first table becomes data of an application.
    let mut file = BASELINE.to_vec();
    let at = first(&file, 0xc4);
    file[at + 1] = 0xef;
    assert_eq!(
        decoded(&file).unwrap_err().to_string(),
        "cannot decode the JPEG of 24x16: Error decoding huffman values: \
         No DC table for component Y"
    );
}

#[test]
fn a_jpeg_without_pixels_is_refused() {
    let mut file = BASELINE.to_vec();
    file.truncate(first(&file, 0xda));
    file.extend([0xff, 0xd9]);
    let error = decoded(&file).unwrap_err().to_string();
    assert!(error.ends_with("an end before any pixels"), "{error}");
}

#[test]
fn kinds_of_jpeg_that_the_decoder_decodes_wrong_are_refused() {
    let one_of_three = patched(BASELINE, 0xda, &[0, 8, 1, 1, 0, 0, 63, 0]);
    assert_eq!(
        decoded(&one_of_three).unwrap_err().to_string(),
        format!("JPEG is sequential with components in scans of their own, {NOT_SUPPORTED}")
    );
    for factors in [[0x11, 0x21, 0x21], [0x21, 0x12, 0x12], [0x22, 0x11, 0x21], [0x33, 0x11, 0x11]]
    {
        let mut file = BASELINE.to_vec();
        let parts = first(&file, 0xc0) + 10;
        for (part, factors) in file[parts..].chunks_mut(3).zip(factors) {
            part[1] = factors;
        }
        let error = probe(&file).unwrap_err().to_string();
        assert!(error.contains("subsampled in a way that cameras do not use"), "{error}");
    }
}

#[test]
fn other_bytes_are_refused_by_their_start() {
    for (data, len, start) in [
        (&b""[..], 0, "[]"),
        (b"\xff\xd8", 2, "[ff, d8]"),
        (b"jpeg; rgb8", 10, "[6a, 70, 65, 67, 3b, 20, 72, 67]"),
    ] {
        assert_eq!(
            probe(data).unwrap_err().to_string(),
            format!("data is neither JPEG nor PNG: its {len} bytes start with {start}")
        );
    }
}

#[test]
fn no_mutation_of_a_file_causes_a_panic() {
    let files = [BASELINE, PROGRESSIVE, GREY, INTERLACED, DEPTH_INTERLACED];
    let mut state = 1_u32;
    let mut random = |below: usize| {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state as usize % below
    };
    for _ in 0..2_000 {
        let mut file = files[random(files.len())].to_vec();
        for _ in 0..=random(4) {
            let at = random(file.len());
            file[at] = random(256) as u8;
        }
        if let Ok(header) = probe(&file) {
            let mut out = vec![0; header.decoded_len().unwrap().min(1 << 20)];
            let _ = super::decode(&file, &header, 1 << 20, &mut out, &StopCheck::new(&|| true));
        }
    }
}
