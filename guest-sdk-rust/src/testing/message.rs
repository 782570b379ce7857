//! Messages that a test creates: fields by their paths, bytes, or an image.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use crate::data::{Encoding, Value, bytes_per_pixel, encoding_name};

/// One message of a test.
///
/// ```
/// use gleaner_sdk::testing::Message;
///
/// let imu = Message::new()
///     .with("linear_acceleration.x", -4.0)
///     .with("orientation_covariance", [0.0; 9])
///     .with("header.frame_id", "imu_link")
///     .stamped(1_500_000_000);
/// ```
///
/// A lambda can read only the fields that the test sets, since the fake host does not know message
/// types. [`Host::blank`](super::Host::blank) sets default values for all messages of an input.
#[derive(Clone, Default)]
pub struct Message {
    pub(super) fields: BTreeMap<String, Value>,
    /// CDR bytes with the encapsulation header.
    pub(super) cdr: Option<Vec<u8>>,
    pub(super) picture: Option<ImageData>,
    pub(super) publish_ns: Option<i64>,
    pub(super) seq: Option<u64>,
}

/// Pixels of an image, in rows without padding.
#[derive(Clone)]
pub(super) struct ImageData {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) encoding: Encoding,
    pub(super) data: Arc<[u8]>,
}

impl Message {
    /// Creates a message without fields.
    pub fn new() -> Self {
        Self::default()
    }

    /// Creates an image of `width` x `height` pixels: rows from top to bottom, without padding.
    ///
    /// On an input of type `sensor_msgs/msg/Image`, it sets the fields `height`, `width`,
    /// `encoding`, `is_bigendian`, `step` and `data`, which [`with`](Self::with) can override. On
    /// an input of type `sensor_msgs/msg/CompressedImage`, it is the image decoded from a JPEG or
    /// PNG, so `encoding` must be rgb8.
    pub fn image(width: u32, height: u32, encoding: Encoding, pixels: impl Into<Vec<u8>>) -> Self {
        let pixels: Vec<u8> = pixels.into();
        let picture = ImageData { width, height, encoding, data: pixels.into() };
        Self { picture: Some(picture), ..Self::default() }
    }

    /// Sets the field at `path`, as a lambda writes it, such as `linear_acceleration.x` or
    /// `fields[2].name`. Set an array as a whole; a lambda can read it and its elements.
    ///
    /// The lambda gets a [`Value`](crate::data::Value) of the type that is set here: signed for
    /// signed integers such as `i32`, unsigned for those such as `u32`.
    pub fn with(mut self, path: &str, value: impl Into<FieldValue>) -> Self {
        self.fields.insert(path.to_owned(), value.into().0);
        self
    }

    /// Sets `header.stamp`, in nanoseconds: the fields `header.stamp.sec` and
    /// `header.stamp.nanosec`, and thereby [`Stamps::header_ns`](crate::data::Stamps::header_ns).
    pub fn stamped(self, header_ns: i64) -> Self {
        let (sec, nanosec) = (header_ns.div_euclid(SECOND_NS), header_ns.rem_euclid(SECOND_NS));
        self.with(STAMP[0], sec).with(STAMP[1], nanosec as u64)
    }

    /// Sets the bytes for [`Sample::cdr`](crate::Sample::cdr) and
    /// [`Sample::size`](crate::Sample::size): CDR with its encapsulation header of four bytes, the
    /// second of which is the byte order. No field is read from the bytes.
    pub fn cdr(mut self, bytes: impl Into<Vec<u8>>) -> Self {
        self.cdr = Some(bytes.into());
        self
    }

    /// Sets the time of publication, in nanoseconds; the default is the time of delivery.
    pub fn published(mut self, publish_ns: i64) -> Self {
        self.publish_ns = Some(publish_ns);
        self
    }

    /// Sets the sequence number, for example to create a gap; the default is one more than that of
    /// the previous message, from 1. A number that is not above that of the previous message is
    /// refused.
    pub fn numbered(mut self, seq: u64) -> Self {
        self.seq = Some(seq);
        self
    }

