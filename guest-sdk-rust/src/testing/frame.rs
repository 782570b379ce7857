//! A sample seen as an image: its pixels, and the room for those that are decoded or made.

use std::sync::{Arc, Mutex, PoisonError, Weak};

use super::data::{Sample, Source};
use super::manifest::{Input, Limits};
use super::message::Picture;
use super::piece;
use super::pixels::{PixelError, View, encoding_of};
use super::ring::Cell;
use super::session::Handle;
use super::types::{DataError, Encoding, FrameInfo, Identity, Roi, Stamps, Value};
use crate::data::bytes_per_pixel;

type Answer<T> = Result<T, DataError>;

/// Frames that a lambda may hold at a time, of all inputs, and bytes of those that it made.
pub(super) struct Budget {
    frames_allowed: usize,
    left: Mutex<(usize, usize)>,
}

/// A frame that is held, and what it takes; given back when it is dropped.
struct Taken {
    budget: Arc<Budget>,
    bytes: usize,
}

impl Budget {
    pub(super) fn new(limits: &Limits) -> Arc<Self> {
        Arc::new(Self { frames_allowed: limits.frames, left: Mutex::new((limits.frames, limits.memory)) })
    }

    fn take(self: &Arc<Self>, bytes: usize) -> Answer<Taken> {
        let (frames, left) = &mut *self.left.lock().unwrap_or_else(PoisonError::into_inner);
        let way_out = |limit: &str| format!("drop frames that are not needed, or raise `{limit}` in [limits]");
        if *frames == 0 {
            let held = self.frames_allowed;
            return Err(DataError::NoRoom(format!("the lambda holds {held} frames; {}", way_out("frames"))));
        }
        if bytes > *left {
            let why = format!("{bytes} bytes for a new frame, {left} are left; {}", way_out("memory"));
            return Err(DataError::NoRoom(why));
        }
        (*frames, *left) = (*frames - 1, *left - bytes);
        Ok(Taken { budget: Arc::clone(self), bytes })
    }
}

impl Drop for Taken {
    fn drop(&mut self) {
        let (frames, left) = &mut *self.budget.left.lock().unwrap_or_else(PoisonError::into_inner);
        (*frames, *left) = (*frames + 1, *left + self.bytes);
    }
}

/// Room for the images of one input.
pub(super) struct Images {
    budget: Arc<Budget>,
    slots: usize,
    slot_bytes: u64,
    decoded: Mutex<Decoded>,
}

/// Slots of decoded images.
#[derive(Default)]
struct Decoded {
    held: Vec<Weak<Slot>>,
    /// The newest, so that each is decoded once.
    newest: Option<(u64, Arc<Slot>)>,
}

struct Slot(Arc<[u8]>);

impl Images {
    pub(super) fn new(declared: &Input, budget: Arc<Budget>) -> Self {
        let (slots, slot_bytes) = (declared.hold + 1, declared.decoded_size);
        Self { budget, slots, slot_bytes, decoded: Mutex::default() }
    }

    fn slot(&self, declared: &Input, position: u64, picture: &Picture) -> Answer<Arc<Slot>> {
        let decoded = &mut *self.decoded.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, slot)) = decoded.newest.as_ref().filter(|(at, _)| *at == position) {
            return Ok(Arc::clone(slot));
        }
        // The older image's slot may be the one that is needed now.
        decoded.newest = None;
        let (topic, width, height) = (&declared.topic, picture.width, picture.height);
        let needed = 3 * u64::from(width) * u64::from(height);
        if needed > self.slot_bytes {
            let allowed = self.slot_bytes;
            return Err(DataError::NoRoom(format!(
                "an image of `{topic}` is too large: image says it is {width}x{height} ({needed} bytes as rgb8); this input's \
                 decoded_size is {allowed} bytes"
            )));
        }
        decoded.held.retain(|slot| slot.strong_count() > 0);
        if decoded.held.len() >= self.slots {
            let way_out = format!("drop frames that are not needed, or raise `hold` of input `{}`", declared.name);
            return Err(DataError::NoRoom(format!("every slot for decoded images of `{topic}` is held; {way_out}")));
        }
        let slot = Arc::new(Slot(Arc::clone(&picture.data)));
        decoded.held.push(Arc::downgrade(&slot));
        decoded.newest = Some((position, Arc::clone(&slot)));
        Ok(slot)
    }
}

/// A sample seen as an image. Holds its pixels until dropped.
pub struct Frame {
    source: Arc<Source>,
    identity: Identity,
    stamps: Stamps,
    info: FrameInfo,
    pixels: Pixels,
    _taken: Taken,
    _handle: Handle,
}

enum Pixels {
    /// In the message, which stays in its cell.
    Message(Arc<Cell>),
    Decoded(Arc<Slot>),
    Made(Vec<u8>),
}

impl Frame {
    pub(super) fn of(sample: &Sample) -> Answer<Self> {
        let source = Arc::clone(&sample.source);
        let Input { topic, type_name, .. } = &source.declared;
        let is_compressed = match type_name.as_str() {
            "sensor_msgs/msg/Image" => false,
            "sensor_msgs/msg/CompressedImage" => true,
            _ => {
                let why = format!("a sample of `{topic}` is no image: its type is `{type_name}`");
                return Err(DataError::NotAFrame(why));
            }
        };
        let taken = source.images.budget.take(0)?;
        let (info, pixels) = match is_compressed {
            true => decoded(sample)?,
            false => (raw(sample)?, Pixels::Message(Arc::clone(&sample.cell))),
        };
        Ok(Self::new((source, sample.identity(), sample.stamps()), info, pixels, taken))
    }

