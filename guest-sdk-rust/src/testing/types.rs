//! Data types of `gleaner:lambda/types`, with the fields and derives that wit-bindgen generates.

/// GUID of the DDS writer that sent a sample: 16 bytes, as two big-endian halves.
#[derive(Clone, Copy, Debug)]
#[allow(missing_docs)]
pub struct Guid {
    pub high: u64,
    pub low: u64,
}

/// Unique identity of a sample.
#[derive(Clone, Debug)]
pub struct Identity {
    /// Name of the ROS topic in the manifest, such as `/imu/data`.
    pub topic: String,
    /// GUID of the writer.
    pub writer: Guid,
    /// Sequence number, strictly increasing for each writer; a gap means lost samples.
    pub seq: u64,
}

/// Timestamps of a sample in nanoseconds, on three clocks. The clocks may differ, so compare only
/// stamps of the same clock.
#[derive(Clone, Copy, Debug)]
pub struct Stamps {
    /// Time of reception since 1970 (UTC), on the vehicle's clock, which never goes back; in
    /// replay, the log time. Samples, wakes and clips are ordered by this clock.
    pub at_ns: i64,
    /// Time of publication, on the writer's clock.
    pub publish_ns: i64,
    /// `header.stamp` of the message; none unless the test set it.
    pub header_ns: Option<i64>,
}

/// Numbers of received and lost samples of one topic since the lambda's process started.
#[derive(Clone, Copy, Debug)]
pub struct Counts {
    /// Samples that entered the ring.
    pub received: u64,
    /// Samples that were lost before they reached this process; always none here.
    pub lost: Option<u64>,
    /// Samples that newer ones replaced in the ring.
    pub overwritten: u64,
    /// Samples that the ring refused because the lambda held every cell.
    pub no_slot: u64,
    /// Samples that the ring refused because they exceed `max_size` of the input.
    pub too_big: u64,
    /// Samples that should have woken the lambda and did not.
    pub skipped: u64,
}

/// Value of one field of a message. A longer value is refused, never truncated.
#[derive(Clone, Debug)]
#[allow(missing_docs)]
pub enum Value {
    Boolean(bool),
    Signed(i64),
    Unsigned(u64),
    Real(f64),
    /// At most 1 MiB.
    Text(String),
    /// `uint8[]` and `byte[]`; at most 1 MiB.
    Bytes(Vec<u8>),
    /// Any other array of numbers; at most 65,536 items.
    Numbers(Vec<f64>),
    /// An array of strings; at most 4,096 items.
    Texts(Vec<String>),
}

/// Values of one field in the newest samples, oldest first. Both lists have the same length.
#[derive(Clone, Debug)]
#[allow(missing_docs)]
pub struct Column {
    pub at_ns: Vec<i64>,
    pub values: Vec<f64>,
}

/// Pixel layout of a frame, named as in ROS `sensor_msgs/image_encodings`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[allow(missing_docs)]
pub enum Encoding {
    Rgb8,
    Bgr8,
    Rgba8,
    Bgra8,
    Mono8,
    Mono16,
    /// ROS `yuv422`: U Y V Y, two bytes per pixel.
    Yuv422,
    /// ROS `yuv422_yuy2`: Y U Y V, two bytes per pixel.
    Yuv422Yuy2,
    /// Bayer patterns are raw: the host does not convert their colours.
    BayerRggb8,
    BayerBggr8,
    BayerGbrg8,
    BayerGrbg8,
    BayerRggb16,
    BayerBggr16,
    BayerGbrg16,
    BayerGrbg16,
}

/// Size and pixel layout of a frame.
#[derive(Clone, Copy, Debug)]
pub struct FrameInfo {
    /// Width in pixels, 1 to 65,535.
    pub width: u32,
    /// Height in pixels, 1 to 65,535.
    pub height: u32,
    /// Layout of a pixel.
    pub encoding: Encoding,
    /// Bytes from the start of one row to the next; at least `width` times the bytes per pixel.
    pub step: u32,
    /// Byte order of 16-bit encodings: true if the high byte comes first.
    pub big_endian: bool,
    /// Bytes of pixel data: `step * (height - 1)` plus the bytes of the last row.
    pub size: u64,
}

/// Region of interest in pixels, from the upper left corner of the frame. It is clipped to the
/// frame, and refused if no pixel is left.
#[derive(Clone, Copy, Debug)]
#[allow(missing_docs)]
pub struct Roi {
    pub x: u32,
    pub y: u32,
    pub width: u32,
    pub height: u32,
}

/// Place of a frame in the input tensor of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Placement {
    /// The frame is stretched to the whole tensor.
    Stretch,
    /// The aspect ratio is kept; the frame is in the middle, with a border around it.
    Centre,
    /// The aspect ratio is kept; the frame is in the upper left corner.
    Corner,
}

/// Conversion of a frame to the input tensor of a model.
#[derive(Clone, Copy, Debug)]
pub struct Preprocess {
    /// Width of the tensor in pixels, 1 to 8,192.
    pub width: u32,
    /// Height of the tensor in pixels, 1 to 8,192.
    pub height: u32,
    /// Place of the frame in the tensor.
    pub placement: Placement,
    /// Grey level of the border, 0 to 255; 114 is usual.
    pub fill: u8,
    /// Channel order of the tensor: true for blue first, false for red first.
    pub bgr: bool,
    /// True for shape [1, height, width, 3], false for [1, 3, height, width].
    pub channels_last: bool,
    /// True for bytes from 0 to 255, without the numbers below; false for 32-bit floats.
    pub bytes: bool,
    /// Each channel becomes `(value * scale - mean) / deviation`, with `value` from 0 to 255.
    pub scale: f32,
    /// Mean of each channel, in the order of the tensor. See `scale`.
    pub mean: (f32, f32, f32),
    /// Deviation of each channel, in the order of the tensor; not 0. See `scale`.
    pub deviation: (f32, f32, f32),
}

/// Reason why data cannot be read. Each message names the object, the cause and the way out.
#[derive(Clone, Debug)]
pub enum DataError {
    /// The manifest has no `[[input]]` of that name.
    NoSuchInput(String),
    /// The message type has no such field, or the path names a whole message.
    NoSuchField(String),
    /// The field is not a number, is too long, or belongs to another topic.
    WrongField(String),
    /// The bytes of the sample contradict its type.
    Malformed(String),
    /// The sample is not an image, or an image that the host cannot read.
    NotAFrame(String),
    /// The image exceeds `decoded_size` of the input, all slots for decoded images are held, or the
    /// frames of the lambda reach `memory` or `frames` in `[limits]`.
    NoRoom(String),
    /// A region or size is out of range.
    OutOfRange(String),
}

/// Implements `Display` and `Error` as wit-bindgen does: an error prints as code.
macro_rules! refusal {
    ($name:ty) => {
        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                write!(f, "{self:?}")
            }
        }

        impl std::error::Error for $name {}
    };
}
pub(super) use refusal;

refusal!(DataError);

impl From<gleaner_rules::clamps::WrongField> for DataError {
    fn from(wrong: gleaner_rules::clamps::WrongField) -> Self {
        Self::WrongField(wrong.to_string())
    }
}
