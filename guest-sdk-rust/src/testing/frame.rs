//! A sample as an image: its pixels, and the memory limits of decoded and created frames.

use std::sync::{Arc, Mutex, PoisonError, Weak};

use gleaner_rules::frames::{Budget, FrameLease, NoRoom};
use gleaner_rules::names::{COMPRESSED_IMAGE, IMAGE};
use gleaner_rules::pixels::{self as rules, Bayer, PixelError, PixelErrorKind, View, ops};
use gleaner_rules::refused;

use super::data::{InputState, Sample};
use super::manifest::Input;
use super::message::ImageData;
use super::ring::Cell;
use super::session::Handle;
use crate::data::{
    DataError, Encoding, FrameInfo, Identity, Roi, Stamps, Value, bytes_per_pixel, encoding_name,
};

type CallResult<T> = Result<T, DataError>;

/// Limits and decoded images of one input.
pub(super) struct FramePool {
    budget: Budget,
    slots: usize,
    slot_bytes: u64,
    decoded: Mutex<DecodedSlots>,
}

/// Slots for decoded images.
#[derive(Default)]
struct DecodedSlots {
    held: Vec<Weak<DecodedImage>>,
    /// The newest image and its position, so that each is decoded once.
    newest: Option<(u64, Arc<DecodedImage>)>,
}

struct DecodedImage(Arc<[u8]>);

impl FramePool {
    pub(super) fn new(declared: &Input, budget: Budget) -> Self {
        let (slots, slot_bytes) = (declared.hold + 1, declared.decoded_size);
        Self { budget, slots, slot_bytes, decoded: Mutex::default() }
    }

    fn slot(
        &self,
        declared: &Input,
        position: u64,
        picture: &ImageData,
    ) -> CallResult<Arc<DecodedImage>> {
        let decoded = &mut *self.decoded.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, slot)) = decoded.newest.as_ref().filter(|(at, _)| *at == position) {
            return Ok(Arc::clone(slot));
        }
        // Release the previous image first: its slot may be needed now.
        decoded.newest = None;
        let (topic, width, height) = (&declared.topic, picture.width, picture.height);
        let needed = 3 * u64::from(width) * u64::from(height);
        if needed > self.slot_bytes {
            let allowed = self.slot_bytes;
            let why = refused::too_many_pixels((width, height), needed, allowed);
            return Err(DataError::NoRoom(refused::too_large(topic, why)));
        }
        decoded.held.retain(|slot| slot.strong_count() > 0);
        if decoded.held.len() >= self.slots {
            return Err(DataError::NoRoom(refused::no_slot(topic, &declared.name)));
        }
        let slot = Arc::new(DecodedImage(Arc::clone(&picture.data)));
        decoded.held.push(Arc::downgrade(&slot));
        decoded.newest = Some((position, Arc::clone(&slot)));
        Ok(slot)
    }
}

/// A sample as an image. Keeps its pixels until dropped.
pub struct Frame {
    source: Arc<InputState>,
    identity: Identity,
    stamps: Stamps,
    info: FrameInfo,
    pixels: PixelData,
    _taken: FrameLease,
    _handle: Handle,
}

enum PixelData {
    /// Pixels of the message, which stays in its cell.
    Message(Arc<Cell>),
    Decoded(Arc<DecodedImage>),
    Made(Vec<u8>),
}

impl Frame {
    pub(super) fn of(sample: &Sample) -> CallResult<Self> {
        let source = Arc::clone(&sample.source);
        let Input { topic, type_name, .. } = &source.declared;
        let is_compressed = match type_name.as_str() {
            IMAGE => false,
            COMPRESSED_IMAGE => true,
            _ => {
                return Err(DataError::NotAFrame(refused::no_image_type(topic, type_name)));
            }
        };
        let taken = source.frame_pool.budget.take(0)?;
        let (info, pixels) = match is_compressed {
            true => decoded(sample)?,
            false => (raw(sample)?, PixelData::Message(Arc::clone(&sample.cell))),
        };
        Ok(Self::new((source, sample.identity(), sample.stamps()), info, pixels, taken))
    }

