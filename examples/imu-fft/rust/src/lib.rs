//! Road roughness: the power of the vertical acceleration at the frequencies at which a road shakes
//! a car.
//!
//! The numbered rules are at the top of the Python twin, `../python/main.py`. `road` implements
//! them; this file calls the host.

pub mod road;

use gleaner_sdk::{Config, Field, Lambda, Result, Sample, Topic, event, input};

use road::{Road, Roughness};

/// The lambda and its state between wakes.
pub struct ImuFft {
    imu: Topic,
    vertical: Field,
    rough: f64,
    road: Road,
}

impl Lambda for ImuFft {
    fn init(config: &Config) -> Result<Self> {
        let imu = input("imu")?;
        let vertical = imu.field("linear_acceleration.z")?;
        Ok(Self {
            imu,
            vertical,
            rough: config.real("rough")?,
            road: Road::new(config.real("window_s")?),
        })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let Some(samples) = self.road.note(sample.stamps().at_ns)? else { return Ok(()) };
        let window = self.imu.column(&self.vertical, samples as u32)?;
        if window.values.len() < samples {
            return Ok(());
        }
        let Roughness { score, peak_hz } = self.road.roughness(&window.at_ns, &window.values)?;
        if score > self.rough {
            event("rough-road", score).with("peak_hz", peak_hz).send()?;
        }
        Ok(())
    }
}

gleaner_sdk::lambda!(ImuFft);

#[cfg(test)]
mod tests {
    use gleaner_sdk::testing::{AttributeValue, Host, Message, Run};

    use super::*;

    /// Runs ten seconds at 100 Hz on a road that shakes the car with a sine of 4 Hz, in m/s².
    fn shake(amplitude: f64) -> Run<ImuFft> {
        let mut run = Host::from_manifest(include_str!("../lambda.toml")).load::<ImuFft>().unwrap();
        for n in 0..1000 {
            let phase = std::f64::consts::TAU * 4.0 * n as f64 / 100.0;
            let up = Message::new().with("linear_acceleration.z", 9.81 + amplitude * phase.sin());
            run.deliver("imu", n * 10_000_000, up).unwrap();
        }
        assert_eq!(run.faults().next(), None);
        run
    }

    #[test]
    fn a_road_that_shakes_the_car_is_rough() {
        let run = shake(3.0);
        let rough = run.triggers().next().expect("a trigger");
        assert_eq!(rough.label, "rough-road");
        let Some(AttributeValue::Real(peak_hz)) = rough.attribute("peak_hz") else {
            panic!("{rough:?}")
        };
        assert!((3.0..5.0).contains(peak_hz), "{peak_hz}");
        assert_eq!(shake(0.1).triggers().next(), None);
    }
}
