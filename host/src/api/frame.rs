//! Frames: samples as images. Raw pixels are used in place; JPEG and PNG are decoded on demand into
//! separate slots. Grey of 16 bits keeps them; only `to_gray` makes 8 of them.

use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::Instant;

use gleaner_buffers::{DraftError, Lease, Pool};
use gleaner_messages::{CompressedView, ImageView};

use super::data::{DataError, Identity, Sample, Stamps};
use super::images::ImageMessage;
pub use super::images::{Images, Info};
use super::shared_bytes::SharedBytes;
use gleaner_pixels::{
    self as image, Encoding, ImageError, PixelError, PixelErrorKind, Roi, StopCheck, View, ops,
};
pub use gleaner_rules::frames::Budget;
use gleaner_rules::frames::FrameLease;

/// Bytes of pixels that the fastest machine decodes per microsecond: four times the measured speed
/// (0.5 GB/s on an x86-64 server).
const FASTEST_DECODE: u64 = 2_000;

/// Number of bytes that are copied in the time of processing one, at 22 GB/s for a copy, of which 8
/// bytes take as long as a unit of fuel. Measured on an x86-64 server: 2.7 and 4.3 to 41 GB/s, and
/// 0.5 GB/s for decoding, which costs `images::DECODE`.
const HISTOGRAM: u64 = 8;
const GRAY: u64 = 4;

/// An operation on the pixels of a frame. [`Frame::work`] has the price of each.
#[derive(Clone, Copy)]
enum PixelOperation {
    MeanLuma(Option<Roi>),
    Histogram(Option<Roi>),
    ToGray,
    /// Width and height of the result.
    Resize(u32, u32),
}

/// A sample as an image. Holds its pixels until dropped.
pub struct Frame {
    source: FrameOrigin,
    info: Info,
    pixels: SharedBytes,
    _taken: FrameLease,
}

/// The sample of a frame: its topic, identity and stamps, without its slot.
#[derive(Clone)]
struct FrameOrigin {
    topic: Arc<super::data::Topic>,
    identity: Identity,
    stamps: Stamps,
}

impl Frame {
    pub(super) fn of(sample: &Sample) -> Result<Self, DataError> {
        let source = FrameOrigin {
            topic: Arc::clone(sample.topic()),
            identity: sample.identity(),
            stamps: sample.stamps(),
        };
        let picture = sample.picture()?;
        let taken = source.topic.images.budget.take(0)?;
        match picture {
            ImageMessage::Raw(raw) => Self::raw(source, sample, &raw, taken),
            ImageMessage::Compressed(compressed) => {
                Self::decoded(source, sample, &compressed, taken)
            }
        }
    }

    fn raw(
        source: FrameOrigin,
        sample: &Sample,
        raw: &ImageView<'_>,
        taken: FrameLease,
    ) -> Result<Self, DataError> {
        let encoding =
            Encoding::from_ros(raw.encoding).map_err(|error| source.not_a_frame(error))?;
        let info = Info {
            width: raw.width,
            height: raw.height,
            encoding,
            step: raw.step,
            big_endian: raw.is_bigendian,
        };
        let view = info.view(raw.data).map_err(|error| source.not_a_frame(error))?;
        // The pixels were borrowed from the message, so they lie within it.
        let start = raw.data.as_ptr().addr() - sample.bytes().as_ptr().addr();
        let pixels = SharedBytes::of_message(sample.lease()).part(start as u64, view.bytes().len());
        Ok(Self { source, info, pixels, _taken: taken })
    }

    fn decoded(
        source: FrameOrigin,
        sample: &Sample,
        compressed: &CompressedView<'_>,
        taken: FrameLease,
    ) -> Result<Self, DataError> {
        let owner = Arc::clone(&source.topic);
        let images = &owner.images;
        let Some(pool) = &images.decoded else {
            let (topic, type_name) =
                (source.identity.topic.clone(), source.topic.type_name().to_owned());
            return Err(DataError::NoImageType { topic, type_name });
        };
        let mut newest = images.newest.lock().unwrap_or_else(PoisonError::into_inner);
        let position = sample.lease().position();
        if let Some((_, lease)) = newest.as_ref().filter(|(at, _)| Some(*at) == position) {
            return Ok(Self::of_decoded(source, lease.clone(), taken));
        }
        // The older image's slot may be the one that is needed now.
        *newest = None;
        let started = Instant::now();
        let bytes = image::probe_message(compressed.format, compressed.data)
            .ok()
            .and_then(|(header, _)| header.rgb8_len())
            .map_or(0, |len| len.min(pool.slot_bytes()));
        owner.per_call.due.allows(bytes, FASTEST_DECODE)?;
        let lease = decode(&source, pool, compressed)?;
        images.decode_ns.fetch_add(started.elapsed().as_nanos() as u64, Ordering::Relaxed);
        *newest = position.map(|position| (position, lease.clone()));
        Ok(Self::of_decoded(source, lease, taken))
    }

