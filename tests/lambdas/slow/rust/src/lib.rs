//! Is slower than its camera, or keeps all samples. The host must not fall behind, and must count
//! all losses.

use gleaner_sdk::{Config, Error, Lambda, Result, Sample, Topic, event, input};

struct Slow {
    behaviour: String,
    rounds: i64,
    camera: Topic,
    kept: Vec<Sample>,
    /// Minimum of the number of received samples minus the number of the newest; lost samples have
    /// a number, too.
    least: i64,
}

impl Lambda for Slow {
    fn init(config: &Config) -> Result<Self> {
        let behaviour = config.text("behaviour")?.to_owned();
        Ok(Self {
            behaviour,
            rounds: config.integer("rounds")?,
            camera: input("camera")?,
            kept: Vec::new(),
            least: i64::MAX,
        })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let ahead =
            self.camera.counts().received.cast_signed() - sample.identity().seq.cast_signed();
        self.least = self.least.min(ahead);
        // One may arrive between selection and check.
        if ahead - self.least > 1 {
            event("stale", ahead as f64).send()?;
        }
        match self.behaviour.as_str() {
            "sleep" => {
                for round in 0..self.rounds {
                    std::hint::black_box(round);
                }
            }
            "keep" => self.kept.push(sample),
            other => return Err(Error::new(format!("unknown behaviour `{other}`"))),
        }
        Ok(())
    }
}

gleaner_sdk::lambda!(Slow);
