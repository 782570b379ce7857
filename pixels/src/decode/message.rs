//! The picture in a `CompressedImage`.

use gleaner_rules::pixels::Encoding;
use gleaner_rules::text::cut;

use super::{ImageError, ImageHeader, png, probe};

/// Bytes before the PNG of `compressedDepth`: an `int32` and two `float32`, which only 32FC1 needs.
const DEPTH_HEADER: usize = 12;

/// Returns the header of the picture in a `CompressedImage`, and its file: all of `data`, or what
/// follows the header of `compressedDepth`.
///
/// JPEG and PNG are distinguished by the bytes, whatever `format` names, since their pixels are the
/// same. A format that names values of another size than the file holds is refused.
///
/// # Errors
///
/// As [`probe`], and [`ImageError::MessageFormat`].
///
/// Source: `compressed_image_transport` and `compressed_depth_image_transport` of ROS 2, with
/// formats such as `rgb8; jpeg compressed bgr8` and `16UC1; compressedDepth png`.
pub fn probe_message<'f, 'd>(
    format: &'f str,
    data: &'d [u8],
) -> Result<(ImageHeader, &'d [u8]), ImageError> {
    let words = || format.split([';', ' ']);
    let is_depth = words().any(|word| word == "compressedDepth");
    let after = data.get(DEPTH_HEADER..).filter(|file| file.starts_with(&png::MAGIC));
    let file = after.filter(|_| is_depth).unwrap_or(data);
    // Of two encodings, such as `16UC1` and `rgb8`, the first is that of the camera, and the last
    // that of the file.
    let numbers = |word: &'f str| word.split(|c: char| !c.is_ascii_digit()).map(move |n| (word, n));
    let named = words().flat_map(numbers).rfind(|(_, n)| matches!(*n, "8" | "16" | "32" | "64"));
    let why = match (probe(file), named) {
        (Err(error @ ImageError::NotAnImage { .. }), _) => {
            format!("{error}; publish JPEG or PNG, depth as `16UC1; compressedDepth png`")
        }
        (Err(error), _) => return Err(error),
        (Ok(_), None) if is_depth => "name the encoding, as in `16UC1; compressedDepth png`".into(),
        (Ok(_), Some((name, _))) if name.starts_with("bayer_") => {
            "raw pixels have no colour: debayer first, for example by image_proc".into()
        }
        (Ok(header), named) => {
            let found = if header.encoding == Encoding::Mono16 { "16" } else { "8" };
            match named.filter(|(_, bits)| *bits != found) {
                None => return Ok((header, file)),
                Some((name, bits)) => format!(
                    "{name} has {bits} bits per value, and the {} has {found}: publish depth as \
                     16UC1 in PNG, others with 8 bits, and name what is sent",
                    header.format
                ),
            }
        }
    };
    Err(ImageError::MessageFormat { format: cut(format, 64).to_owned(), why })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::samples::{BASELINE, DEPTH, INTERLACED};

    #[test]
    fn the_format_of_a_message_must_name_what_its_bytes_hold() {
        let after = |file: &[u8]| [&[0; DEPTH_HEADER], file].concat();
        let (depth, shallow) = (after(DEPTH), after(INTERLACED));
        for (format, data, why) in [
            ("", BASELINE, ""),
            ("jpeg", INTERLACED, ""),
            ("png", DEPTH, ""),
            ("bayer_rggb8; jpeg compressed bgr8", BASELINE, ""),
            ("mono16; jpeg compressed mono8", BASELINE, ""),
            ("16UC1; png compressed ", DEPTH, ""),
            ("16UC1; compressedDepth", &depth, ""),
            ("mono16; compressedDepth png", &depth, ""),
            ("16UC1; compressedDepth png", DEPTH, ""),
            (
                "32FC1; compressedDepth png",
                &depth,
                "32FC1 has 32 bits per value, and the PNG has 16",
            ),
            (
                "16UC1; jpeg compressed ",
                BASELINE,
                "16UC1 has 16 bits per value, and the JPEG has 8",
            ),
            ("16UC1; compressedDepth", &shallow, "16UC1 has 16 bits per value, and the PNG has 8"),
            ("rgb8; png compressed bgr8", DEPTH, "bgr8 has 8 bits per value, and the PNG has 16"),
            ("compressedDepth", &depth, "name the encoding, as in `16UC1; compressedDepth png`"),
            ("bayer_rggb16; png compressed ", DEPTH, "raw pixels have no colour: debayer first"),
            ("png", &depth, "neither JPEG nor PNG: its 95 bytes start with [00, 00, 00, 00, 00"),
            ("16UC1; compressedDepth rvl", &[0; 99], "publish JPEG or PNG, depth as `16UC1; comp"),
            ("h264", b"\0\0\0\x01", "data is neither JPEG nor PNG: its 4 bytes start with [00"),
        ] {
            match probe_message(format, data).map_err(|error| error.to_string()) {
                Ok(found) => {
                    let file = if data == depth { DEPTH } else { data };
                    assert_eq!((found, why), ((probe(file).unwrap(), file), ""), "{format}");
                }
                Err(error) => {
                    assert!(error.starts_with(&format!("format `{format}`: ")), "{error}");
                    assert!(error.contains(why) && !why.is_empty(), "{error}");
                }
            }
        }
    }
}
