//! Limits the number of frames and tensors that a lambda holds, and the memory of those that it
//! creates.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// The budget of frames and bytes, shared by all inputs of a lambda.
#[derive(Clone, Debug)]
pub struct Budget(Arc<Remaining>);

#[derive(Debug)]
struct Remaining {
    frames: AtomicUsize,
    frames_allowed: usize,
    bytes: AtomicUsize,
}

/// The share of one frame in the budget. Dropping it returns the share.
#[derive(Debug)]
pub struct FrameLease {
    budget: Budget,
    bytes: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NoRoom {
    Frames {
        allowed: usize,
    },
    /// The frames that the lambda created use too much memory.
    Bytes {
        needed: usize,
        /// Remaining bytes of `memory` in `[limits]`.
        left: usize,
    },
}

impl fmt::Display for NoRoom {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let limit = match self {
            Self::Frames { allowed } => {
                write!(f, "the lambda holds {allowed} frames and tensors; ")?;
                "frames"
            }
            Self::Bytes { needed, left } => {
                write!(f, "a new frame or tensor needs {needed} bytes, and {left} are left; ")?;
                "memory"
            }
        };
        write!(f, "drop frames and tensors that are not needed, or raise `{limit}` in [limits]")
    }
}

impl std::error::Error for NoRoom {}

impl Budget {
    pub fn new(frames: usize, bytes: usize) -> Self {
        let (left, bytes) = (AtomicUsize::new(frames), AtomicUsize::new(bytes));
        Self(Arc::new(Remaining { frames: left, frames_allowed: frames, bytes }))
    }

    /// Returns whether `bytes` bytes are left, regardless of the number of frames.
    pub fn has(&self, bytes: usize) -> bool {
        bytes <= self.0.bytes.load(Ordering::Relaxed)
    }

    /// Reserves a frame of `bytes`; 0 for a frame whose pixels are in a slot.
    ///
    /// # Errors
    ///
    /// [`NoRoom`]; nothing is taken then.
    pub fn take(&self, bytes: usize) -> Result<FrameLease, NoRoom> {
        let take = |from: &AtomicUsize, n: usize| {
            from.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(n))
        };
        let allowed = self.0.frames_allowed;
        take(&self.0.frames, 1).map_err(|_| NoRoom::Frames { allowed })?;
        // From here on, dropping the lease returns the frame.
        let mut taken = FrameLease { budget: self.clone(), bytes: 0 };
        take(&self.0.bytes, bytes).map_err(|left| NoRoom::Bytes { needed: bytes, left })?;
        taken.bytes = bytes;
        Ok(taken)
    }
}

impl Drop for FrameLease {
    fn drop(&mut self) {
        self.budget.0.bytes.fetch_add(self.bytes, Ordering::Relaxed);
        self.budget.0.frames.fetch_add(1, Ordering::Relaxed);
    }
}
