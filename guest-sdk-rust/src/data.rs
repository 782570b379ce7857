//! Samples, fields and frames: `gleaner:lambda/data`.

use crate::bindings::gleaner::lambda::data as wit;
pub use crate::bindings::gleaner::lambda::data::Tick;
pub use crate::bindings::gleaner::lambda::types::{
    Counts, DataError, Encoding, FrameInfo, Guid, Identity, Roi, Stamps, Value,
};
use crate::error::answer;
use crate::{Error, Result};

/// Bytes of one piece in [`Frame::copy_to`]: the size at which copying runs at the speed of memory.
const PIECE: usize = 64 << 10;

/// The ring of one `[[input]]`: its newest samples.
pub struct Topic(wit::Topic);

/// A compiled path into the messages of one topic.
pub struct Field(wit::Field);

/// One message. It cannot be overwritten until it is dropped.
pub struct Sample(wit::Sample);

/// A sample seen as an image. Its pixels stay with the host unless they are read.
pub struct Frame(wit::Frame);

/// One field of the newest samples, oldest first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Column {
    /// [`Stamps::at_ns`] of each sample, in nanoseconds.
    pub at_ns: Vec<i64>,
    /// The field's values; as many as stamps.
    pub values: Vec<f64>,
}

/// The input of that name.
///
/// # Errors
///
/// If the manifest has no such input; the message lists those it has.
pub fn input(name: &str) -> Result<Topic> {
    Ok(Topic(answer(wit::input(name))?))
}

/// Names of all inputs, in the manifest's order.
pub fn inputs() -> Vec<String> {
    wit::inputs()
}

/// Time of this wake in nanoseconds. Virtual in replay.
pub fn now_ns() -> i64 {
    wit::now_ns()
}

impl Topic {
    /// The input's name.
    pub fn name(&self) -> String {
        self.0.name()
    }

    /// The ROS topic, such as `/imu/data`.
    pub fn ros_topic(&self) -> String {
        self.0.ros_topic()
    }

    /// The ROS type, such as `sensor_msgs/msg/Imu`.
    pub fn type_name(&self) -> String {
        self.0.type_name()
    }

    /// Newest sample; none before the first.
    pub fn newest(&self) -> Option<Sample> {
        self.0.newest().map(Sample)
    }

    /// The `n` newest samples, oldest first; 256 at most.
    pub fn last(&self, n: u32) -> impl DoubleEndedIterator<Item = Sample> + ExactSizeIterator {
        self.0.last(n).into_iter().map(Sample)
    }

    /// Samples received later than `since_ns`, oldest first; the newest 256 at most.
    pub fn since(
        &self,
        since_ns: i64,
    ) -> impl DoubleEndedIterator<Item = Sample> + ExactSizeIterator {
        self.0.since(since_ns).into_iter().map(Sample)
    }

    /// What became of the samples since the lambda started.
    pub fn counts(&self) -> Counts {
        self.0.counts()
    }

    /// Compiles the path of a field, such as `linear_acceleration.x` or `cov[3]`. Do this in
    /// `init`.
    ///
    /// # Errors
    ///
    /// If the type has no such field; the message names the nearest.
    pub fn field(&self, path: &str) -> Result<Field> {
        Ok(Field(answer(self.0.field(path))?))
    }

    /// `field` of the `n` newest samples; 65,536 at most.
    ///
    /// # Errors
    ///
    /// If the field is no number or of another topic, or a sample is malformed.
    pub fn column(&self, field: &Field, n: u32) -> Result<Column> {
        Ok(answer(self.0.column(&field.0, n))?.into())
    }

    /// `field` of all samples received later than `since_ns`.
    ///
    /// # Errors
    ///
    /// As [`Topic::column`].
    pub fn column_since(&self, field: &Field, since_ns: i64) -> Result<Column> {
        Ok(answer(self.0.column_since(&field.0, since_ns))?.into())
    }
}

