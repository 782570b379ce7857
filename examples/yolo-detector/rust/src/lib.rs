//! Objects in front of the car: an event for each camera frame and class that a detector finds.

use gleaner_sdk::inference::{DetectOptions, Model};
use gleaner_sdk::{Config, Lambda, Result, Sample, event};

/// The lambda.
pub struct YoloDetector {
    detector: Model,
    options: DetectOptions,
}

impl Lambda for YoloDetector {
    fn init(config: &Config) -> Result<Self> {
        let classes = config.text("classes")?.split(',').map(|name| name.trim().to_owned());
        let min_score = config.real("min_score")? as f32;
        let options =
            DetectOptions { classes: classes.collect(), min_score, ..DetectOptions::default() };
        Ok(Self { detector: Model::open("detector")?, options })
    }

    fn on_event(&mut self, camera: Sample) -> Result<()> {
        // The pixels stay in the host: highest score first.
        let found = self.detector.detect(&camera.as_frame()?, &self.options)?;
        for (index, best) in found.iter().enumerate() {
            if found[..index].iter().any(|better| better.class == best.class) {
                continue;
            }
            let count = found.iter().filter(|other| other.class == best.class).count();
            event(&best.label, best.score.into())
                .with("count", count as i64)
                .with("x", f64::from(best.x))
                .with("y", f64::from(best.y))
                .with("width", f64::from(best.width))
                .with("height", f64::from(best.height))
                .send()?;
        }
        Ok(())
    }
}

gleaner_sdk::lambda!(YoloDetector);
