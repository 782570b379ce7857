//! Limits the rate of something: a token bucket.

use std::time::Instant;

/// A token bucket: a rate per second, and a burst.
#[derive(Copy, Clone, Debug)]
pub struct RateLimit {
    per_s: f64,
    burst: f64,
    left: f64,
    since: Option<Instant>,
}

impl RateLimit {
    /// Creates a full bucket.
    pub const fn of(per_s: f64, burst: f64) -> RateLimit {
        RateLimit { per_s, burst, left: burst, since: None }
    }

    pub fn left(&self, now: Instant) -> f64 {
        let passed = self.since.map_or(0.0, |since| now.duration_since(since).as_secs_f64());
        (self.left + passed * self.per_s).min(self.burst)
    }

    /// Takes `amount` and returns true, if that much is left.
    pub fn take(&mut self, amount: f64, now: Instant) -> bool {
        self.left = self.left(now);
        self.since = Some(now);
        let fits = amount <= self.left;
        self.left -= if fits { amount } else { 0.0 };
        fits
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_rate_limit_is_used_up_and_recovers() {
        let (mut limit, start) = (RateLimit::of(10.0, 100.0), Instant::now());
        assert!(limit.take(60.0, start) && !limit.take(60.0, start) && limit.take(40.0, start));
        assert!(!limit.take(5.0, start + Duration::from_millis(400)));
        assert!(limit.take(5.0, start + Duration::from_millis(600)));
        assert!(limit.take(100.0, start + Duration::from_secs(3600)));
        assert!(!limit.take(1.0, start + Duration::from_secs(3600)), "not more than a burst");
    }
}