    fn new(
        (source, identity, stamps): (Arc<InputState>, Identity, Stamps),
        info: FrameInfo,
        pixels: PixelData,
        taken: FrameLease,
    ) -> Self {
        let handle = source.handles.acquire();
        Self { source, identity, stamps, info, pixels, _taken: taken, _handle: handle }
    }

    pub(crate) fn info(&self) -> FrameInfo {
        self.info
    }

    pub(crate) fn identity(&self) -> Identity {
        self.identity.clone()
    }

    pub(crate) fn stamps(&self) -> Stamps {
        self.stamps
    }

    pub(crate) fn mean_luma(&self, roi: Option<Roi>) -> CallResult<f64> {
        ops::mean_luma(&self.view()?, roi.map(region)).map_err(|error| self.refused(error))
    }

    pub(crate) fn histogram(&self, roi: Option<Roi>) -> CallResult<Vec<u32>> {
        ops::histogram(&self.view()?, roi.map(region))
            .map(Vec::from)
            .map_err(|error| self.refused(error))
    }

    pub(crate) fn resize(&self, width: u32, height: u32) -> CallResult<Self> {
        let view = self.view()?;
        if view.encoding() == rules::Encoding::Mono16 {
            let why = "resize of mono16 would keep 8 of its 16 bits: call `to_gray` first, or read \
                       its pixels";
            return Err(DataError::NotAFrame(refused::not_a_frame(&self.identity.topic, why)));
        }
        let (encoding, _) =
            ops::resized(&view, width, height).map_err(|error| self.refused(error))?;
        self.made((width, height), encoding, |out| ops::resize(&view, width, height, out).map(drop))
    }

    pub(crate) fn to_gray(&self) -> CallResult<Self> {
        let view = self.view()?;
        self.made((self.info.width, self.info.height), rules::Encoding::Mono8, |out| {
            ops::to_gray(&view, out)
        })
    }

    /// Creates a frame. Memory is taken from the budget before the pixels are allocated.
    fn made(
        &self,
        (width, height): (u32, u32),
        encoding: rules::Encoding,
        fill: impl FnOnce(&mut [u8]) -> Result<(), PixelError>,
    ) -> CallResult<Self> {
        let info = tight(width, height, of_rules(encoding));
        let taken = self.source.frame_pool.budget.take(info.size as usize)?;
        let mut pixels = vec![0; info.size as usize];
        fill(&mut pixels).map_err(|error| self.refused(error))?;
        let pixels = PixelData::Made(pixels);
        let about = (Arc::clone(&self.source), self.identity(), self.stamps);
        Ok(Self::new(about, info, pixels, taken))
    }

    pub(crate) fn read(&self, offset: u64, len: u32) -> Vec<u8> {
        self.source.requested(self.bytes(), (offset, len), "frame")
    }

    fn bytes(&self) -> &[u8] {
        let whole: &[u8] = match &self.pixels {
            PixelData::Made(bytes) => bytes,
            PixelData::Decoded(slot) => &slot.0,
            PixelData::Message(cell) => match cell.sample.message.fields.get("data") {
                Some(Value::Bytes(bytes)) => bytes,
                _ => &[],
            },
        };
        &whole[..(self.info.size as usize).min(whole.len())]
    }

    fn view(&self) -> CallResult<View<'_>> {
        let FrameInfo { width, height, encoding, step, big_endian, .. } = self.info;
        View::new(width, height, step, by_rules(encoding), big_endian, self.bytes())
            .map_err(|error| self.refused(error))
    }

    fn refused(&self, error: PixelError) -> DataError {
        refuse(&self.identity.topic, error)
    }
}

fn refuse(topic: &str, error: PixelError) -> DataError {
    match error.kind() == PixelErrorKind::OutOfRange {
        true => DataError::OutOfRange(error.to_string()),
        false => DataError::NotAFrame(refused::not_a_frame(topic, error)),
    }
}

impl From<NoRoom> for DataError {
    fn from(no_room: NoRoom) -> Self {
        Self::NoRoom(no_room.to_string())
    }
}

