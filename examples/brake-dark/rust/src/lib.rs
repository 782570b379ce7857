//! Hard braking in the dark: the car brakes while the newest camera frame is dark.

use gleaner_sdk::{Column, Config, Field, Lambda, Result, Sample, Topic, event, input, now_ns};

/// Length of the window.
const WINDOW_NS: i64 = 500_000_000;
/// Minimum age of the oldest sample in a full window.
const FULL_NS: i64 = 450_000_000;
/// Pause after a trigger.
const REFRACTORY_NS: i64 = 3_000_000_000;

/// The lambda and its state between wakes.
pub struct BrakeDark {
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
        // The image is decoded only here, so most frames are never decoded.
        let luma = camera.as_frame()?.mean_luma(None)?;
        if luma < self.dark_luma {
            self.last_ns = Some(now);
            event("brake-dark", -mean).with("luma", luma).send()?;
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

gleaner_sdk::lambda!(BrakeDark);

#[cfg(test)]
mod tests {
    use gleaner_sdk::data::Encoding;
    use gleaner_sdk::testing::{AttributeValue, Host, Message, Run};

    use super::*;

    /// Runs one second of braking at 5 m/s², with an image of one grey level at its end.
    fn brake(grey: u8) -> Run<BrakeDark> {
        let mut run =
            Host::from_manifest(include_str!("../lambda.toml")).load::<BrakeDark>().unwrap();
        for n in 0..100 {
            run.deliver("imu", n * 10_000_000, Message::new().with("linear_acceleration.x", -5.0))
                .unwrap();
        }
        let picture = Message::image(64, 36, Encoding::Rgb8, vec![grey; 64 * 36 * 3]);
        run.deliver("camera", 1_000_000_000, picture).unwrap();
        assert_eq!(run.faults().next(), None);
        run
    }

    #[test]
    fn braking_is_reported_in_the_dark_only() {
        let dark = brake(20);
        let found = dark.triggers().collect::<Vec<_>>();
        assert_eq!(
            (found.len(), found[0].label.as_str(), found[0].score),
            (1, "brake-dark", Some(5.0))
        );
        assert_eq!(found[0].attribute("luma"), Some(&AttributeValue::Real(20.0)));
        assert_eq!(brake(200).triggers().next(), None);
    }

    #[test]
    fn the_threshold_of_darkness_has_a_range() {
        let refused = Host::from_manifest(include_str!("../lambda.toml"))
            .set("dark_luma", 256)
            .load::<BrakeDark>();
        assert!(refused.err().unwrap().to_string().contains("its max is 255"));
    }

    #[test]
    fn an_empty_window_is_not_braking() {
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