impl Field {
    /// The path as it was written.
    pub fn path(&self) -> String {
        self.0.path()
    }
}

impl Sample {
    /// What makes it different from every other sample.
    pub fn identity(&self) -> Identity {
        self.0.identity()
    }

    /// When it came to be, in nanoseconds of three clocks.
    pub fn stamps(&self) -> Stamps {
        self.0.stamps()
    }

    /// Any field.
    ///
    /// # Errors
    ///
    /// If the field is of another topic, or the sample is malformed.
    pub fn get(&self, field: &Field) -> Result<Value> {
        answer(self.0.get(&field.0))
    }

    /// A numeric or boolean field.
    ///
    /// # Errors
    ///
    /// As [`Topic::column`].
    pub fn number(&self, field: &Field) -> Result<f64> {
        answer(self.0.number(&field.0))
    }

    /// Size of the message in bytes, without the CDR encapsulation header.
    pub fn size(&self) -> u64 {
        self.0.size()
    }

    /// Whether the message is big-endian CDR.
    pub fn big_endian(&self) -> bool {
        self.0.big_endian()
    }

    /// Raw CDR bytes from `offset`, `len` at most; 1 MiB at most.
    pub fn cdr(&self, offset: u64, len: u32) -> Vec<u8> {
        self.0.cdr(offset, len)
    }

    /// The message as an image; JPEG and PNG are decoded by the host, once for each sample.
    ///
    /// # Errors
    ///
    /// If it is no image that can be read, or there is no room for it.
    pub fn as_frame(&self) -> Result<Frame> {
        Ok(Frame(answer(self.0.as_frame())?))
    }
}

impl Frame {
    /// The shape.
    pub fn info(&self) -> FrameInfo {
        self.0.info()
    }

    /// Identity of the sample behind it.
    pub fn identity(&self) -> Identity {
        self.0.identity()
    }

    /// Stamps of the sample behind it.
    pub fn stamps(&self) -> Stamps {
        self.0.stamps()
    }

    /// Mean luma, 0 to 255, of the whole frame or of a region.
    ///
    /// # Errors
    ///
    /// For a region outside the frame, and for Bayer encodings.
    pub fn mean_luma(&self, roi: Option<Roi>) -> Result<f64> {
        answer(self.0.mean_luma(roi))
    }

    /// Counts of the 256 luma levels.
    ///
    /// # Errors
    ///
    /// As [`Frame::mean_luma`].
    pub fn histogram(&self, roi: Option<Roi>) -> Result<Vec<u32>> {
        answer(self.0.histogram(roi))
    }

    /// A new frame of that size, each side 1 to 16,384 pixels.
    ///
    /// # Errors
    ///
    /// For sizes out of range, and if there is no room.
    pub fn resize(&self, width: u32, height: u32) -> Result<Frame> {
        Ok(Frame(answer(self.0.resize(width, height))?))
    }

    /// A new mono8 frame of the same size.
    ///
    /// # Errors
    ///
    /// If there is no room, and for Bayer encodings.
    pub fn to_gray(&self) -> Result<Frame> {
        Ok(Frame(answer(self.0.to_gray())?))
    }

    /// Pixel bytes from `offset`, `len` at most; 1 MiB at most.
    pub fn read(&self, offset: u64, len: u32) -> Vec<u8> {
        self.0.read(offset, len)
    }

    /// Copies all pixel bytes into `out`, in pieces.
    ///
    /// # Errors
    ///
    /// If `out` is not as long as `info().size`.
    pub fn copy_to(&self, out: &mut [u8]) -> Result<()> {
        let size = self.info().size;
        if out.len() as u64 != size {
            return Err(Error::new(format!(
                "the frame has {size} bytes, the buffer {}",
                out.len()
            )));
        }
        let mut offset = 0;
        for piece in out.chunks_mut(PIECE) {
            piece.copy_from_slice(&self.read(offset, piece.len() as u32));
            offset += piece.len() as u64;
        }
        Ok(())
    }

