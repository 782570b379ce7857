//! Creates a small JPEG from an image message, for lists of clips.

use gleaner_messages::{CompressedView, Endian, ImageView};
use gleaner_pixels::{self as image, Encoding, ImageHeader, StopCheck, View, ops};
use jpeg_encoder::{ColorType, Encoder};

/// Greatest width of a thumbnail, in pixels.
const WIDTH: u32 = 320;
/// Greatest height: a phone held upright makes 320x569, and a taller image is made narrower.
const HEIGHT: u32 = 640;
const QUALITY: u8 = 80;
/// Most bytes that a compressed image may have as rgb8; 21 megapixels.
const DECODED_BYTES: usize = 64 << 20;

/// Colour of boxes, in red, green and blue.
const BOX: [u8; 3] = [255, 96, 0];
/// Width of their lines, in pixels.
const LINE: u32 = 2;

/// A box around an object, in pixels of the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObjectBox {
    pub x: f64,
    pub y: f64,
    pub width: f64,
    pub height: f64,
}

/// Returns whether messages of this type are images, of which there are thumbnails; the name with
/// or without `msg/`.
pub fn is_image(type_name: &str) -> bool {
    ["Image", "CompressedImage"].iter().any(|image| {
        type_name
            .strip_prefix("sensor_msgs/")
            .is_some_and(|name| name.trim_start_matches("msg/") == *image)
    })
}

/// A JPEG of the image message `cdr`, 320x640 pixels at most and never larger than the image.
///
/// `None` if the type is not an image, or if the message or its image is broken, in an unsupported
/// format, or larger than 64 MiB once decoded. Images without colour, including those of raw
/// sensors, become grey.
pub fn thumbnail(type_name: &str, cdr: &[u8], endian: Endian) -> Option<Vec<u8>> {
    thumbnail_with_boxes(type_name, cdr, endian, &[])
}

/// As [`thumbnail`], with `boxes` drawn into it.
pub fn thumbnail_with_boxes(
    type_name: &str,
    cdr: &[u8],
    endian: Endian,
    boxes: &[ObjectBox],
) -> Option<Vec<u8>> {
    match type_name {
        "sensor_msgs/msg/Image" | "sensor_msgs/Image" => {
            raw(&ImageView::read(cdr, endian).ok()?, boxes)
        }
        "sensor_msgs/msg/CompressedImage" | "sensor_msgs/CompressedImage" => {
            compressed(&CompressedView::read(cdr, endian).ok()?, boxes)
        }
        _ => None,
    }
}

fn raw(message: &ImageView<'_>, boxes: &[ObjectBox]) -> Option<Vec<u8>> {
    // The colours of a raw sensor lie side by side. Their mean over an area is its grey level, good
    // enough to recognise the scene.
    let encoding = match Encoding::from_ros(message.encoding).ok()? {
        Encoding::Bayer8(_) => Encoding::Mono8,
        Encoding::Bayer16(_) => Encoding::Mono16,
        encoding => encoding,
    };
    let (width, height, step) = (message.width, message.height, message.step);
    let view = View::new(width, height, step, encoding, message.is_bigendian, message.data);
    small(&view.ok()?, boxes)
}

fn compressed(message: &CompressedView<'_>, boxes: &[ObjectBox]) -> Option<Vec<u8>> {
    // People look at it, so that a format which contradicts the bytes does no harm.
    let (header, file) = image::probe_message(message.format, message.data)
        .or_else(|_| image::probe(message.data).map(|header| (header, message.data)))
        .ok()?;
    header.rgb8_len().filter(|len| *len <= DECODED_BYTES)?;
    let mut pixels = vec![0; header.decoded_len()?];
    image::decode(file, &header, DECODED_BYTES, &mut pixels, &StopCheck::new(&|| true)).ok()?;
    let ImageHeader { width, height, encoding, .. } = header;
    let step = width.checked_mul(encoding.bytes_per_pixel() as u32)?;
    let view = View::new(width, height, step, encoding, false, &pixels);
    small(&view.ok()?, boxes)
}

