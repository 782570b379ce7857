//! Reports at each tick the time, the missed ticks, and the newest acceleration. Its twin must
//! report the same.

use gleaner_sdk::{Config, Field, Lambda, Result, Tick, Topic, event, input, now_ns};

pub struct Ticker {
    imu: Topic,
    forward: Field,
}

impl Lambda for Ticker {
    fn init(_config: &Config) -> Result<Self> {
        let imu = input("imu")?;
        Ok(Self { forward: imu.field("linear_acceleration.x")?, imu })
    }

    fn on_tick(&mut self, tick: Tick) -> Result<()> {
        let newest = self.imu.newest().map_or(Ok(0.0), |sample| sample.number(&self.forward))?;
        event("tick", newest).with("at", now_ns()).with("missed", tick.missed as i64).send()
    }
}

gleaner_sdk::lambda!(Ticker);
