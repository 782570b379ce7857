//! How many frames a lambda may hold at a time, and how many bytes those that it makes may take
//! together.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Frames and bytes that are left, shared by all inputs of a lambda.
#[derive(Clone, Debug)]
pub struct Budget(Arc<Remaining>);

#[derive(Debug)]
struct Remaining {
    frames: AtomicUsize,
    frames_allowed: usize,
    bytes: AtomicUsize,
}

/// A frame that is held, and what it takes; given back when it is dropped.
#[derive(Debug)]
pub struct FrameLease {
    budget: Budget,
    bytes: usize,
}

/// Why there is no room for one more frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NoRoom {
    /// The lambda holds as many frames as it may.
    Frames {
        /// How many that is.
        allowed: usize,
    },
    /// The frames that it made take too much.
    Bytes {
        /// Bytes of the new frame.
        asked: usize,
        /// Bytes that are left.
        left: usize,
    },
}

impl fmt::Display for NoRoom {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let limit = match self {
            Self::Frames { allowed } => {
                write!(f, "the lambda holds {allowed} frames; ")?;
                "frames"
            }
            Self::Bytes { asked, left } => {
                write!(f, "{asked} bytes for a new frame, {left} are left; ")?;
                "memory"
            }
        };
        write!(f, "drop frames that are not needed, or raise `{limit}` in [limits]")
    }
}

impl std::error::Error for NoRoom {}

impl Budget {
    /// A budget of that many frames and bytes.
    pub fn new(frames: usize, bytes: usize) -> Self {
        let (left, bytes) = (AtomicUsize::new(frames), AtomicUsize::new(bytes));
        Self(Arc::new(Remaining { frames: left, frames_allowed: frames, bytes }))
    }

    /// Whether there is room for a frame of so many bytes, but for the number of frames.
    pub fn has(&self, bytes: usize) -> bool {
        bytes <= self.0.bytes.load(Ordering::Relaxed)
    }

    /// Takes room for a frame that was made of `bytes`, or of none for one that lies elsewhere.
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
        // From here on the frame is given back, whatever comes.
        let mut taken = FrameLease { budget: self.clone(), bytes: 0 };
        take(&self.0.bytes, bytes).map_err(|left| NoRoom::Bytes { asked: bytes, left })?;
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
