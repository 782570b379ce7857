//! The test messages of peers. Their content follows from their number, so that every byte can be
//! checked.
//!
//! `tests/peers/sum.h` and `tests/peers/python/peer.py` contain the same formulas.

use gleaner_messages::Endian;

/// A type of test messages, with their size.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum MessageType {
    /// `sensor_msgs/msg/Imu`, about 330 bytes.
    Imu,
    /// `sensor_msgs/msg/Image`, `rgb8`.
    Image { width: u32, height: u32 },
    /// `sensor_msgs/msg/CompressedImage` with this many bytes.
    CompressedImage(u32),
    /// `sensor_msgs/msg/PointCloud2` with this many bytes, a multiple of 16.
    PointCloud2(u32),
    /// `sensor_msgs/msg/TimeReference`, about 40 bytes.
    TimeReference,
}

/// One value of a message in wire format.
#[derive(Clone, Debug, PartialEq)]
enum WireValue {
    U8(u8),
    U32(u32),
    F64(f64),
    Text(String),
    Bytes(Vec<u8>),
}

#[derive(Clone, Debug, PartialEq)]
pub struct PeerMessage(Vec<WireValue>);

impl MessageType {
    /// The name without its package, such as `Imu`.
    pub fn short_name(self) -> &'static str {
        match self {
            Self::Imu => "Imu",
            Self::Image { .. } => "Image",
            Self::CompressedImage(_) => "CompressedImage",
            Self::PointCloud2(_) => "PointCloud2",
            Self::TimeReference => "TimeReference",
        }
    }

    /// The full name, such as `sensor_msgs/msg/Imu`.
    pub fn name(self) -> String {
        format!("sensor_msgs/msg/{}", self.short_name())
    }

    /// The value of a peer's option `--size`; `None` for types of a fixed size.
    pub fn size(self) -> Option<String> {
        match self {
            Self::Imu | Self::TimeReference => None,
            Self::Image { width, height } => Some(format!("{width}x{height}")),
            Self::CompressedImage(bytes) | Self::PointCloud2(bytes) => Some(bytes.to_string()),
        }
    }

    /// Message `n`, from 1.
    pub fn message(self, n: u32) -> PeerMessage {
        use WireValue::{Bytes, F64, Text, U8, U32};
        let time = |n: u32| [U32(1000 + n), U32(7 * n + 3)];
        let bytes = |length: u32| {
            Bytes((0..length).map(|at| (31 * u64::from(at) + 7 * u64::from(n)) as u8).collect())
        };
        let mut pieces = Vec::from(time(n));
        pieces.push(Text(format!("frame_{n}")));
        match self {
            Self::Imu => {
                pieces.extend((0..37).map(|k| F64(100.0 * f64::from(n) + f64::from(k) + 0.25)))
            }
            Self::Image { width, height } => {
                pieces.extend([
                    U32(height),
                    U32(width),
                    Text("rgb8".to_owned()),
                    U8(0),
                    U32(3 * width),
                ]);
                pieces.push(bytes(3 * width * height));
            }
            Self::CompressedImage(length) => {
                pieces.extend([Text("jpeg".to_owned()), bytes(length)])
            }
            Self::PointCloud2(length) => {
                pieces.extend([U32(1), U32(length / 16), U32(4)]);
                for (k, name) in ["x", "y", "z", "intensity"].into_iter().enumerate() {
                    pieces.extend([Text(name.to_owned()), U32(4 * k as u32), U8(7), U32(1)]);
                }
                pieces.extend([U8(0), U32(16), U32(length), bytes(length), U8(1)]);
            }
            Self::TimeReference => {
                pieces.extend(time(n + 1));
                pieces.push(Text("gps".to_owned()));
            }
        }
        PeerMessage(pieces)
    }
}

impl PeerMessage {
    /// The message as CDR, without encapsulation.
    pub fn cdr(&self) -> Vec<u8> {
        let mut cdr = Vec::new();
        for piece in &self.0 {
            cdr.resize(cdr.len().next_multiple_of(piece.alignment()), 0);
            piece.write(&mut cdr);
        }
        cdr
    }

    /// CRC-32 of its values without padding; peers print it.
    pub fn sum(&self) -> u32 {
        let mut bytes = Vec::new();
        self.0.iter().for_each(|piece| piece.write(&mut bytes));
        crc32fast::hash(&bytes)
    }

    /// The first difference between `cdr` and this message; the content of padding is ignored.
    pub fn differs(&self, cdr: &[u8], endian: Endian) -> Option<String> {
        if endian != Endian::Little {
            return Some(format!("{endian:?} endian"));
        }
        let (mut at, mut wanted) = (0_usize, Vec::new());
        for piece in &self.0 {
            at = at.next_multiple_of(piece.alignment());
            wanted.clear();
            piece.write(&mut wanted);
            if cdr.get(at..at + wanted.len()) != Some(&wanted) {
                return Some(format!("differs at byte {at} of {}", cdr.len()));
            }
            at += wanted.len();
        }
        // The payload is padded to a multiple of four.
        (cdr.len() - at > 3).then(|| format!("{} bytes too many", cdr.len() - at))
    }
}

impl WireValue {
    fn alignment(&self) -> usize {
        match self {
            Self::U8(_) => 1,
            Self::U32(_) | Self::Text(_) | Self::Bytes(_) => 4,
            Self::F64(_) => 8,
        }
    }

    /// Appends the value, little-endian, without padding.
    fn write(&self, to: &mut Vec<u8>) {
        match self {
            Self::U8(value) => to.push(*value),
            Self::U32(value) => to.extend(value.to_le_bytes()),
            Self::F64(value) => to.extend(value.to_le_bytes()),
            Self::Text(text) => {
                to.extend((text.len() as u32 + 1).to_le_bytes());
                to.extend(text.as_bytes());
                to.push(0);
            }
            Self::Bytes(bytes) => {
                to.extend((bytes.len() as u32).to_le_bytes());
                to.extend(bytes);
            }
        }
    }
}
