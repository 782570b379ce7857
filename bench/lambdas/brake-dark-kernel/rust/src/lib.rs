//! The decision of `examples/brake-dark`, with the mean luma computed by a kernel of the SDK on a
//! copy of the pixels, instead of by the host.

use gleaner_sdk::kernels::{Image, luma};
use gleaner_sdk::{Config, Field, Frame, Lambda, Result, Sample, Topic, event, input, now_ns};

/// Length of the window.
const WINDOW_NS: i64 = 500_000_000;
/// Minimum age of the oldest sample in a full window.
const FULL_NS: i64 = 450_000_000;
/// Pause after a trigger.
const REFRACTORY_NS: i64 = 3_000_000_000;

struct BrakeDarkKernel {
    imu: Topic,
    forward: Field,
    brake_mps2: f64,
    dark_luma: f64,
    last_ns: Option<i64>,
    pixels: Vec<u8>,
}

impl Lambda for BrakeDarkKernel {
    fn init(config: &Config) -> Result<Self> {
        let imu = input("imu")?;
        let forward = imu.field("linear_acceleration.x")?;
        let (brake_mps2, dark_luma) = (config.real("brake_mps2")?, config.real("dark_luma")?);
        Ok(Self { imu, forward, brake_mps2, dark_luma, last_ns: None, pixels: Vec::new() })
    }

    fn on_event(&mut self, camera: Sample) -> Result<()> {
        let now = now_ns();
        let window = self.imu.column_since(&self.forward, now - WINDOW_NS)?;
        let is_full = window.at_ns.first().is_some_and(|oldest| now - oldest >= FULL_NS);
        let is_rested = self.last_ns.is_none_or(|last| now - last >= REFRACTORY_NS);
        let is_due = |mean: &f64| is_full && is_rested && *mean < self.brake_mps2;
        let Some(mean) = window.mean().filter(is_due) else {
            return Ok(());
        };
        let luma = self.mean_luma(&camera.as_frame()?)?;
        if luma < self.dark_luma {
            self.last_ns = Some(now);
            event("brake-dark", -mean).with("luma", luma).send()?;
        }
        Ok(())
    }
}

impl BrakeDarkKernel {
    fn mean_luma(&mut self, frame: &Frame) -> Result<f64> {
        let info = frame.info();
        self.pixels.resize(info.size as usize, 0);
        frame.copy_to(&mut self.pixels)?;
        Ok(luma::mean_luma(&Image::of(&info, &self.pixels)?))
    }
}

gleaner_sdk::lambda!(BrakeDarkKernel);
