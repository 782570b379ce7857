//! Memory for images: slots for decoded ones, and a budget for those that a lambda creates.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use gleaner_buffers::{Lease, Pool};
use gleaner_image as image;
use gleaner_messages::CompressedView;
use gleaner_rules::frames::Budget;

use super::frame::Info;

/// Number of bytes that are copied in the time of decoding one; see `HISTOGRAM` in `frame`.
const DECODE: usize = 40;

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