    pub(super) fn header_ns(&self) -> Option<i64> {
        let whole = |path: &str| match self.fields.get(path)? {
            Value::Signed(number) => Some(*number),
            Value::Unsigned(number) => i64::try_from(*number).ok(),
            _ => None,
        };
        whole(STAMP[0])?.checked_mul(SECOND_NS)?.checked_add(whole(STAMP[1])?)
    }

    /// Sets those fields of a `sensor_msgs/msg/Image` that the test did not set, from the image.
    pub(super) fn set_image_fields(&mut self) {
        let Some(ImageData { width, height, encoding, data }) = self.picture.take() else { return };
        let step = u64::from(width) * u64::from(bytes_per_pixel(encoding));
        let fields = [
            ("height", Value::Unsigned(height.into())),
            ("width", Value::Unsigned(width.into())),
            ("encoding", Value::Text(encoding_name(encoding).to_owned())),
            ("is_bigendian", Value::Unsigned(0)),
            ("step", Value::Unsigned(step)),
            ("data", Value::Bytes(data.to_vec())),
        ];
        for (path, value) in fields {
            self.fields.entry(path.to_owned()).or_insert(value);
        }
    }

    /// Returns a lower bound of the message size: the length of its CDR, or of its texts and bytes.
    pub(super) fn bytes_at_least(&self) -> usize {
        let bytes = |value: &Value| match value {
            Value::Text(text) => text.len(),
            Value::Bytes(bytes) => bytes.len(),
            Value::Texts(texts) => texts.iter().map(String::len).sum(),
            _ => 0,
        };
        let fields = || self.fields.values().map(bytes).sum();
        self.cdr.as_ref().map_or_else(fields, |cdr| cdr.len().saturating_sub(ENCAPSULATION))
    }
}

/// Bytes of the CDR encapsulation header, before the message.
pub(super) const ENCAPSULATION: usize = 4;

const SECOND_NS: i64 = 1_000_000_000;
const STAMP: [&str; 2] = ["header.stamp.sec", "header.stamp.nanosec"];

impl fmt::Debug for Message {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Message").field("fields", &self.fields.keys()).finish_non_exhaustive()
    }
}

/// Value of a field of a [`Message`]; converted from numbers, `bool`, texts, and arrays of numbers,
/// bytes or texts.
#[derive(Clone, Debug)]
pub struct FieldValue(Value);

conversions! {
    FieldValue:
    bool => |value| Value::Boolean(value),
    i8 => |value| Value::Signed(value.into()),
    i16 => |value| Value::Signed(value.into()),
    i32 => |value| Value::Signed(value.into()),
    i64 => |value| Value::Signed(value),
    u8 => |value| Value::Unsigned(value.into()),
    u16 => |value| Value::Unsigned(value.into()),
    u32 => |value| Value::Unsigned(value.into()),
    u64 => |value| Value::Unsigned(value),
    f32 => |value| Value::Real(value.into()),
    f64 => |value| Value::Real(value),
    &str => |value| Value::Text(value.to_owned()),
    String => |value| Value::Text(value),
    Vec<u8> => |value| Value::Bytes(value),
    &[u8] => |value| Value::Bytes(value.to_vec()),
    Vec<f64> => |value| Value::Numbers(value),
    &[f64] => |value| Value::Numbers(value.to_vec()),
    Vec<String> => |value| Value::Texts(value),
    &[&str] => |value| Value::Texts(value.iter().map(|text| (*text).to_owned()).collect()),
}

impl<const N: usize> From<[f64; N]> for FieldValue {
    fn from(value: [f64; N]) -> Self {
        Self(Value::Numbers(value.to_vec()))
    }
}

impl<const N: usize> From<[u8; N]> for FieldValue {
    fn from(value: [u8; N]) -> Self {
        Self(Value::Bytes(value.to_vec()))
    }
}

impl<const N: usize> From<[&str; N]> for FieldValue {
    fn from(value: [&str; N]) -> Self {
        Self::from(value.as_slice())
    }
}