fn region(Roi { x, y, width, height }: Roi) -> rules::Roi {
    rules::Roi { x, y, width, height }
}

fn by_rules(encoding: Encoding) -> rules::Encoding {
    rules::Encoding::from_ros(encoding_name(encoding)).expect("each name is one of ROS")
}

fn of_rules(encoding: rules::Encoding) -> Encoding {
    match encoding {
        rules::Encoding::Rgb8 => Encoding::Rgb8,
        rules::Encoding::Bgr8 => Encoding::Bgr8,
        rules::Encoding::Rgba8 => Encoding::Rgba8,
        rules::Encoding::Bgra8 => Encoding::Bgra8,
        rules::Encoding::Mono8 => Encoding::Mono8,
        rules::Encoding::Mono16 => Encoding::Mono16,
        rules::Encoding::Yuv422Uyvy => Encoding::Yuv422,
        rules::Encoding::Yuv422Yuyv => Encoding::Yuv422Yuy2,
        rules::Encoding::Bayer8(Bayer::Rggb) => Encoding::BayerRggb8,
        rules::Encoding::Bayer8(Bayer::Bggr) => Encoding::BayerBggr8,
        rules::Encoding::Bayer8(Bayer::Gbrg) => Encoding::BayerGbrg8,
        rules::Encoding::Bayer8(Bayer::Grbg) => Encoding::BayerGrbg8,
        rules::Encoding::Bayer16(Bayer::Rggb) => Encoding::BayerRggb16,
        rules::Encoding::Bayer16(Bayer::Bggr) => Encoding::BayerBggr16,
        rules::Encoding::Bayer16(Bayer::Gbrg) => Encoding::BayerGbrg16,
        rules::Encoding::Bayer16(Bayer::Grbg) => Encoding::BayerGrbg16,
    }
}

fn tight(width: u32, height: u32, encoding: Encoding) -> FrameInfo {
    let step = width * bytes_per_pixel(encoding);
    let size = u64::from(step) * u64::from(height);
    FrameInfo { width, height, encoding, step, big_endian: false, size }
}

/// Returns the layout of a `sensor_msgs/msg/Image`, from its fields.
fn raw(sample: &Sample) -> CallResult<FrameInfo> {
    let number = |path: &str| {
        let number = match sample.need(path)? {
            Value::Boolean(value) => Some(u64::from(*value)),
            Value::Unsigned(value) => Some(*value),
            Value::Signed(value) => u64::try_from(*value).ok(),
            _ => None,
        };
        number.and_then(|number| u32::try_from(number).ok()).ok_or_else(|| sample.wrong_type(path))
    };
    let Value::Text(encoding) = sample.need("encoding")? else {
        return Err(sample.wrong_type("encoding"));
    };
    let Value::Bytes(data) = sample.need("data")? else { return Err(sample.wrong_type("data")) };
    let (width, height) = (number("width")?, number("height")?);
    let (step, big_endian) = (number("step")?, number("is_bigendian")? != 0);
    let view = rules::Encoding::from_ros(encoding)
        .and_then(|encoding| View::new(width, height, step, encoding, big_endian, data))
        .map_err(|error| refuse(&sample.source.declared.topic, error))?;
    let (encoding, size) = (of_rules(view.encoding()), view.bytes().len() as u64);
    Ok(FrameInfo { width, height, encoding, step, big_endian, size })
}

/// Returns the pixels that the test set in place of a JPEG or PNG.
fn decoded(sample: &Sample) -> CallResult<(FrameInfo, PixelData)> {
    let source = &sample.source;
    let Some(picture) = &sample.cell.sample.message.picture else {
        let why = "JPEG and PNG are not decoded here; create the message with `Message::image`, \
                   from pixels";
        return Err(DataError::NotAFrame(refused::not_a_frame(&source.declared.topic, why)));
    };
    let slot = source.frame_pool.slot(&source.declared, sample.cell.position, picture)?;
    Ok((tight(picture.width, picture.height, picture.encoding), PixelData::Decoded(slot)))
}
