//! Notices a topic that receives far fewer samples than before, though its writers are connected.
//!
//! Samples that a writer could not send have no numbers, so no gap shows them: a writer that waits
//! for another reader sends less, and nothing counts as lost. Only the rate shows it.

use std::time::Instant;

/// Measurements, one in a second, that make a rate usual.
const STEADY: u32 = 10;
/// The lowest usual rate that is watched, in Hz: fewer samples than this are a matter of chance.
const MIN_HZ: f64 = 5.0;
/// Low rates in a row from which on they are reported, and after which they are usual.
const PATIENCE: u32 = 3;
const ADOPTED: u32 = 60;

#[derive(Debug, Default)]
pub(crate) struct RateWatch {
    /// Connected writers, received samples and time of the last measurement.
    last: Option<(usize, u64, Instant)>,
    usual_hz: f64,
    /// Measurements that agree with it, and low ones after them.
    measured: u32,
    low: u32,
}

impl RateWatch {
    /// Notes, once in a second, the number of samples received so far, and that of connected
    /// writers. Returns a sentence about `topic` while it receives far fewer than before.
    pub(crate) fn note(
        &mut self,
        topic: &str,
        (received, writers): (u64, Option<usize>),
        now: Instant,
    ) -> Option<String> {
        let last = writers.filter(|writers| *writers > 0).map(|writers| (writers, received, now));
        let before = std::mem::replace(&mut self.last, last)
            .filter(|(before, ..)| Some(*before) == writers && self.low < ADOPTED);
        let Some((_, samples, at)) = before else {
            // Other writers have another rate, and these may have changed it on purpose.
            *self = Self { last, ..Self::default() };
            return None;
        };
        let passed_s = now.saturating_duration_since(at).as_secs_f64();
        let (now_hz, usual) = (received.saturating_sub(samples) as f64 / passed_s, self.usual_hz);
        let is_low = now_hz < usual / 2.0;
        if is_low && usual >= MIN_HZ && self.measured >= STEADY {
            self.low += 1;
        } else if is_low || now_hz > usual * 2.0 {
            (self.usual_hz, self.measured, self.low) = (now_hz, 1, 0);
        } else {
            self.usual_hz += 0.1 * (now_hz - usual);
            (self.measured, self.low) = (self.measured.saturating_add(1), 0);
        }
        (self.low >= PATIENCE).then(|| {
            format!(
                "`{topic}` receives {now_hz:.1} samples a second since {} s, and {usual:.1} \
                 before: its writers send less, or wait for a reader that does not acknowledge",
                self.low
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_rate_that_falls_while_the_writers_stay_is_reported_with_its_age_for_a_minute() {
        let (mut watch, mut received, mut now) = (RateWatch::default(), 0, Instant::now());
        let mut seconds = |count: u32, rate: u64, writers| {
            let mut last = None;
            for _ in 0..count {
                (received, now) = (received + rate, now + Duration::from_secs(1));
                last = watch.note("/imu", (received, writers), now);
            }
            last
        };
        assert_eq!(seconds(11, 400, Some(1)), None);
        assert_eq!(seconds(2, 10, Some(1)), None, "not for long");
        let expected = "`/imu` receives 10.0 samples a second since 12 s, and 400.0 before: its \
                        writers send less, or wait for a reader that does not acknowledge";
        assert_eq!(seconds(10, 10, Some(1)).as_deref(), Some(expected));
        assert!(seconds(48, 10, Some(1)).is_some() && seconds(1, 10, Some(1)).is_none());
        assert_eq!(seconds(99, 10, Some(1)), None, "it is usual");
        // Another number of writers, a drive, rare samples, and a burst.
        for (rate, writers) in [(400, Some(2)), (100, Some(1)), (100, None), (2, Some(1))] {
            assert_eq!(seconds(11, rate, writers), None);
        }
        seconds(3, 100, Some(1));
        assert_eq!(seconds(9, 0, Some(1)), None);
    }
}
