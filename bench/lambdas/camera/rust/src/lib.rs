//! Does nothing: measures the overhead of the host.

use gleaner_sdk::{Config, Lambda, Result, Sample};

struct CameraLambda;

impl Lambda for CameraLambda {
    fn init(_config: &Config) -> Result<Self> {
        Ok(Self)
    }

    fn on_event(&mut self, _sample: Sample) -> Result<()> {
        Ok(())
    }
}

gleaner_sdk::lambda!(CameraLambda);
