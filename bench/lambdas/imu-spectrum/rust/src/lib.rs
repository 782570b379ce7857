//! Road roughness with one spectrum for each message: the power of the vertical acceleration in
//! four bands.
//!
//! The numbered rules are at the top of the Python twin, `../python/main.py`. `road_spectrum`
//! implements them; this file calls the host.

pub mod road_spectrum;

use gleaner_sdk::{Config, Field, Lambda, Result, Sample, Topic, event, input};

use road_spectrum::{RoadSpectrum, SAMPLES};

/// The lambda and its buffers.
pub struct ImuSpectrum {
    imu: Topic,
    vertical: Field,
    rough: f64,
    spectrum: RoadSpectrum,
}

impl Lambda for ImuSpectrum {
    fn init(config: &Config) -> Result<Self> {
        let imu = input("imu")?;
        let vertical = imu.field("linear_acceleration.z")?;
        Ok(Self { imu, vertical, rough: config.real("rough")?, spectrum: RoadSpectrum::new()? })
    }

    fn on_event(&mut self, _sample: Sample) -> Result<()> {
        let window = self.imu.column(&self.vertical, SAMPLES as u32)?;
        if window.values.len() < SAMPLES {
            return Ok(());
        }
        let score = self.spectrum.score(&window.values)?;
        if score > self.rough {
            event("rough-road", score).send()?;
        }
        Ok(())
    }
}

gleaner_sdk::lambda!(ImuSpectrum);

#[cfg(test)]
mod tests {
    use gleaner_sdk::testing::{Host, Message};

    use super::*;

    #[test]
    fn each_wake_from_the_256th_sample_on_has_a_score() {
        let manifest = Host::from_manifest(include_str!("../lambda.toml"));
        let mut run = manifest.load::<ImuSpectrum>().unwrap();
        for n in 0..300 {
            // 12.5 Hz at 100 Hz, whose mean square is 4.5 in every window.
            let phase = std::f64::consts::TAU * n as f64 / 8.0;
            let up = Message::new().with("linear_acceleration.z", 9.81 + 3.0 * phase.sin());
            run.deliver("imu", n * 10_000_000, up).unwrap();
            assert_eq!(run.triggers().count() as i64, (n - 254).max(0));
        }
        let is_right = |score: f64| (score - 4.5).abs() < 1e-12;
        assert!(
            run.triggers().all(|it| it.label == "rough-road" && it.score.is_some_and(is_right))
        );
        assert_eq!(run.faults().next(), None);
    }
}
