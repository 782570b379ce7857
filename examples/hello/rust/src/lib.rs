//! Hard braking: the mean forward acceleration of the last half second is below a threshold.

use gleaner_sdk::{Column, Config, Field, Lambda, Result, Sample, Topic, event, input, now_ns};

/// Length of the window.
const WINDOW_NS: i64 = 500_000_000;
/// Minimum age of the oldest sample in a full window.
const FULL_NS: i64 = 450_000_000;
/// Pause after a trigger.
const REFRACTORY_NS: i64 = 3_000_000_000;

/// The lambda and its state between wakes.
pub struct Hello {
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

/// Returns the mean of the window in m/s²; none unless the window is full and its mean is below
/// `brake_mps2`.
fn braking(window: &Column, now: i64, brake_mps2: f64) -> Option<f64> {
    let full = window.at_ns.first().is_some_and(|oldest| now - oldest >= FULL_NS);
    window.mean().filter(|mean| full && *mean < brake_mps2)
}

gleaner_sdk::lambda!(Hello);

#[cfg(test)]
mod tests {
    use gleaner_sdk::testing::{Host, Message, Run};

    use super::*;

    /// Runs the lambda over forward accelerations at 100 Hz, in m/s².
    fn drive(forward: &[f64]) -> Run<Hello> {
        let mut run = Host::from_manifest(include_str!("../lambda.toml")).load::<Hello>().unwrap();
        for (n, forward) in (0..).zip(forward) {
            run.deliver(
                "imu",
                n * 10_000_000,
                Message::new().with("linear_acceleration.x", *forward),
            )
            .unwrap();
        }
        assert_eq!(run.faults().next(), None);
        run
    }

    #[test]
    fn hard_braking_is_found_once() {
        let run = drive(&[[0.0; 100], [-5.0; 100], [0.0; 100]].concat());
        let found = run.triggers().collect::<Vec<_>>();
        assert_eq!((found.len(), found[0].label.as_str()), (1, "hard-brake"));
        assert!((1_000_000_000..2_000_000_000).contains(&found[0].at_ns));
    }

    #[test]
    fn a_tap_on_the_brake_is_not_reported() {
        let run = drive(&[[0.0; 100].as_slice(), &[-5.0; 10], &[0.0; 100]].concat());
        assert_eq!(run.triggers().next(), None);
    }

    fn window(values: &[f64]) -> Column {
        let at_ns = (0..values.len() as i64).map(|i| i * 100_000_000).collect();
        Column { at_ns, values: values.to_vec() }
    }

    #[test]
    fn a_window_that_is_not_full_is_ignored() {
        assert_eq!(braking(&window(&[-9.0, -9.0]), 200_000_000, -3.0), None);
    }

    #[test]
    fn braking_is_a_mean_below_the_threshold() {
        assert_eq!(braking(&window(&[-4.0, -5.0, -3.0]), 450_000_000, -3.0), Some(-4.0));
        assert_eq!(braking(&window(&[-3.0, -3.0]), 450_000_000, -3.0), None);
    }
}