    /// The rows of pixels from top to bottom, without the padding between them.
    pub fn rows(&self) -> impl Iterator<Item = Vec<u8>> {
        let FrameInfo { width, height, step, encoding, .. } = self.info();
        let row_bytes = width * bytes_per_pixel(encoding);
        (0..height).map(move |y| self.read(u64::from(y) * u64::from(step), row_bytes))
    }
}

/// The encoding's name in ROS.
///
/// ```
/// use gleaner_sdk::data::{Encoding, encoding_name};
/// assert_eq!(encoding_name(Encoding::Yuv422Yuy2), "yuv422_yuy2");
/// ```
pub fn encoding_name(encoding: Encoding) -> &'static str {
    match encoding {
        Encoding::Rgb8 => "rgb8",
        Encoding::Bgr8 => "bgr8",
        Encoding::Rgba8 => "rgba8",
        Encoding::Bgra8 => "bgra8",
        Encoding::Mono8 => "mono8",
        Encoding::Mono16 => "mono16",
        Encoding::Yuv422 => "yuv422",
        Encoding::Yuv422Yuy2 => "yuv422_yuy2",
        Encoding::BayerRggb8 => "bayer_rggb8",
        Encoding::BayerBggr8 => "bayer_bggr8",
        Encoding::BayerGbrg8 => "bayer_gbrg8",
        Encoding::BayerGrbg8 => "bayer_grbg8",
        Encoding::BayerRggb16 => "bayer_rggb16",
        Encoding::BayerBggr16 => "bayer_bggr16",
        Encoding::BayerGbrg16 => "bayer_gbrg16",
        Encoding::BayerGrbg16 => "bayer_grbg16",
    }
}

/// Bytes that one pixel takes.
pub fn bytes_per_pixel(encoding: Encoding) -> u32 {
    match encoding {
        Encoding::Rgb8 | Encoding::Bgr8 => 3,
        Encoding::Rgba8 | Encoding::Bgra8 => 4,
        Encoding::Mono8
        | Encoding::BayerRggb8
        | Encoding::BayerBggr8
        | Encoding::BayerGbrg8
        | Encoding::BayerGrbg8 => 1,
        Encoding::Mono16
        | Encoding::Yuv422
        | Encoding::Yuv422Yuy2
        | Encoding::BayerRggb16
        | Encoding::BayerBggr16
        | Encoding::BayerGbrg16
        | Encoding::BayerGrbg16 => 2,
    }
}

impl Column {
    /// How many values there are.
    pub fn len(&self) -> usize {
        self.values.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Arithmetic mean; none if there are no values.
    ///
    /// ```
    /// # use gleaner_sdk::Column;
    /// let column = Column { at_ns: vec![0, 1], values: vec![1.0, 2.0] };
    /// assert_eq!(column.mean(), Some(1.5));
    /// assert_eq!(Column::default().mean(), None);
    /// ```
    pub fn mean(&self) -> Option<f64> {
        (!self.is_empty()).then(|| self.values.iter().sum::<f64>() / self.len() as f64)
    }

    /// Stamps and values, oldest first.
    pub fn iter(&self) -> impl DoubleEndedIterator<Item = (i64, f64)> + '_ {
        self.at_ns.iter().copied().zip(self.values.iter().copied())
    }
}

impl From<crate::bindings::gleaner::lambda::types::Column> for Column {
    fn from(column: crate::bindings::gleaner::lambda::types::Column) -> Self {
        Self { at_ns: column.at_ns, values: column.values }
    }
}

impl Frame {
    pub(crate) fn handle(&self) -> &wit::Frame {
        &self.0
    }
}

impl From<wit::Sample> for Sample {
    fn from(sample: wit::Sample) -> Self {
        Self(sample)
    }
}
