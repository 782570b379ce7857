//! Room for images: slots for decoded ones, and a budget for those that a lambda makes.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use gleaner_buffers::{Lease, Pool};
use gleaner_image as image;

use super::data::DataError;
use super::frame::Info;

/// Bytes that are copied in the time in which one is decoded; see `HISTOGRAM` in `frame`.
const DECODE: usize = 40;

/// Room for the images of one input, beyond the ring: decoded ones in slots, made ones out of a budget.
pub struct Images {
    pub(super) decoded: Option<Pool<Info>>,
    pub(super) made: Budget,
    /// The newest decoded image, so that each is decoded once.
    pub(super) newest: Mutex<Option<(u64, Lease<Info>)>>,
    pub(super) decode_ns: AtomicU64,
}

impl Images {
    /// `decoded` holds what JPEG and PNG become (none for raw images); `made` is shared by all inputs of a lambda.
    pub fn new(decoded: Option<Pool<Info>>, made: Budget) -> Self {
        Self { decoded, made, newest: Mutex::new(None), decode_ns: AtomicU64::new(0) }
    }

    /// Work of decoding `data`, by its header, in bytes; none if it is the newest decoded image already.
    pub(super) fn decode_work(&self, position: Option<u64>, data: &[u8]) -> usize {
        let newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        if newest.as_ref().is_some_and(|(at, _)| Some(*at) == position) {
            return 0;
        }
        let room = self.decoded.as_ref().map_or(0, Pool::slot_bytes);
        image::probe(data)
            .ok()
            .and_then(|header| header.rgb8_len())
            .map_or(0, |len| len.min(room).saturating_mul(DECODE))
    }

    pub(super) fn decode_ns(&self) -> u64 {
        self.decode_ns.load(Ordering::Relaxed)
    }
}

/// Frames that a lambda may hold at a time, and the bytes that those made by `resize` and `to_gray` may take together.
#[derive(Clone)]
pub struct Budget(Arc<Left>);

struct Left {
    frames: AtomicUsize,
    frames_allowed: usize,
    bytes: AtomicUsize,
}

/// A frame that is held, and what it takes; given back when it is dropped.
pub(super) struct Taken {
    budget: Budget,
    bytes: usize,
}

impl Budget {
    /// A budget of that many frames and bytes.
    pub fn new(frames: usize, bytes: usize) -> Self {
        let (left, bytes) = (AtomicUsize::new(frames), AtomicUsize::new(bytes));
        Self(Arc::new(Left { frames: left, frames_allowed: frames, bytes }))
    }

    pub(super) fn has(&self, bytes: usize) -> bool {
        bytes <= self.0.bytes.load(Ordering::Relaxed)
    }

    pub(super) fn take(&self, bytes: usize) -> Result<Taken, DataError> {
        let take = |from: &AtomicUsize, n: usize| {
            from.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(n))
        };
        let allowed = self.0.frames_allowed;
        take(&self.0.frames, 1).map_err(|_| DataError::TooManyFrames { allowed })?;
        // From here on the frame is given back, whatever comes.
        let mut taken = Taken { budget: self.clone(), bytes: 0 };
        take(&self.0.bytes, bytes).map_err(|left| DataError::NoMemory { asked: bytes, left })?;
        taken.bytes = bytes;
        Ok(taken)
    }
}

impl Drop for Taken {
    fn drop(&mut self) {
        self.budget.0.bytes.fetch_add(self.bytes, Ordering::Relaxed);
        self.budget.0.frames.fetch_add(1, Ordering::Relaxed);
    }
}
