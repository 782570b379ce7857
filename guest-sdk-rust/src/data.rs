//! Samples, fields and frames: `gleaner:lambda/data`. The maximum numbers of bytes (1 MiB) and
//! values (65,536) below are the defaults of `call_bytes` and `call_items` in `[limits]`. The
//! manifest and the vehicle can lower them.

pub use crate::error::DataErrorKind;
use crate::error::into_result;
use crate::world::gleaner::lambda::data as wit;
pub use crate::world::gleaner::lambda::data::Tick;
pub use crate::world::gleaner::lambda::types::{
    Counts, DataError, Encoding, FrameInfo, Guid, Identity, Roi, Stamps, Value,
};
use crate::{Error, Result};

/// Bytes that one call copies where several are needed: copying reaches memory bandwidth at this
/// size.
pub(crate) const PIECE: usize = 64 << 10;

/// The ring of one `[[input]]`: its newest samples, at most `depth`.
pub struct Topic(wit::Topic);

/// A compiled path into the messages of one topic.
pub struct Field(wit::Field);

/// One message. It cannot be overwritten until it is dropped. If a lambda holds too many samples, a
/// replay refuses new ones ([`Counts::no_slot`]), and a live wake ends in a fault.
pub struct Sample(wit::Sample);

/// A sample as an image. Its pixels stay in the host until the lambda reads them.
pub struct Frame(wit::Frame);

/// Values of one field in the newest samples, oldest first. Both lists have the same length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Column {
    /// [`Stamps::at_ns`] of each sample, in nanoseconds.
    pub at_ns: Vec<i64>,
    /// Value of the field in each sample; true is 1.
    pub values: Vec<f64>,
}

/// Returns the input `name` of the manifest.
///
/// # Errors
///
/// `no-such-input`; the message lists the inputs.
pub fn input(name: &str) -> Result<Topic> {
    Ok(Topic(into_result(wit::input(name))?))
}

/// Returns the names of all inputs, in the order of the manifest.
pub fn inputs() -> Vec<String> {
    wit::inputs()
}

/// Returns the time of the current wake in nanoseconds: `at_ns` of its sample or tick. In replay it
/// is the recorded time; in the first `init` it is 0.
pub fn now_ns() -> i64 {
    wit::now_ns()
}

impl Topic {
    /// Returns the name of the input in the manifest.
    pub fn name(&self) -> String {
        self.0.name()
    }

    /// Returns the name of the ROS topic, such as `/imu/data`.
    pub fn ros_topic(&self) -> String {
        self.0.ros_topic()
    }

    /// Returns the ROS message type, such as `sensor_msgs/msg/Imu`.
    pub fn type_name(&self) -> String {
        self.0.type_name()
    }

    /// Returns the newest sample; none before the first one.
    pub fn newest(&self) -> Option<Sample> {
        self.0.newest().map(Sample)
    }

    /// Returns the `n` newest samples, oldest first; fewer if the ring holds fewer. `n` is clamped
    /// to 256.
    pub fn last(&self, n: u32) -> impl DoubleEndedIterator<Item = Sample> + ExactSizeIterator {
        self.0.last(n).into_iter().map(Sample)
    }

    /// Returns the samples with [`Stamps::at_ns`] later than `since_ns`, oldest first; at most the
    /// newest 256.
    pub fn since(
        &self,
        since_ns: i64,
    ) -> impl DoubleEndedIterator<Item = Sample> + ExactSizeIterator {
        self.0.since(since_ns).into_iter().map(Sample)
    }

    /// Returns the numbers of received and lost samples of this topic since the lambda's process
    /// started.
    pub fn counts(&self) -> Counts {
        self.0.counts()
    }

