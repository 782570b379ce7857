//! Converts compressed images into raw ones, and resizes them on request.

use gleaner_messages::{
    CdrError, CompressedView, Definitions, Endian, FieldPath, HeaderStamp, MessageValue, Sources,
    header_stamp,
};
use gleaner_pixels::{ImageError, decode_rgb8, probe_message};

use crate::args::Size;
use crate::buffer::{Buffer, Pool};
use crate::cdr;

#[derive(Debug, thiserror::Error)]
pub(crate) enum ConvertError {
    #[error("not a sensor_msgs/msg/CompressedImage")]
    Message(#[from] CdrError),
    #[error("invalid image data: {0}")]
    Image(#[from] ImageError),
}

/// Maximum bytes of an image in rgb8: 21 million pixels.
const MAX_BYTES: usize = 64 << 20;

pub(crate) struct Decoder {
    size: Option<Size>,
    stamp: HeaderStamp,
    frame_id: FieldPath,
    rgb: Vec<u8>,
    pool: Pool,
}

/// The type of compressed images; a drive need not define it.
const TYPE: &str = "sensor_msgs/msg/CompressedImage";

impl Decoder {
    /// Creates a decoder for images of `size`, or of their own size.
    pub(crate) fn new(size: Option<Size>) -> Decoder {
        let text = Sources::default()
            .find(TYPE)
            .expect("bundled definitions are valid")
            .expect("the type is bundled");
        let definitions = Definitions::parse(TYPE, &text).expect("bundled definitions are valid");
        let stamp = header_stamp(&definitions).expect("the type begins with a header");
        let frame_id =
            FieldPath::compile(&definitions, "header.frame_id").expect("a header has this field");
        Decoder { size, stamp, frame_id, rgb: Vec::new(), pool: Pool::default() }
    }

    /// Converts a `CompressedImage` into a `sensor_msgs/msg/Image` in bgr8, little-endian.
    pub(crate) fn convert(&mut self, cdr: &[u8], endian: Endian) -> Result<Buffer, ConvertError> {
        let view = CompressedView::read(cdr, endian)?;
        let stamp_ns = self.stamp.read(cdr, endian)?;
        let frame_id = match self.frame_id.read(cdr, endian)? {
            MessageValue::Text(text) => text,
            _ => "",
        };
        let (header, file) = probe_message(view.format, view.data)?;
        // Too large an image is refused below, before memory is allocated.
        let len = header.rgb8_len().filter(|len| *len <= MAX_BYTES).unwrap_or(0);
        self.rgb.resize(len, 0);
        decode_rgb8(file, &header, MAX_BYTES, &mut self.rgb)?;
        let from = Size { width: header.width, height: header.height };
        let to = self.size.unwrap_or(from);
        let head = cdr::image_head(stamp_ns, frame_id, to.width, to.height);
        let len = (head.len() + to.bytes()).next_multiple_of(4);
        let mut image = self.pool.take(len);
        image.resize(len, 0);
        image[..head.len()].copy_from_slice(&head);
        scale_to_bgr(&self.rgb, from, &mut image[head.len()..head.len() + to.bytes()], to);
        Ok(image)
    }
}

/// Scales `rgb` by nearest neighbour and swaps red and blue.
fn scale_to_bgr(rgb: &[u8], from: Size, bgr: &mut [u8], to: Size) {
    let nearest =
        |at: u32, to: u32, from: u32| (u64::from(at) * u64::from(from) / u64::from(to)) as usize;
    let columns: Vec<usize> = (0..to.width).map(|x| nearest(x, to.width, from.width)).collect();
    let rows = rgb.chunks_exact(3 * from.width as usize).collect::<Vec<_>>();
    for (y, out) in (0..).zip(bgr.chunks_exact_mut(3 * to.width as usize)) {
        let (row, _) = rows[nearest(y, to.height, from.height)].as_chunks::<3>();
        let (out, _) = out.as_chunks_mut::<3>();
        for (out, column) in out.iter_mut().zip(&columns) {
            let [red, green, blue] = row[*column];
            *out = [blue, green, red];
        }
    }
}

#[cfg(test)]
mod tests {
    use gleaner_messages::ImageView;
    use jpeg_encoder::{ColorType, Encoder};

    use super::*;
    use crate::cdr::{sealed, with_header};

    /// A message with an image whose left half is red and whose right half is blue.
    fn message() -> Vec<u8> {
        let pixels = [[255, 0, 0], [0, 0, 255]].map(|pixel| pixel.repeat(16)).concat().repeat(16);
        let mut jpeg = Vec::new();
        Encoder::new(&mut jpeg, 100).encode(&pixels, 32, 16, ColorType::Rgb).unwrap();
        let mut cdr = with_header(1_500_000_000, "front");
        cdr.string("jpeg").u32(jpeg.len() as u32);
        for byte in &jpeg {
            cdr.u8(*byte);
        }
        sealed(&cdr)[4..].to_vec()
    }

    #[test]
    fn an_image_becomes_bgr8_and_keeps_its_stamp_and_frame_id() {
        for (size, side) in [(None, (32, 16)), (Some("64x48"), (64, 48)), (Some("7x5"), (7, 5))] {
            let mut decoder = Decoder::new(size.map(|text| text.parse().unwrap()));
            let image = decoder.convert(&message(), Endian::Little).unwrap();
            assert_eq!(image.len() % 4, 0);
            let head = sealed(&with_header(1_500_000_000, "front"));
            assert_eq!(image[..head.len()], head);
            let view = ImageView::read(&image[4..], Endian::Little).unwrap();
            assert_eq!((view.width, view.height), side);
            let (pixels, _) = view.data.as_chunks::<3>();
            assert_eq!(pixels.len() as u32, view.width * view.height);
            let (first, last) = (pixels[0], pixels[pixels.len() - 1]);
            assert!(first[2] > 240 && first[0] < 15, "red comes last: {first:?}");
            assert!(last[0] > 240 && last[2] < 15, "blue comes first: {last:?}");
        }
    }

    #[test]
    fn an_invalid_image_is_refused_and_the_next_one_decoded() {
        let mut decoder = Decoder::new(None);
        assert!(matches!(decoder.convert(&[0; 3], Endian::Little), Err(ConvertError::Message(_))));
        let mut broken = message();
        let at = broken.len() / 2;
        broken.truncate(at);
        assert!(decoder.convert(&broken, Endian::Little).is_err());
        let mut no_image = with_header(0, "");
        no_image.string("jpeg").u32(0);
        let cdr = sealed(&no_image);
        assert!(matches!(decoder.convert(&cdr[4..], Endian::Little), Err(ConvertError::Image(_))));
        assert!(decoder.convert(&message(), Endian::Little).is_ok());
    }
}
