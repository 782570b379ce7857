//! Hard braking in the dark: the car brakes while the newest camera frame is dark.

use gleaner_sdk::{Column, Config, Field, Lambda, Result, Sample, Topic, event, input, now_ns};

const WINDOW_NS: i64 = 500_000_000;
const FULL_NS: i64 = 450_000_000;
const REFRACTORY_NS: i64 = 3_000_000_000;

struct BrakeDark {
    imu: Topic,
    forward: Field,
    brake_mps2: f64,
    dark_luma: f64,
    last_ns: Option<i64>,
}

impl Lambda for BrakeDark {
    fn init(config: &Config) -> Result<Self> {
        let imu = input("imu")?;
        let forward = imu.field("linear_acceleration.x")?;
        let (brake_mps2, dark_luma) = (config.real("brake_mps2")?, config.real("dark_luma")?);
        Ok(Self { imu, forward, brake_mps2, dark_luma, last_ns: None })
    }

    fn on_event(&mut self, camera: Sample) -> Result<()> {
        let now = now_ns();
        let window = self.imu.column_since(&self.forward, now - WINDOW_NS)?;
        let rested = self.last_ns.is_none_or(|last| now - last >= REFRACTORY_NS);
        let Some(mean) = braking(&window, now, self.brake_mps2).filter(|_| rested) else {
            return Ok(());
        };
        // Only now is the image decoded: most frames cost nothing.
        let luma = camera.as_frame()?.mean_luma(None)?;
        if luma < self.dark_luma {
            self.last_ns = Some(now);
            event("brake-dark", -mean).with("luma", luma).send()?;
        }
        Ok(())
    }
}

/// Mean of the window in m/s², if the window is full and its mean is below `brake_mps2`.
fn braking(window: &Column, now: i64, brake_mps2: f64) -> Option<f64> {
    let full = window.at_ns.first().is_some_and(|oldest| now - oldest >= FULL_NS);
    window.mean().filter(|mean| full && *mean < brake_mps2)
}

gleaner_sdk::lambda!(BrakeDark);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_sample_is_no_braking() {
        assert_eq!(braking(&Column::default(), 0, -3.0), None);
    }

    #[test]
    fn braking_needs_a_full_window_below_the_threshold() {
        let window = Column { at_ns: vec![0, 100_000_000], values: vec![-4.0, -6.0] };
        assert_eq!(braking(&window, 449_999_999, -3.0), None);
        assert_eq!(braking(&window, 450_000_000, -3.0), Some(-5.0));
        assert_eq!(braking(&window, 450_000_000, -5.0), None);
    }
}