    fn of_decoded(source: FrameOrigin, lease: Lease<Info>, taken: FrameLease) -> Self {
        Self { source, info: *lease.meta(), pixels: SharedBytes::of_decoded(lease), _taken: taken }
    }

    pub fn info(&self) -> Info {
        self.info
    }

    pub fn identity(&self) -> &Identity {
        &self.source.identity
    }

    pub fn stamps(&self) -> Stamps {
        self.source.stamps
    }

    /// Work of an operation, as the number of bytes that are copied in the same time: the price of
    /// a call, equal on every machine.
    fn work(&self, operation: PixelOperation) -> usize {
        let work = self.view().and_then(|view| {
            let work = match operation {
                PixelOperation::MeanLuma(roi) => ops::work(&view, roi),
                PixelOperation::Histogram(roi) => {
                    ops::work(&view, roi).map(|bytes| HISTOGRAM * bytes)
                }
                PixelOperation::ToGray => ops::work(&view, None).map(|bytes| GRAY * bytes),
                PixelOperation::Resize(width, height) => ops::resized(&view, width, height)
                    .and_then(|(_, bytes)| {
                        let has_room = self.source.topic.images.budget.has(bytes);
                        if has_room { ops::resize_work(&view, width, height) } else { Ok(0) }
                    }),
            };
            work.map_err(|error| self.source.refused(error))
        });
        // A refused operation costs as much as reading the frame.
        work.map_or(self.bytes().len(), |work| usize::try_from(work).unwrap_or(usize::MAX))
    }

    /// All pixel bytes: `step * (height - 1)` and the last row.
    pub fn bytes(&self) -> &[u8] {
        &self.pixels
    }

    /// Bytes from `offset`: `len`, or fewer where the frame ends.
    ///
    /// # Errors
    ///
    /// [`DataError::TooLong`] for more than `call_bytes` of `[limits]`; [`DataError::OutOfFuel`].
    pub fn read(&self, offset: u64, len: u32) -> Result<SharedBytes, DataError> {
        let FrameOrigin { topic, identity, .. } = &self.source;
        topic.per_call.piece(&self.pixels, (offset, len), "frame", &identity.topic)
    }

    /// Mean BT.601 luma, 0 to 255, computed in integers.
    ///
    /// # Errors
    ///
    /// [`DataError::OutOfRange`] for a region outside the frame; [`DataError::NotAFrame`] for Bayer
    /// encodings; [`DataError::OutOfTime`].
    pub fn mean_luma(&self, roi: Option<Roi>) -> Result<f64, DataError> {
        let luma =
            self.begin(PixelOperation::MeanLuma(roi))?.work(|view| ops::mean_luma(view, roi))?;
        self.source.draw_luma(roi, luma);
        Ok(luma)
    }

    /// Counts of the 256 luma levels. Fails as [`Frame::mean_luma`].
    pub fn histogram(&self, roi: Option<Roi>) -> Result<[u32; 256], DataError> {
        self.begin(PixelOperation::Histogram(roi))?.work(|view| ops::histogram(view, roi))
    }

    /// Charges an operation, and returns access to the pixels.
    fn begin(&self, operation: PixelOperation) -> Result<Paid<'_>, DataError> {
        self.source.topic.per_call.charge(|| self.work(operation))?;
        Ok(Paid(self))
    }

    /// Returns a new frame of that size: rgb8, or mono8 for one of mono8.
    ///
    /// # Errors
    ///
    /// [`DataError::OutOfRange`] for sides of 0 or above [`ops::MAX_RESIZED_SIDE`];
    /// [`DataError::NoRoom`]; [`DataError::NotAFrame`] for mono16; as [`Frame::mean_luma`].
    pub fn resize(&self, width: u32, height: u32) -> Result<Self, DataError> {
        let paid = self.begin(PixelOperation::Resize(width, height))?;
        if self.info.encoding == Encoding::Mono16 {
            return Err(self.source.not_a_frame(ImageError::ResizeOfMono16));
        }
        let (encoding, _) = ops::resized(&self.view()?, width, height)
            .map_err(|error| self.source.refused(error))?;
        let info = Info::tight(width, height, encoding);
        paid.make(info, |view, out| ops::resize(view, width, height, out).map(drop))
    }

    /// Returns a new mono8 frame of the same size; of 16 bits, their high byte.
    ///
    /// # Errors
    ///
    /// [`DataError::NoRoom`]; as [`Frame::mean_luma`].
    pub fn to_gray(&self) -> Result<Self, DataError> {
        let paid = self.begin(PixelOperation::ToGray)?;
        paid.make(Info::tight(self.info.width, self.info.height, Encoding::Mono8), ops::to_gray)
    }

    /// Returns all pixels, for an operation that was charged, and that checks the deadline.
    pub(super) fn whole(&self) -> Result<View<'_>, DataError> {
        self.source.topic.per_call.due.check()?;
        self.view()
    }

    fn view(&self) -> Result<View<'_>, DataError> {
        self.info.view(self.bytes()).map_err(|error| self.source.not_a_frame(error))
    }
}

