//! Bounds what a lambda's process writes to standard error: it may be fast, and never ends.

use std::time::Instant;

use gleaner_base::RateLimit;

/// Bytes that may be written in each second, and at once.
const BYTES: RateLimit = RateLimit::of(65_536.0, 1_048_576.0);

/// The bytes that may still be written.
pub(crate) struct ByteRate {
    limit: RateLimit,
    /// Number of bytes that were refused since the last ones that were not.
    dropped: u64,
}

impl ByteRate {
    pub(crate) fn new() -> Self {
        Self { limit: BYTES, dropped: 0 }
    }

    /// Returns whether `bytes` may pass and, if they may, how many were refused before them.
    pub(crate) fn take(&mut self, bytes: usize, now: Instant) -> Option<u64> {
        if self.limit.take(bytes as f64, now) {
            return Some(self.take_dropped());
        }
        self.dropped = self.dropped.saturating_add(bytes as u64);
        None
    }

    /// Returns how many bytes were refused, once.
    pub(crate) fn take_dropped(&mut self) -> u64 {
        std::mem::take(&mut self.dropped)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_burst_passes_and_then_as_much_as_the_rate() {
        let (mut rate, start) = (ByteRate::new(), Instant::now());
        let after = |seconds| start + Duration::from_secs(seconds);
        assert_eq!(rate.take(1 << 20, start), Some(0));
        assert_eq!(rate.take(100, start), None);
        assert_eq!(rate.take(70_000, after(1)), None);
        assert_eq!(rate.take(65_000, after(1)), Some(70_100));
        assert_eq!(rate.take(1 << 20, after(3601)), Some(0));
        assert_eq!(rate.take(1, after(3601)), None);
        assert_eq!((rate.take_dropped(), rate.take_dropped()), (1, 0));
    }
}