    fn new(
        (source, identity, stamps): (Arc<Source>, Identity, Stamps),
        info: FrameInfo,
        pixels: Pixels,
        taken: Taken,
    ) -> Self {
        let handle = source.handles.hand_out();
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

    pub(crate) fn mean_luma(&self, roi: Option<Roi>) -> Answer<f64> {
        self.view()?.mean_luma(roi).map_err(|error| self.refused(error))
    }

    pub(crate) fn histogram(&self, roi: Option<Roi>) -> Answer<Vec<u32>> {
        self.view()?.histogram(roi).map_err(|error| self.refused(error))
    }

    pub(crate) fn resize(&self, width: u32, height: u32) -> Answer<Self> {
        let view = self.view()?;
        let encoding = view.resized(width, height).map_err(|error| self.refused(error))?;
        self.made((width, height), encoding, || view.resize(width, height))
    }

    pub(crate) fn to_gray(&self) -> Answer<Self> {
        let view = self.view()?;
        self.made((self.info.width, self.info.height), Encoding::Mono8, || view.to_gray())
    }

    /// Room is taken before anything is made.
    fn made(
        &self,
        (width, height): (u32, u32),
        encoding: Encoding,
        make: impl FnOnce() -> Result<Vec<u8>, PixelError>,
    ) -> Answer<Self> {
        let info = tight(width, height, encoding);
        let taken = self.source.images.budget.take(info.size as usize)?;
        let pixels = Pixels::Made(make().map_err(|error| self.refused(error))?);
        let about = (Arc::clone(&self.source), self.identity(), self.stamps);
        Ok(Self::new(about, info, pixels, taken))
    }

    pub(crate) fn read(&self, offset: u64, len: u32) -> Vec<u8> {
        piece(self.bytes(), offset, (len as usize).min(self.source.limits.call_bytes)).to_vec()
    }

    fn bytes(&self) -> &[u8] {
        let whole: &[u8] = match &self.pixels {
            Pixels::Made(bytes) => bytes,
            Pixels::Decoded(slot) => &slot.0,
            Pixels::Message(cell) => match cell.arrival.message.fields.get("data") {
                Some(Value::Bytes(bytes)) => bytes,
                _ => &[],
            },
        };
        &whole[..(self.info.size as usize).min(whole.len())]
    }

    fn view(&self) -> Answer<View<'_>> {
        let FrameInfo { width, height, encoding, step, big_endian, .. } = self.info;
        View::new((width, height), encoding, step, big_endian, self.bytes()).map_err(|error| self.refused(error))
    }

    fn refused(&self, error: PixelError) -> DataError {
        refused(&self.identity.topic, error)
    }
}

fn refused(topic: &str, error: PixelError) -> DataError {
    match error {
        PixelError::OutOfRange(why) => DataError::OutOfRange(why),
        PixelError::NotAFrame(why) => {
            DataError::NotAFrame(format!("a sample of `{topic}` is no image that can be read: {why}"))
        }
    }
}

fn tight(width: u32, height: u32, encoding: Encoding) -> FrameInfo {
    let step = width * bytes_per_pixel(encoding);
    let size = u64::from(step) * u64::from(height);
    FrameInfo { width, height, encoding, step, big_endian: false, size }
}

/// The pixels of a `sensor_msgs/msg/Image`, by its fields.
fn raw(sample: &Sample) -> Answer<FrameInfo> {
    let number = |path: &str| {
        let number = match sample.need(path)? {
            Value::Boolean(value) => Some(u64::from(*value)),
            Value::Unsigned(value) => Some(*value),
            Value::Signed(value) => u64::try_from(*value).ok(),
            _ => None,
        };
        number.and_then(|number| u32::try_from(number).ok()).ok_or_else(|| sample.wrong_sort(path))
    };
    let Value::Text(encoding) = sample.need("encoding")? else { return Err(sample.wrong_sort("encoding")) };
    let Value::Bytes(data) = sample.need("data")? else { return Err(sample.wrong_sort("data")) };
    let (size, step, big_endian) =
        ((number("width")?, number("height")?), number("step")?, number("is_bigendian")? != 0);
    let view = encoding_of(encoding).and_then(|encoding| View::new(size, encoding, step, big_endian, data));
    let view = view.map_err(|error| refused(&sample.source.declared.topic, error))?;
    let (width, height, encoding, size) = (view.width, view.height, view.encoding, view.data.len() as u64);
    Ok(FrameInfo { width, height, encoding, step, big_endian, size })
}

/// The pixels that stand for a JPEG or PNG.
fn decoded(sample: &Sample) -> Answer<(FrameInfo, Pixels)> {
    let source = &sample.source;
    let Some(picture) = &sample.cell.arrival.message.picture else {
        let why = "nobody here decodes JPEG or PNG; make the message with `Message::image`, of the pixels".to_owned();
        return Err(refused(&source.declared.topic, PixelError::NotAFrame(why)));
    };
    let slot = source.images.slot(&source.declared, sample.cell.position, picture)?;
    Ok((tight(picture.width, picture.height, picture.encoding), Pixels::Decoded(slot)))
}