    /// Compiles the path of a field, such as `linear_acceleration.x`, `cov[3]` or `fields[2].name`.
    /// Do this once, in `init`: compiling takes microseconds, reading a compiled field tens of
    /// nanoseconds.
    ///
    /// # Errors
    ///
    /// `no-such-field`; the message lists the existing fields and the most similar one.
    /// `wrong-field` for a path of more than 1,024 bytes.
    pub fn field(&self, path: &str) -> Result<Field> {
        Ok(Field(into_result(self.0.field(path))?))
    }

    /// Returns the values of `field` in the `n` newest samples, oldest first. `n` is clamped to
    /// 65,536.
    ///
    /// # Errors
    ///
    /// `wrong-field` if the field is not a number or belongs to another topic; `malformed`.
    pub fn column(&self, field: &Field, n: u32) -> Result<Column> {
        Ok(into_result(self.0.column(&field.0, n))?.into())
    }

    /// Returns the values of `field` in all samples of the ring with [`Stamps::at_ns`] later than
    /// `since_ns`, oldest first; at most the newest 65,536.
    ///
    /// # Errors
    ///
    /// As [`Topic::column`].
    pub fn column_since(&self, field: &Field, since_ns: i64) -> Result<Column> {
        Ok(into_result(self.0.column_since(&field.0, since_ns))?.into())
    }
}

impl Field {
    /// Returns the path, as it was compiled.
    pub fn path(&self) -> String {
        self.0.path()
    }
}

impl Sample {
    /// Returns the unique identity of the sample: topic, writer and sequence number.
    pub fn identity(&self) -> Identity {
        self.0.identity()
    }

    /// Returns the timestamps of the sample, on three clocks.
    pub fn stamps(&self) -> Stamps {
        self.0.stamps()
    }

    /// Returns the value of a field, of any type.
    ///
    /// # Errors
    ///
    /// `wrong-field` if the field belongs to another topic or exceeds the length that one call can
    /// return (see [`Value`]; read such a field in pieces with [`cdr`](Self::cdr)); `malformed`.
    pub fn get(&self, field: &Field) -> Result<Value> {
        into_result(self.0.get(&field.0))
    }

    /// Returns the value of a numeric or boolean field, as a 64-bit float; true is 1.
    ///
    /// # Errors
    ///
    /// `wrong-field` if the field is not a number or belongs to another topic; `malformed`.
    pub fn number(&self, field: &Field) -> Result<f64> {
        into_result(self.0.number(&field.0))
    }

    /// Returns the size of the message in bytes, without the CDR encapsulation header.
    pub fn size(&self) -> u64 {
        self.0.size()
    }

    /// Returns whether the message is big-endian CDR.
    pub fn big_endian(&self) -> bool {
        self.0.big_endian()
    }

    /// Returns raw CDR bytes without the encapsulation header: `len` from `offset`, fewer only
    /// where the message ends. A call that would return more than 1 MiB is a fault: read a longer
    /// message in pieces.
    pub fn cdr(&self, offset: u64, len: u32) -> Vec<u8> {
        self.0.cdr(offset, len)
    }

    /// Returns the message as an image. The type must be `sensor_msgs/msg/Image` or
    /// `sensor_msgs/msg/CompressedImage`. This call decodes a JPEG or PNG to rgb8, and a grey PNG
    /// of 16 bits (also `16UC1; compressedDepth`) to mono16, once for each sample.
    ///
    /// # Errors
    ///
    /// `not-a-frame`, also for formats that are not decoded or contradict the bytes, such as
    /// `32FC1`, `h264`, RVL and PNG of 16 bits with colour; `no-room` if the decoded image exceeds
    /// `decoded_size`, all slots for decoded images are held, or the lambda holds as many frames as
    /// `frames` in `[limits]` allows; `malformed`.
    pub fn as_frame(&self) -> Result<Frame> {
        Ok(Frame(into_result(self.0.as_frame())?))
    }
}

impl Frame {
    /// Returns the size and pixel layout of the frame.
    pub fn info(&self) -> FrameInfo {
        self.0.info()
    }

