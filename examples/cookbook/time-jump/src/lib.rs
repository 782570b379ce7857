//! Time jump: the clock of a sensor jumps against that of the vehicle, forwards or backwards.
//!
//! Compared is how far `header.stamp` is from the time of reception. One sample that came late is
//! no jump, so several in a row must agree, and for a time: samples that waited for each other come
//! late all at once. And a clock that drifts is followed, so that only what is sudden counts.

use gleaner_sdk::{Config, Error, Lambda, Result, Sample, event};

/// So many samples in a row must agree on the new offset, and must have been received over so long.
const AGREE: u32 = 5;
const AGREE_NS: i64 = 500_000_000;

struct TimeJump {
    clock: Clock,
}

impl Lambda for TimeJump {
    fn init(config: &Config) -> Result<Self> {
        Ok(Self { clock: Clock::new((config.real("jump_s")? * 1e9) as i64) })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let stamps = sample.stamps();
        let header_ns = stamps
            .header_ns
            .ok_or_else(|| Error::new("messages of this type have no header.stamp"))?;
        if let Some(jump_ns) = self.clock.note(stamps.at_ns, header_ns.saturating_sub(stamps.at_ns))
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

/// Offsets are those of the sensor's clock from the vehicle's, in nanoseconds.
struct Clock {
    jump_ns: i64,
    usual: Option<i64>,
    elsewhere: Option<Elsewhere>,
}

/// Samples in a row that agree on another offset than the usual one: when the first came, its
/// offset, and how many there are.
#[derive(Clone, Copy)]
struct Elsewhere {
    since_ns: i64,
    offset: i64,
    count: u32,
}

impl Clock {
    fn new(jump_ns: i64) -> Self {
        Self { jump_ns, usual: None, elsewhere: None }
    }

    /// By how much the clock has jumped, once that is sure.
    fn note(&mut self, at_ns: i64, offset: i64) -> Option<i64> {
        let near = |other: i64| offset.abs_diff(other) < self.jump_ns.unsigned_abs();
        let usual = *self.usual.get_or_insert(offset);
        if near(usual) {
            (self.usual, self.elsewhere) = (Some(offset), None);
            return None;
        }
        let begun = self.elsewhere.filter(|elsewhere| near(elsewhere.offset));
        let mut elsewhere = begun.unwrap_or(Elsewhere { since_ns: at_ns, offset, count: 0 });
        elsewhere.count = elsewhere.count.saturating_add(1);
        self.elsewhere = Some(elsewhere);
        if elsewhere.count < AGREE || at_ns.saturating_sub(elsewhere.since_ns) < AGREE_NS {
            return None;
        }
        (self.usual, self.elsewhere) = (Some(offset), None);
        Some(offset.saturating_sub(usual))
    }
}

gleaner_sdk::lambda!(TimeJump);

#[cfg(test)]
mod tests {
    use super::*;

    /// The jumps in samples with these offsets that are received so many milliseconds apart.
    fn jumps_of(apart_ms: i64, offsets: &[i64]) -> Vec<(usize, i64)> {
        let mut clock = Clock::new(100);
        let times = (0..).map(|index| index * apart_ms * 1_000_000);
        let jumps = times.zip(offsets).map(|(at_ns, offset)| clock.note(at_ns, *offset));
        jumps.enumerate().filter_map(|(index, jump)| Some((index, jump?))).collect()
    }

    fn jumps(offsets: &[i64]) -> Vec<(usize, i64)> {
        jumps_of(125, offsets)
    }

    #[test]
    fn a_jump_is_told_once_when_five_samples_agree() {
        assert_eq!(jumps(&[3, 5, 2005, 2003, 2004, 2006, 2005, 2004, 2003, 2005]), [(6, 2000)]);
        assert_eq!(jumps(&[0, -500, -501, -500, -499, -500]), [(5, -500)]);
    }

    #[test]
    fn samples_that_waited_and_came_at_once_are_no_jump() {
        let late: Vec<i64> = (0..100).map(|i| -2000 + 20 * i).collect();
        assert_eq!(jumps_of(1, &[&[0, 0], &late[..], &[0, 0, 0]].concat()), []);
        let jumped = [&[0][..], &[-2000; 100]].concat();
        assert_eq!(jumps_of(10, &jumped), [(51, -2000)], "a jump is sure after half a second");
    }

    #[test]
    fn late_samples_and_a_drift_are_no_jump() {
        assert_eq!(jumps(&[0, -900, 0, -900, -700, 0, -900, -900, -900, -900, 0]), []);
        assert_eq!(jumps(&(0..1000).map(|i| i * 50).collect::<Vec<_>>()), []);
        assert_eq!(jumps(&[i64::MIN, i64::MAX, 0, i64::MIN, i64::MAX]), [], "nothing overflows");
    }
}
