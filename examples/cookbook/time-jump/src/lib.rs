//! Time jump: the clock of a sensor jumps against that of the vehicle, forwards or backwards.
//!
//! Compared is how far `header.stamp` is from the time of reception. One sample that came late is no jump, so several in a row
//! must agree; and a clock that drifts is followed, so that only what is sudden counts.

use gleaner_sdk::{Config, Error, Lambda, Result, Sample, event};

/// So many samples in a row must agree on the new offset.
const AGREE: u32 = 5;

struct TimeJump {
    clock: Clock,
}

impl Lambda for TimeJump {
    fn init(config: &Config) -> Result<Self> {
        Ok(Self { clock: Clock::new((config.real("jump_s")? * 1e9) as i64) })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let stamps = sample.stamps();
        let header_ns = stamps.header_ns.ok_or_else(|| Error::new("messages of this type have no header.stamp"))?;
        if let Some(jump_ns) = self.clock.note(header_ns.saturating_sub(stamps.at_ns)) {
            let jump_s = jump_ns as f64 / 1e9;
            event("time-jump", jump_s.abs()).with("jump_s", jump_s).with("header_ns", header_ns).send()?;
        }
        Ok(())
    }
}

/// Offsets are those of the sensor's clock from the vehicle's, in nanoseconds.
struct Clock {
    jump_ns: i64,
    usual: Option<i64>,
    /// The offset of the first sample that was elsewhere, and how many followed it.
    elsewhere: Option<(i64, u32)>,
}

impl Clock {
    fn new(jump_ns: i64) -> Self {
        Self { jump_ns, usual: None, elsewhere: None }
    }

    /// By how much the clock has jumped, once that is sure.
    fn note(&mut self, offset: i64) -> Option<i64> {
        let near = |other: i64| offset.abs_diff(other) < self.jump_ns.unsigned_abs();
        let usual = *self.usual.get_or_insert(offset);
        if near(usual) {
            (self.usual, self.elsewhere) = (Some(offset), None);
            return None;
        }
        let (first, count) = self.elsewhere.filter(|(first, _)| near(*first)).unwrap_or((offset, 0));
        self.elsewhere = Some((first, count + 1));
        if count + 1 < AGREE {
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

    fn jumps(offsets: &[i64]) -> Vec<(usize, i64)> {
        let mut clock = Clock::new(100);
        offsets.iter().enumerate().filter_map(|(index, offset)| Some((index, clock.note(*offset)?))).collect()
    }

    #[test]
    fn a_jump_is_told_once_when_five_samples_agree() {
        assert_eq!(jumps(&[3, 5, 2005, 2003, 2004, 2006, 2005, 2004, 2003, 2005]), [(6, 2000)]);
        assert_eq!(jumps(&[0, -500, -501, -500, -499, -500]), [(5, -500)]);
    }

    #[test]
    fn late_samples_and_a_drift_are_no_jump() {
        assert_eq!(jumps(&[0, -900, 0, -900, -700, 0, -900, -900, -900, -900, 0]), []);
        assert_eq!(jumps(&(0..1000).map(|i| i * 50).collect::<Vec<_>>()), []);
        assert_eq!(jumps(&[i64::MIN, i64::MAX, 0, i64::MIN, i64::MAX]), [], "nothing overflows");
    }
}
