//! Does nothing: what is left is what hosting costs.

use gleaner_sdk::{Config, Lambda, Result, Sample};

struct Empty;

impl Lambda for Empty {
    fn init(_config: &Config) -> Result<Self> {
        Ok(Self)
    }

    fn on_event(&mut self, _sample: Sample) -> Result<()> {
        Ok(())
    }
}

gleaner_sdk::lambda!(Empty);
