//! Images of an input before they are frames: their shape, their messages, and the memory for
//! decoded ones and for those that a lambda creates.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use gleaner_buffers::{Lease, Pool};
use gleaner_messages::{CdrError, CompressedView, Endian, ImageView};
use gleaner_pixels::{self as image, Encoding, PixelError, View};
use gleaner_rules::frames::Budget;
use gleaner_rules::names::{COMPRESSED_IMAGE, IMAGE};

/// Number of bytes that are copied in the time of decoding one; see `HISTOGRAM` in `frame`.
const DECODE: usize = 40;

/// Shape of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Info {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    pub encoding: Encoding,
    /// Bytes from one row to the next.
    pub step: u32,
    /// Byte order of the 16-bit encodings.
    pub big_endian: bool,
}

impl Info {
    pub(super) fn tight(width: u32, height: u32, encoding: Encoding) -> Self {
        let step = width * encoding.bytes_per_pixel() as u32;
        Self { width, height, encoding, step, big_endian: false }
    }

    pub(super) fn view<'a>(&self, data: &'a [u8]) -> Result<View<'a>, PixelError> {
        View::new(self.width, self.height, self.step, self.encoding, self.big_endian, data)
    }
}

/// A parsed message of an image type, whose values are not checked yet.
pub(super) enum ImageMessage<'a> {
    Raw(ImageView<'a>),
    Compressed(CompressedView<'a>),
}

impl<'a> ImageMessage<'a> {
    /// Returns whether this is the name of a type of images.
    pub(super) fn is_type(type_name: &str) -> bool {
        [IMAGE, COMPRESSED_IMAGE].contains(&type_name)
    }

    /// Parses a message; `None` if its type is no image.
    pub(super) fn of(
        type_name: &str,
        cdr: &'a [u8],
        endian: Endian,
    ) -> Result<Option<Self>, CdrError> {
        Ok(match type_name {
            IMAGE => Some(Self::Raw(ImageView::read(cdr, endian)?)),
            COMPRESSED_IMAGE => Some(Self::Compressed(CompressedView::read(cdr, endian)?)),
            _ => None,
        })
    }
}

/// Memory for the images of one input, beside the ring: slots for decoded images, and a budget for
/// created ones.
pub struct Images {
    pub(super) decoded: Option<Pool<Info>>,
    pub(super) budget: Budget,
    /// The newest decoded image, so that each is decoded once.
    pub(super) newest: Mutex<Option<(u64, Lease<Info>)>>,
    pub(super) decode_ns: AtomicU64,
}

impl Images {
    /// `decoded` holds decoded JPEG and PNG (`None` for raw images). All inputs of a lambda share
    /// `budget`.
    pub fn new(decoded: Option<Pool<Info>>, budget: Budget) -> Self {
        Self { decoded, budget, newest: Mutex::new(None), decode_ns: AtomicU64::new(0) }
    }

    /// Work of decoding `compressed` in bytes, estimated by its header; 0 if it is the newest
    /// decoded image.
    pub(super) fn decode_work(
        &self,
        position: Option<u64>,
        compressed: &CompressedView<'_>,
    ) -> usize {
        let newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        if newest.as_ref().is_some_and(|(at, _)| Some(*at) == position) {
            return 0;
        }
        let room = self.decoded.as_ref().map_or(0, Pool::slot_bytes);
        image::probe_message(compressed.format, compressed.data)
            .ok()
            .and_then(|(header, _)| header.rgb8_len())
            .map_or(0, |len| len.min(room).saturating_mul(DECODE))
    }

    pub(super) fn decode_ns(&self) -> u64 {
        self.decode_ns.load(Ordering::Relaxed)
    }
}
