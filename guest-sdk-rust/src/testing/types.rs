//! `gleaner:lambda/types`: plain values, with the fields and derives that wit-bindgen gives them.

/// Who sent a sample: the 16 bytes of a DDS writer GUID, as two big-endian halves.
#[derive(Clone, Copy, Debug)]
#[allow(missing_docs)]
pub struct Guid {
    pub high: u64,
    pub low: u64,
}

/// What makes a sample different from every other one.
#[derive(Clone, Debug)]
pub struct Identity {
    /// ROS topic name as the manifest gives it, such as `/imu/data`.
    pub topic: String,
    /// Who sent it.
    pub writer: Guid,
    /// Rises strictly for each writer; gaps are samples that were lost on the way.
    pub seq: u64,
}

/// When a sample came to be, in nanoseconds. The three clocks may differ: compare like with like.
#[derive(Clone, Copy, Debug)]
pub struct Stamps {
    /// When the vehicle received it: the clock that orders samples, wakes and clips. In replay: the
    /// log time.
    pub at_ns: i64,
    /// When the writer published it, by the writer's clock.
    pub publish_ns: i64,
    /// `header.stamp` of the message, where its type starts with a `std_msgs/msg/Header`.
    pub header_ns: Option<i64>,
}

/// What became of the samples of one topic since the lambda started.
#[derive(Clone, Copy, Debug)]
pub struct Counts {
    /// Samples that entered the ring.
    pub received: u64,
    /// Samples known to be lost before they reached this process; none where nobody can know.
    pub lost: Option<u64>,
    /// Samples that left the ring to make room for newer ones.
    pub overwritten: u64,
    /// Samples refused because every cell was held.
    pub no_slot: u64,
    /// Samples refused because they exceed the input's `max_size`.
    pub too_big: u64,
    /// Samples that should have woken the lambda and did not.
    pub skipped: u64,
}

/// One field of a message. A longer one than stands here is refused, never cut.
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

/// Newest values of one field, oldest first. Both lists have the same length.
#[derive(Clone, Debug)]
#[allow(missing_docs)]
pub struct Column {
    pub at_ns: Vec<i64>,
    pub values: Vec<f64>,
}

/// Pixel layout of a frame. Named as in ROS `sensor_msgs/image_encodings`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[allow(missing_docs)]
pub enum Encoding {
    Rgb8,
    Bgr8,
    Rgba8,
    Bgra8,
    Mono8,
    Mono16,
    /// ROS `yuv422`: U Y V Y, two bytes a pixel.
    Yuv422,
    /// ROS `yuv422_yuy2`: Y U Y V, two bytes a pixel.
    Yuv422Yuy2,
    /// The Bayer patterns are given raw: the host neither reads nor converts their colours.
    BayerRggb8,
    BayerBggr8,
    BayerGbrg8,
    BayerGrbg8,
    BayerRggb16,
    BayerBggr16,
    BayerGbrg16,
    BayerGrbg16,
}

/// Shape of a frame.
#[derive(Clone, Copy, Debug)]
pub struct FrameInfo {
    /// Pixels, 1 to 65,535.
    pub width: u32,
    /// Pixels, 1 to 65,535.
    pub height: u32,
    /// Layout of a pixel.
    pub encoding: Encoding,
    /// Bytes from one row to the next; at least `width` times the bytes of a pixel.
    pub step: u32,
    /// Byte order of the 16-bit encodings.
    pub big_endian: bool,
    /// Bytes of pixel data: `step * (height - 1)` plus the last row.
    pub size: u64,
}

/// Region of interest in pixels; clipped to the frame, and refused if nothing is left.
#[derive(Clone, Copy, Debug)]
#[allow(missing_docs)]
pub struct Roi {
    pub x: u32,
    pub y: u32,
    pub width: u32,
    pub height: u32,
}

/// How a frame becomes the input of a model.
#[derive(Clone, Copy, Debug)]
pub struct Preprocess {
    /// Width of the tensor in pixels, 1 to 8,192.
    pub width: u32,
    /// Height of the tensor in pixels, 1 to 8,192.
    pub height: u32,
    /// Keep the aspect ratio and fill the rest with `fill`; otherwise stretch.
    pub letterbox: bool,
    /// Grey level 0 to 255 of the filled border; 114 is usual.
    pub fill: u8,
    /// Channel order of the tensor: blue first if true, else red first.
    pub bgr: bool,
    /// Each channel becomes `(value - mean) * scale`, with `value` from 0 to 255.
    pub mean: (f32, f32, f32),
    /// See `mean`.
    pub scale: (f32, f32, f32),
}

/// Why a read of data failed. Each message names the thing, the cause and the way out.
#[derive(Clone, Debug)]
pub enum DataError {
    /// No `[[input]]` of that name.
    NoSuchInput(String),
    /// The message type has no such field, or the field is not a value.
    NoSuchField(String),
    /// The field is no number, is too long, or belongs to another topic.
    WrongField(String),
    /// The sample's bytes contradict its type.
    Malformed(String),
    /// The sample is no image, or an image that the host cannot read.
    NotAFrame(String),
    /// The image is larger than the input's `decoded_size`, every decoded slot is held, or the
    /// frames that the lambda made take all of `memory` in `[limits]`.
    NoRoom(String),
    /// A region, size or offset is out of range.
    OutOfRange(String),
}

/// As wit-bindgen does it: a refusal prints as code, and is an error of Rust.
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
