//! Time jump: the clock of a sensor jumps relative to that of the vehicle, forwards or backwards.
//!
//! The offset is `header.stamp` minus the time of reception. One late sample is not a jump, so
//! several in a row must have the new offset. They must also be received over some time, since a
//! burst of delayed samples arrives at once. The usual offset follows a clock that drifts, so only
//! sudden changes count.

use gleaner_sdk::{Config, Error, Lambda, Result, Sample, event};

/// Minimum number of consecutive samples with the new offset, and minimum time over which they are
/// received.
const AGREE: u32 = 5;
const AGREE_NS: i64 = 500_000_000;

struct TimeJump {
    monitor: OffsetMonitor,
}

impl Lambda for TimeJump {
    fn init(config: &Config) -> Result<Self> {
        Ok(Self { monitor: OffsetMonitor::new((config.real("jump_s")? * 1e9) as i64) })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let stamps = sample.stamps();
        let header_ns = stamps
            .header_ns
            .ok_or_else(|| Error::new("messages of this type have no header.stamp"))?;
        if let Some(jump_ns) =
            self.monitor.note(stamps.at_ns, header_ns.saturating_sub(stamps.at_ns))
        {
            let jump_s = jump_ns as f64 / 1e9;
            event("time-jump", jump_s.abs())
                .with("jump_s", jump_s)
                .with("header_ns", header_ns)
                .send()?;
        }
        Ok(())
    }
}

/// Detects jumps of the offset between the clocks of the sensor and the vehicle, in nanoseconds.
struct OffsetMonitor {
    jump_ns: i64,
    usual: Option<i64>,
    candidate: Option<Candidate>,
}

/// A possible new offset: the time and offset of its first sample, and the number of consecutive
/// samples that agree.
#[derive(Clone, Copy)]
struct Candidate {
    since_ns: i64,
    offset: i64,
    count: u32,
}

impl OffsetMonitor {
    fn new(jump_ns: i64) -> Self {
        Self { jump_ns, usual: None, candidate: None }
    }

    /// Adds a sample. Returns the jump in nanoseconds once enough samples agree.
    fn note(&mut self, at_ns: i64, offset: i64) -> Option<i64> {
        let near = |other: i64| offset.abs_diff(other) < self.jump_ns.unsigned_abs();
        let usual = *self.usual.get_or_insert(offset);
        if near(usual) {
            (self.usual, self.candidate) = (Some(offset), None);
            return None;
        }
        let known = self.candidate.filter(|candidate| near(candidate.offset));
        let mut candidate = known.unwrap_or(Candidate { since_ns: at_ns, offset, count: 0 });
        candidate.count = candidate.count.saturating_add(1);
        self.candidate = Some(candidate);
        if candidate.count < AGREE || at_ns.saturating_sub(candidate.since_ns) < AGREE_NS {
            return None;
        }
        (self.usual, self.candidate) = (Some(offset), None);
        Some(offset.saturating_sub(usual))
    }
}

gleaner_sdk::lambda!(TimeJump);

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the jumps in samples with these offsets, received `apart_ms` milliseconds apart.
    fn jumps_of(apart_ms: i64, offsets: &[i64]) -> Vec<(usize, i64)> {
        let mut monitor = OffsetMonitor::new(100);
        let times = (0..).map(|index| index * apart_ms * 1_000_000);
        let jumps = times.zip(offsets).map(|(at_ns, offset)| monitor.note(at_ns, *offset));
        jumps.enumerate().filter_map(|(index, jump)| Some((index, jump?))).collect()
    }

    fn jumps(offsets: &[i64]) -> Vec<(usize, i64)> {
        jumps_of(125, offsets)
    }

    #[test]
    fn a_jump_is_reported_once_when_five_samples_agree() {
        assert_eq!(jumps(&[3, 5, 2005, 2003, 2004, 2006, 2005, 2004, 2003, 2005]), [(6, 2000)]);
        assert_eq!(jumps(&[0, -500, -501, -500, -499, -500]), [(5, -500)]);
    }

    #[test]
    fn a_burst_of_delayed_samples_is_not_a_jump() {
        let late: Vec<i64> = (0..100).map(|i| -2000 + 20 * i).collect();
        assert_eq!(jumps_of(1, &[&[0, 0], &late[..], &[0, 0, 0]].concat()), []);
        let jumped = [&[0][..], &[-2000; 100]].concat();
        assert_eq!(jumps_of(10, &jumped), [(51, -2000)], "a jump is reported after half a second");
    }

    #[test]
    fn late_samples_and_drift_are_not_a_jump() {
        assert_eq!(jumps(&[0, -900, 0, -900, -700, 0, -900, -900, -900, -900, 0]), []);
        assert_eq!(jumps(&(0..1000).map(|i| i * 50).collect::<Vec<_>>()), []);
        assert_eq!(jumps(&[i64::MIN, i64::MAX, 0, i64::MIN, i64::MAX]), [], "nothing overflows");
    }
}
