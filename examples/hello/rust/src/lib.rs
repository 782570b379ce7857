//! Hard braking: the mean forward acceleration of the last half second is below a threshold.

use gleaner_sdk::{Column, Config, Field, Lambda, Result, Sample, Topic, event, input, now_ns};

const WINDOW_NS: i64 = 500_000_000;
const FULL_NS: i64 = 450_000_000;
const REFRACTORY_NS: i64 = 3_000_000_000;

struct Hello {
    imu: Topic,
    forward: Field,
    brake_mps2: f64,
    last_ns: Option<i64>,
}

impl Lambda for Hello {
    fn init(config: &Config) -> Result<Self> {
        let imu = input("imu")?;
        let forward = imu.field("linear_acceleration.x")?;
        Ok(Self { imu, forward, brake_mps2: config.real("brake_mps2")?, last_ns: None })
    }

    fn on_event(&mut self, _sample: Sample) -> Result<()> {
        let now = now_ns();
        let window = self.imu.column_since(&self.forward, now - WINDOW_NS)?;
        let rested = self.last_ns.is_none_or(|last| now - last >= REFRACTORY_NS);
        if let Some(mean) = braking(&window, now, self.brake_mps2).filter(|_| rested) {
            self.last_ns = Some(now);
            event("hard-brake", -mean).send()?;
        }
        Ok(())
    }
}

/// Mean of the window in m/s², if the window is full and its mean is below `brake_mps2`.
fn braking(window: &Column, now: i64, brake_mps2: f64) -> Option<f64> {
    let full = window.at_ns.first().is_some_and(|oldest| now - oldest >= FULL_NS);
    window.mean().filter(|mean| full && *mean < brake_mps2)
}

gleaner_sdk::lambda!(Hello);

#[cfg(test)]
mod tests {
    use super::*;

    fn window(values: &[f64]) -> Column {
        let at_ns = (0..values.len() as i64).map(|i| i * 100_000_000).collect();
        Column { at_ns, values: values.to_vec() }
    }

    #[test]
    fn a_window_that_is_not_full_is_not_judged() {
        assert_eq!(braking(&window(&[-9.0, -9.0]), 200_000_000, -3.0), None);
    }

    #[test]
    fn braking_is_a_mean_below_the_threshold() {
        assert_eq!(braking(&window(&[-4.0, -5.0, -3.0]), 450_000_000, -3.0), Some(-4.0));
        assert_eq!(braking(&window(&[-3.0, -3.0]), 450_000_000, -3.0), None);
    }
}