fn small(view: &View<'_>, boxes: &[ObjectBox]) -> Option<Vec<u8>> {
    let (width, height) = fit(view.width(), view.height());
    let (encoding, len) = ops::resized(view, width, height).ok()?;
    let mut pixels = vec![0; len];
    ops::resize(view, width, height, &mut pixels).ok()?;
    let scale = f64::from(width) / f64::from(view.width());
    for object in boxes {
        draw(&mut pixels, (width, height), encoding.is_grey(), object, scale);
    }
    let color = if encoding.is_grey() { ColorType::Luma } else { ColorType::Rgb };
    let mut jpeg = Vec::new();
    let (width, height) = (u16::try_from(width).ok()?, u16::try_from(height).ok()?);
    Encoder::new(&mut jpeg, QUALITY).encode(&pixels, width, height, color).ok()?;
    Some(jpeg)
}

/// Draws the outline of `object`, whose pixels are `scale` pixels of the thumbnail.
fn draw(
    pixels: &mut [u8],
    (width, height): (u32, u32),
    is_grey: bool,
    object: &ObjectBox,
    scale: f64,
) {
    // A cast clamps, also what is not a number.
    let at = |position: f64, side: u32| ((position * scale).round() as u32).min(side - 1);
    let (left, right) = (at(object.x, width), at(object.x + object.width, width));
    let (top, bottom) = (at(object.y, height), at(object.y + object.height, height));
    for y in top..=bottom {
        for x in left..=right {
            let is_inside =
                x >= left + LINE && x + LINE <= right && y >= top + LINE && y + LINE <= bottom;
            if is_inside {
                continue;
            }
            let index = y as usize * width as usize + x as usize;
            match is_grey {
                true => pixels[index] = u8::MAX,
                false => pixels[3 * index..3 * index + 3].copy_from_slice(&BOX),
            }
        }
    }
}

/// The largest size within a thumbnail's bounds that has the ratio of `width` x `height`, and is
/// not larger.
fn fit(width: u32, height: u32) -> (u32, u32) {
    let scaled = |side: u32, to: u32, from: u32| {
        let exact =
            (u64::from(side) * u64::from(to) + u64::from(from) / 2) / u64::from(from.max(1));
        u32::try_from(exact).unwrap_or(u32::MAX).max(1)
    };
    let (mut fit_width, mut fit_height) = (width, height);
    if fit_width > WIDTH {
        (fit_width, fit_height) = (WIDTH, scaled(height, WIDTH, width));
    }
    if fit_height > HEIGHT {
        (fit_width, fit_height) = (scaled(width, HEIGHT, height), HEIGHT);
    }
    (fit_width, fit_height)
}

#[cfg(test)]
mod tests {
    use super::*;

    const IMAGE: &str = "sensor_msgs/msg/Image";
    const COMPRESSED: &str = "sensor_msgs/msg/CompressedImage";

    /// Little-endian CDR, field by field.
    #[derive(Default)]
    struct Cdr(Vec<u8>);

    impl Cdr {
        fn u32(mut self, value: u32) -> Self {
            self.0.resize(self.0.len().next_multiple_of(4), 0);
            self.0.extend(value.to_le_bytes());
            self
        }

        fn byte(mut self, value: u8) -> Self {
            self.0.push(value);
            self
        }

        fn bytes(self, data: &[u8]) -> Self {
            let mut cdr = self.u32(u32::try_from(data.len()).unwrap());
            cdr.0.extend(data);
            cdr
        }

        fn text(self, text: &str) -> Self {
            self.bytes(format!("{text}\0").as_bytes())
        }
    }

    fn image(width: u32, height: u32, encoding: &str, step: u32, data: &[u8]) -> Vec<u8> {
        let header = Cdr::default().u32(1).u32(2).text("camera").u32(height).u32(width);
        header.text(encoding).byte(0).u32(step).bytes(data).0
    }

    fn packed(data: &[u8]) -> Vec<u8> {
        Cdr::default().u32(1).u32(2).text("camera").text("jpeg").bytes(data).0
    }

    /// Width, height and mean colour of a JPEG.
    fn seen(jpeg: &[u8]) -> (u32, u32, [u8; 3]) {
        let header = gleaner_pixels::probe(jpeg).unwrap();
        let mut pixels = vec![0; header.rgb8_len().unwrap()];
        gleaner_pixels::decode_rgb8(jpeg, &header, pixels.len(), &mut pixels).unwrap();
        let mut sums = [0_u64; 3];
        for pixel in pixels.as_chunks::<3>().0 {
            for (sum, value) in sums.iter_mut().zip(pixel) {
                *sum += u64::from(*value);
            }
        }
        let count = u64::from(header.width) * u64::from(header.height);
        (header.width, header.height, sums.map(|sum| u8::try_from(sum / count).unwrap()))
    }

