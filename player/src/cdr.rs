//! Messages as they go over the wire: four bytes of encapsulation, then CDR, then zeros up to a multiple of four.

use gleaner_transport::Endian;

/// Bytes in front of the CDR, from which its alignment does not count.
pub(crate) const ENCAPSULATION: usize = 4;

/// The encapsulation of plain CDR; `options` are its last two bytes.
pub(crate) fn encapsulation(endian: Endian, options: [u8; 2]) -> [u8; ENCAPSULATION] {
    let [a, b] = options;
    [0, u8::from(endian == Endian::Little), a, b]
}

/// Fills `bytes` up to a multiple of four, which is how DDS sends them: Cyclone DDS may read that far.
pub(crate) fn pad(bytes: &mut Vec<u8>) {
    bytes.resize(bytes.len().next_multiple_of(4), 0);
}

/// A little-endian message, written field by field.
pub(crate) struct Cdr(Vec<u8>);

impl Cdr {
    /// A message that begins with a `std_msgs/msg/Header`.
    pub(crate) fn with_header(stamp_ns: i64, frame_id: &str) -> Cdr {
        let mut cdr = Cdr(encapsulation(Endian::Little, [0, 0]).to_vec());
        let (sec, nanosec) = crate::stamp::split(stamp_ns);
        cdr.align(4);
        cdr.0.extend(sec.to_le_bytes());
        cdr.u32(nanosec);
        cdr.text(frame_id);
        cdr
    }

    pub(crate) fn u8(&mut self, value: u8) {
        self.0.push(value);
    }

    pub(crate) fn u32(&mut self, value: u32) {
        self.align(4);
        self.0.extend(value.to_le_bytes());
    }

    pub(crate) fn f64s(&mut self, values: &[f64]) {
        self.align(8);
        values.iter().for_each(|value| self.0.extend(value.to_le_bytes()));
    }

    pub(crate) fn text(&mut self, text: &str) {
        // A text comes out of a message of less than 4 GiB.
        self.u32(text.len() as u32 + 1);
        self.0.extend(text.as_bytes());
        self.0.push(0);
    }

    /// The message, with its padding.
    pub(crate) fn done(mut self) -> Vec<u8> {
        pad(&mut self.0);
        self.0
    }

    fn align(&mut self, to: usize) {
        let end = (self.0.len() - ENCAPSULATION).next_multiple_of(to) + ENCAPSULATION;
        self.0.resize(end, 0);
    }
}

/// All of a `sensor_msgs/msg/Image` in bgr8 that comes before its pixels, of which there are `3 * width * height`.
pub(crate) fn image_head(stamp_ns: i64, frame_id: &str, width: u32, height: u32) -> Vec<u8> {
    let mut cdr = Cdr::with_header(stamp_ns, frame_id);
    cdr.u32(height);
    cdr.u32(width);
    cdr.text("bgr8");
    cdr.u8(0);
    cdr.u32(3 * width);
    cdr.u32(3 * width * height);
    // The length was aligned to four, and so is what ends with it.
    cdr.done()
}

#[cfg(test)]
mod tests {
    use gleaner_transport::message::ImageView;

    use super::*;

    #[test]
    fn an_image_is_read_back_as_it_was_written() {
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
        let mut cdr = Cdr::with_header(0, "abc");
        cdr.f64s(&[1.0]);
        let message = cdr.done();
        assert_eq!(message.len(), 4 + 16 + 8, "a header of 16 bytes, then no gap");
        assert_eq!(message[20..28], 1f64.to_le_bytes());
    }
}
