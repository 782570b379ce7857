//! Road roughness: how much of the vertical acceleration lies at frequencies at which a road shakes a car.
//!
//! The rules stand at the top of its twin, `../python/main.py`, with their numbers. `road` keeps them; here it meets the host.

mod road;

use gleaner_sdk::{Config, Field, Lambda, Result, Sample, Topic, event, input};

use road::{Road, Roughness};

struct ImuFft {
    imu: Topic,
    vertical: Field,
    rough: f64,
    road: Road,
}

impl Lambda for ImuFft {
    fn init(config: &Config) -> Result<Self> {
        let imu = input("imu")?;
        let vertical = imu.field("linear_acceleration.z")?;
        Ok(Self { imu, vertical, rough: config.real("rough")?, road: Road::new(config.real("window_s")?) })
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
