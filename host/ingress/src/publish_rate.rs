//! Limits the requests of one reader.

use std::time::{Duration, Instant};

/// Most requests of a reader per second: published messages, and those for definitions.
pub(crate) const REQUESTS_PER_S: f64 = 1000.0;
/// Most bytes that a reader publishes per second.
pub(crate) const BYTES_PER_S: f64 = (4 << 20) as f64;

/// The requests that a reader may make now: as many as in one second, saved up at most.
///
/// Where it may make none, its socket is not read. Then its messages wait in its own process, which
/// drops and counts those that it has no room for.
#[derive(Debug)]
pub(crate) struct PublishRate {
    requests: f64,
    bytes: f64,
    filled: Instant,
}

impl PublishRate {
    pub(crate) fn new(now: Instant) -> Self {
        Self { requests: REQUESTS_PER_S, bytes: BYTES_PER_S, filled: now }
    }

    pub(crate) fn count(&mut self, bytes: usize) {
        self.requests -= 1.0;
        self.bytes -= bytes as f64;
    }

    /// Returns the time until the next request may be made: 0 if that is now.
    pub(crate) fn wait(&mut self, now: Instant) -> Duration {
        let passed = now.saturating_duration_since(self.filled).as_secs_f64();
        self.filled = now;
        self.requests = (self.requests + passed * REQUESTS_PER_S).min(REQUESTS_PER_S);
        self.bytes = (self.bytes + passed * BYTES_PER_S).min(BYTES_PER_S);
        let wait = (-self.requests / REQUESTS_PER_S).max(-self.bytes / BYTES_PER_S);
        Duration::from_secs_f64(wait.max(0.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the number of requests of `bytes` bytes in `seconds`, one after another.
    fn requests(bytes: usize, seconds: u64) -> f64 {
        let start = Instant::now();
        let mut rate = PublishRate::new(start);
        let (mut now, mut requests) = (start, 0.0);
        while now < start + Duration::from_secs(seconds) {
            match rate.wait(now) {
                Duration::ZERO => {
                    rate.count(bytes);
                    requests += 1.0;
                }
                wait => now += wait.max(Duration::from_micros(1)),
            }
        }
        requests
    }

    #[test]
    fn requests_and_bytes_are_limited_per_second() {
        assert!((requests(10, 9) - 10.0 * REQUESTS_PER_S).abs() < 20.0);
        let bytes = 256 << 10;
        assert!((requests(bytes, 9) - 10.0 * BYTES_PER_S / bytes as f64).abs() < 5.0);
    }

    #[test]
    fn a_quiet_reader_saves_up_one_second_at_most() {
        let start = Instant::now();
        let mut rate = PublishRate::new(start);
        let later = start + Duration::from_secs(3600);
        for _ in 0..=REQUESTS_PER_S as usize {
            assert_eq!(rate.wait(later), Duration::ZERO);
            rate.count(1);
        }
        assert!(rate.wait(later) > Duration::ZERO);
    }
}