/// Access to the pixels of a frame for an operation that was charged.
struct Paid<'a>(&'a Frame);

impl Paid<'_> {
    /// Runs `work` on the pixels, until the call is due.
    fn work<T>(
        self,
        work: impl FnOnce(&View<'_>) -> Result<T, PixelError>,
    ) -> Result<T, DataError> {
        let source = &self.0.source;
        let in_time = || source.topic.per_call.due.check().is_ok();
        work(&self.0.view()?.with_stop_check(&StopCheck::new(&in_time)))
            .map_err(|error| source.refused(error))
    }

    fn make(
        self,
        info: Info,
        fill: impl FnOnce(&View<'_>, &mut [u8]) -> Result<(), PixelError>,
    ) -> Result<Frame, DataError> {
        let source = self.0.source.clone();
        let len = info.step as usize * info.height as usize;
        let taken = source.topic.images.budget.take(len)?;
        let mut bytes = vec![0; len].into_boxed_slice();
        self.work(|view| fill(view, &mut bytes))?;
        Ok(Frame { source, info, pixels: SharedBytes::owned(bytes), _taken: taken })
    }
}

impl FrameOrigin {
    fn draw_luma(&self, roi: Option<Roi>, luma: f64) {
        let name = || match roi {
            None => "mean luma".to_owned(),
            Some(Roi { x, y, width, height }) => {
                format!("mean luma of {width}x{height} at {x},{y}")
            }
        };
        if let Some(writer) = self.topic.curve_writer(name) {
            writer.number(self.stamps.at_ns, luma);
        }
    }

    fn not_a_frame(&self, source: impl Into<ImageError>) -> DataError {
        DataError::NotAFrame { topic: self.identity.topic.clone(), source: source.into() }
    }

    fn refused(&self, error: impl Into<ImageError>) -> DataError {
        let error = error.into();
        match error.kind() {
            PixelErrorKind::OutOfRange => DataError::OutOfRange(error),
            PixelErrorKind::Stopped => DataError::OutOfTime,
            PixelErrorKind::Unreadable => self.not_a_frame(error),
        }
    }
}

fn decode(
    source: &FrameOrigin,
    pool: &Pool<Info>,
    compressed: &CompressedView<'_>,
) -> Result<Lease<Info>, DataError> {
    let topic = || source.identity.topic.clone();
    let (header, file) = image::probe_message(compressed.format, compressed.data)
        .map_err(|error| source.not_a_frame(error))?;
    let allowed = pool.slot_bytes();
    let too_large = || {
        let (width, height) = (header.width, header.height);
        let needed = 3 * u64::from(width) * u64::from(height);
        DataError::TooLarge {
            topic: topic(),
            source: ImageError::Bomb { width, height, needed, allowed },
        }
    };
    // `decoded_size` counts rgb8, whatever the image becomes.
    header.rgb8_len().filter(|len| *len <= allowed).ok_or_else(too_large)?;
    let len = header.decoded_len().ok_or_else(too_large)?;
    let mut draft = pool.draft(len).map_err(|refusal| match refusal {
        DraftError::NoSlot => {
            DataError::NoSlot { topic: topic(), input: source.topic.name().to_owned() }
        }
        DraftError::TooBig { .. } => too_large(),
    })?;
    let in_time = || source.topic.per_call.due.check().is_ok();
    image::decode(file, &header, allowed, &mut draft, &StopCheck::new(&in_time))
        .map_err(|error| source.refused(error))?;
    Ok(draft.seal(Info::tight(header.width, header.height, header.encoding)))
}
