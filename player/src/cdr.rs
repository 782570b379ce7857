//! Builds messages in wire format: four bytes of encapsulation, then CDR, then zeros up to a
//! multiple of four.

use gleaner_messages::{CdrWriter, Endian};

/// Size of the encapsulation before the CDR; CDR alignment does not count it.
pub(crate) const ENCAPSULATION: usize = 4;

/// The encapsulation of plain CDR; `options` are its last two bytes.
pub(crate) fn encapsulation(endian: Endian, options: [u8; 2]) -> [u8; ENCAPSULATION] {
    let [a, b] = options;
    [0, u8::from(endian == Endian::Little), a, b]
}
/// Pads `bytes` with zeros to a multiple of four, as DDS sends them: Cyclone DDS may read that far.
pub(crate) fn pad(bytes: &mut Vec<u8>) {
    bytes.resize(bytes.len().next_multiple_of(4), 0);
}

/// Begins a little-endian message with a `std_msgs/msg/Header`.
pub(crate) fn with_header(stamp_ns: i64, frame_id: &str) -> CdrWriter {
    let mut cdr = CdrWriter::new();
    cdr.time(stamp_ns).string(frame_id);
    cdr
}

/// A little-endian message in wire format.
pub(crate) fn sealed(cdr: &CdrWriter) -> Vec<u8> {
    let mut message = [&encapsulation(Endian::Little, [0, 0]), cdr.bytes()].concat();
    pad(&mut message);
    message
}

/// The bytes of a `sensor_msgs/msg/Image` in bgr8 before its `3 * width * height` bytes of pixels.
pub(crate) fn image_head(stamp_ns: i64, frame_id: &str, width: u32, height: u32) -> Vec<u8> {
    let mut cdr = with_header(stamp_ns, frame_id);
    cdr.u32(height).u32(width).string("bgr8").u8(0).u32(3 * width).u32(3 * width * height);
    // The length field is aligned to four, and so is its end.
    sealed(&cdr)
}

#[cfg(test)]
mod tests {
    use gleaner_messages::ImageView;

    use super::*;

    #[test]
    fn an_image_is_read_back_unchanged() {
        for frame_id in ["", "a", "ab", "camera"] {
            let mut message = image_head(-1, frame_id, 5, 3);
            message.extend(1..=45);
            pad(&mut message);
            assert_eq!(message.len() % 4, 0);
            assert_eq!(&message[..4], &[0, 1, 0, 0]);
            let image = ImageView::read(&message[4..], Endian::Little).unwrap();
            assert_eq!((image.width, image.height, image.step, image.encoding), (5, 3, 15, "bgr8"));
            assert!(!image.is_bigendian);
            assert_eq!(image.data, (1..=45).collect::<Vec<u8>>());
        }
    }

    #[test]
    fn doubles_are_aligned_to_eight_from_the_end_of_the_encapsulation() {
        let mut cdr = with_header(0, "abc");
        cdr.f64s(&[1.0]);
        let message = sealed(&cdr);
        assert_eq!(message.len(), 4 + 16 + 8, "a header of 16 bytes, then no gap");
        assert_eq!(message[20..28], 1f64.to_le_bytes());
    }
}
