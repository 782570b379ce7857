//! Bounds what a lambda's process writes to standard error: it may be fast, and never ends.

use std::time::{Duration, Instant};

/// Bytes that may be written in each second, on average.
const RATE: f64 = 64.0 * 1024.0;
/// Bytes that may be written at once.
const BURST: f64 = 1024.0 * 1024.0;

/// The bytes that may still be written. It fills with time.
pub(crate) struct ByteRate {
    left: f64,
    filled: Instant,
    /// Number of bytes that were refused since the last ones that were not.
    dropped: u64,
}

impl ByteRate {
    pub(crate) fn new() -> Self {
        Self { left: BURST, filled: Instant::now(), dropped: 0 }
    }

    /// Returns whether `bytes` may pass and, if they may, how many were refused before them.
    pub(crate) fn take(&mut self, bytes: usize) -> Option<u64> {
        self.take_after(bytes, self.filled.elapsed())
    }

    fn take_after(&mut self, bytes: usize, passed: Duration) -> Option<u64> {
        self.filled += passed;
        self.left = BURST.min(self.left + RATE * passed.as_secs_f64());
        if self.left < bytes as f64 {
            self.dropped = self.dropped.saturating_add(bytes as u64);
            return None;
        }
        self.left -= bytes as f64;
        Some(self.take_dropped())
    }

    /// Returns how many bytes were refused, once.
    pub(crate) fn take_dropped(&mut self) -> u64 {
        std::mem::take(&mut self.dropped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_passes_and_then_as_much_as_the_rate() {
        let mut rate = ByteRate::new();
        assert_eq!(rate.take_after(1 << 20, Duration::ZERO), Some(0));
        assert_eq!(rate.take_after(100, Duration::ZERO), None);
        assert_eq!(rate.take_after(70_000, Duration::from_secs(1)), None);
        assert_eq!(rate.take_after(65_000, Duration::ZERO), Some(70_100));
        assert_eq!(rate.take_after(1 << 20, Duration::from_secs(3600)), Some(0));
        assert_eq!(rate.take_after(1, Duration::ZERO), None);
        assert_eq!((rate.take_dropped(), rate.take_dropped()), (1, 0));
    }
}
