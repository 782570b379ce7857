//! Every kilometre: a clip of the road at even distances, for a map or a training set, at any speed
//! of the car.
//!
//! The odometer is kept in `scratch`, so a fault does not reset it.

use gleaner_sdk::{Config, Field, Lambda, Result, Sample, event, input, now_ns, scratch};

const ODOMETER: &str = "odometer";

struct EveryKilometre {
    forward: Field,
    odometer: Odometer,
}

impl Lambda for EveryKilometre {
    fn init(config: &Config) -> Result<Self> {
        let forward = input("speed")?.field("twist.linear.x")?;
        let driven_m = match scratch::get(ODOMETER, 0, 8) {
            Ok(bytes) => bytes.try_into().map(f64::from_le_bytes).unwrap_or(0.0),
            Err(error) if error.is(scratch::ScratchErrorKind::NoSuchEntry) => 0.0,
            Err(error) => return Err(error),
        };
        Ok(Self {
            forward,
            odometer: Odometer { every_m: config.real("every_m")?, driven_m, last: None },
        })
    }

    fn on_event(&mut self, speed: Sample) -> Result<()> {
        let mps = speed.number(&self.forward)?.abs();
        if let Some(mark) = self.odometer.add(now_ns(), mps) {
            event("kilometre", self.odometer.driven_m / 1000.0)
                .with("mark", mark)
                .with("speed_mps", mps)
                .send()?;
        }
        scratch::put(ODOMETER, &self.odometer.driven_m.to_le_bytes())
    }
}

struct Odometer {
    every_m: f64,
    driven_m: f64,
    /// Stamp in nanoseconds and speed in m/s of the previous sample.
    last: Option<(i64, f64)>,
}

impl Odometer {
    /// Longer gaps between samples do not count: the speed in them is unknown.
    const GAP_NS: i64 = 1_000_000_000;

    /// Adds a sample. Returns the number of the mark that the car passes with it, from 1; none if
    /// it passes none.
    fn add(&mut self, at_ns: i64, mps: f64) -> Option<i64> {
        let mark = (self.driven_m / self.every_m) as i64;
        if let Some((before_ns, before_mps)) = self.last.replace((at_ns, mps)) {
            let passed_ns = at_ns - before_ns;
            // A speed of NaN does not count either.
            if (1..=Self::GAP_NS).contains(&passed_ns) && (before_mps + mps).is_finite() {
                self.driven_m += (before_mps + mps) / 2.0 * passed_ns as f64 / 1e9;
            }
        }
        Some((self.driven_m / self.every_m) as i64).filter(|now| *now > mark)
    }
}

gleaner_sdk::lambda!(EveryKilometre);

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the marks passed at a speed in m/s, ten samples a second, and the metres driven.
    fn marks(mps: f64, seconds: std::ops::Range<i64>, odometer: &mut Odometer) -> Vec<i64> {
        (seconds.start * 10..seconds.end * 10)
            .filter_map(|tick| odometer.add(tick * 100_000_000, mps))
            .collect()
    }

    #[test]
    fn each_mark_is_passed_once_at_any_speed() {
        for mps in [1.0, 20.0, 55.0] {
            let mut odometer = Odometer { every_m: 100.0, driven_m: 0.0, last: None };
            let expected: Vec<i64> = (1..=(mps * 99.0 / 100.0) as i64).collect();
            assert_eq!(marks(mps, 0..100, &mut odometer)[..expected.len()], expected);
        }
    }

    #[test]
    fn gaps_and_nan_do_not_count() {
        let mut odometer = Odometer { every_m: 100.0, driven_m: 0.0, last: None };
        marks(10.0, 0..2, &mut odometer);
        marks(10.0, 60..62, &mut odometer);
        assert!((odometer.driven_m - 38.0).abs() < 1e-6, "{}", odometer.driven_m);
        marks(f64::NAN, 62..63, &mut odometer);
        assert!((odometer.driven_m - 38.0).abs() < 1e-6, "{}", odometer.driven_m);
    }
}