    /// Returns the identity of the sample that the frame comes from, also after
    /// [`resize`](Self::resize) and [`to_gray`](Self::to_gray).
    pub fn identity(&self) -> Identity {
        self.0.identity()
    }

    /// Returns the timestamps of the sample that the frame comes from.
    pub fn stamps(&self) -> Stamps {
        self.0.stamps()
    }

    /// Returns the mean luma (ITU-R BT.601), 0 to 255, of the whole frame or of `roi`. It is
    /// computed with integers, so it is the same on every CPU.
    ///
    /// # Errors
    ///
    /// `out-of-range` if `roi` has no pixel in the frame; `not-a-frame` for Bayer encodings.
    pub fn mean_luma(&self, roi: Option<Roi>) -> Result<f64> {
        into_result(self.0.mean_luma(roi))
    }

    /// Returns the number of pixels at each of the 256 luma levels. Luma is rounded down; that of a
    /// 16-bit pixel is its high byte.
    ///
    /// # Errors
    ///
    /// As [`Frame::mean_luma`].
    pub fn histogram(&self, roi: Option<Roi>) -> Result<Vec<u32>> {
        into_result(self.0.histogram(roi))
    }

    /// Creates a frame of `width` by `height` pixels, each side 1 to 16,384. Its encoding is rgb8,
    /// or mono8 if this frame is of mono8. A new pixel is the mean of the area that it covers where
    /// the frame shrinks, and a linear interpolation where it grows.
    ///
    /// # Errors
    ///
    /// `out-of-range`; `no-room` if the frames that the lambda created would together exceed
    /// `memory` in `[limits]`, or the lambda holds as many frames as `frames` allows; `not-a-frame`
    /// for Bayer encodings, and for mono16, whose values would lose 8 bits.
    pub fn resize(&self, width: u32, height: u32) -> Result<Frame> {
        Ok(Frame(into_result(self.0.resize(width, height))?))
    }

    /// Creates a mono8 frame of the same size. Luma is rounded down; that of a 16-bit pixel is its
    /// high byte.
    ///
    /// # Errors
    ///
    /// `no-room`, as [`resize`](Self::resize); `not-a-frame` for Bayer encodings.
    pub fn to_gray(&self) -> Result<Frame> {
        Ok(Frame(into_result(self.0.to_gray())?))
    }

    /// Returns pixel bytes: `len` from `offset`, fewer only where the frame ends. A call that would
    /// return more than 1 MiB is a fault. Reading in pieces of 64 KiB is fastest.
    pub fn read(&self, offset: u64, len: u32) -> Vec<u8> {
        self.0.read(offset, len)
    }

    /// Copies all pixel bytes to `out`, in pieces of 64 KiB.
    ///
    /// # Errors
    ///
    /// If the length of `out` is not `info().size`.
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

    /// Returns the pixel bytes of each row from top to bottom, without padding.
    pub fn rows(&self) -> impl Iterator<Item = Vec<u8>> {
        let FrameInfo { width, height, step, encoding, .. } = self.info();
        let row_bytes = width * bytes_per_pixel(encoding);
        (0..height).map(move |y| self.read(u64::from(y) * u64::from(step), row_bytes))
    }
}

/// Returns the ROS name of an encoding.
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

/// Returns the number of bytes per pixel.
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
    /// Returns the number of values.
    pub fn len(&self) -> usize {
        self.values.len()
    }

    /// Returns whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Returns the arithmetic mean; none if there are no values.
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

    /// Returns pairs of stamp, in nanoseconds, and value, oldest first.
    pub fn iter(&self) -> impl DoubleEndedIterator<Item = (i64, f64)> + '_ {
        self.at_ns.iter().copied().zip(self.values.iter().copied())
    }
}

impl From<crate::world::gleaner::lambda::types::Column> for Column {
    fn from(column: crate::world::gleaner::lambda::types::Column) -> Self {
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