    fn near(found: [u8; 3], wanted: [u8; 3]) -> bool {
        found.iter().zip(wanted).all(|(found, wanted)| found.abs_diff(wanted) <= 4)
    }

    #[test]
    fn a_raw_image_keeps_its_colour_and_its_ratio() {
        let rgb: Vec<u8> = [200, 100, 50].repeat(640 * 480);
        let (width, height, mean) =
            seen(&thumbnail(IMAGE, &image(640, 480, "rgb8", 1920, &rgb), Endian::Little).unwrap());
        assert_eq!((width, height), (320, 240));
        assert!(near(mean, [200, 100, 50]), "{mean:?}");
        let (_, _, mean) =
            seen(&thumbnail(IMAGE, &image(640, 480, "bgr8", 1920, &rgb), Endian::Little).unwrap());
        assert!(near(mean, [50, 100, 200]), "{mean:?}");
    }

    #[test]
    fn a_small_image_is_not_enlarged() {
        let (width, height, mean) = seen(
            &thumbnail(IMAGE, &image(20, 10, "mono8", 20, &[90; 200]), Endian::Little).unwrap(),
        );
        assert_eq!((width, height), (20, 10));
        assert!(near(mean, [90; 3]), "{mean:?}");
    }

    #[test]
    fn a_raw_sensor_becomes_grey() {
        let mosaic = [[100, 200].repeat(8), [0, 100].repeat(8)].concat().repeat(4);
        let (width, height, mean) = seen(
            &thumbnail(IMAGE, &image(16, 8, "bayer_rggb8", 16, &mosaic), Endian::Little).unwrap(),
        );
        assert_eq!((width, height), (16, 8));
        assert!(near(mean, [100; 3]), "{mean:?}");
    }

    #[test]
    fn a_compressed_image_is_made_smaller() {
        let rgb: Vec<u8> = [10, 220, 30].repeat(800 * 400);
        let mut jpeg = Vec::new();
        Encoder::new(&mut jpeg, 90).encode(&rgb, 800, 400, ColorType::Rgb).unwrap();
        let (width, height, mean) =
            seen(&thumbnail(COMPRESSED, &packed(&jpeg), Endian::Little).unwrap());
        assert_eq!((width, height), (320, 160));
        assert!(near(mean, [10, 220, 30]), "{mean:?}");
    }

    #[test]
    fn the_size_keeps_the_ratio_within_its_box() {
        assert_eq!(fit(320, 240), (320, 240));
        assert_eq!(fit(1920, 1080), (320, 180));
        assert_eq!(fit(1080, 1920), (320, 569));
        assert_eq!(fit(65_535, 1), (320, 1));
        assert_eq!(fit(1, 65_535), (1, 640));
        assert_eq!(fit(100, 1000), (64, 640));
    }

    #[test]
    fn other_messages_have_no_thumbnail() {
        let good = image(20, 10, "mono8", 20, &[90; 200]);
        assert!(thumbnail("sensor_msgs/msg/Imu", &good, Endian::Little).is_none());
        assert!(thumbnail(COMPRESSED, &good, Endian::Little).is_none());
        assert!(thumbnail(IMAGE, &image(20, 10, "nv12", 20, &[90; 200]), Endian::Little).is_none());
        assert!(
            thumbnail(IMAGE, &image(20, 10, "mono8", 20, &[90; 199]), Endian::Little).is_none()
        );
        assert!(
            thumbnail(IMAGE, &image(u32::MAX, u32::MAX, "rgb8", u32::MAX, &[0; 9]), Endian::Little)
                .is_none()
        );
        for len in 0..good.len() {
            assert!(thumbnail(IMAGE, &good[..len], Endian::Little).is_none(), "{len} bytes");
        }
    }

    #[test]
    fn a_file_that_claims_a_huge_image_is_not_decoded() {
        let mut jpeg = Vec::new();
        Encoder::new(&mut jpeg, 90).encode(&[0; 3 * 64], 8, 8, ColorType::Rgb).unwrap();
        let sof = jpeg.windows(2).position(|pair| pair == [0xff, 0xc0]).unwrap();
        jpeg[sof + 5..sof + 9].copy_from_slice(&[0xff; 4]);
        assert!(thumbnail(COMPRESSED, &packed(&jpeg), Endian::Little).is_none());
    }
}
