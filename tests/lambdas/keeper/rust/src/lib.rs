//! Counts its wakes in scratch, fills it up, and faults in every third wake. Its twin must report
//! the same.

use gleaner_sdk::{Config, Error, Lambda, Result, Tick, event, scratch};

/// Bytes that are added in each wake until scratch is full.
const BULK: usize = 100_000;

pub struct Keeper;

impl Lambda for Keeper {
    fn init(_config: &Config) -> Result<Self> {
        Ok(Self)
    }

    fn on_tick(&mut self, _tick: Tick) -> Result<()> {
        let before = match scratch::get("wakes", 0, 8) {
            Ok(bytes) => bytes.try_into().map(u64::from_le_bytes).unwrap_or_default(),
            Err(error) if error.is(scratch::ScratchErrorKind::NoSuchEntry) => 0,
            Err(error) => return Err(error),
        };
        let wakes = before + 1;
        scratch::put("wakes", &wakes.to_le_bytes())?;
        if let Err(error) = scratch::append("bulk", &vec![wakes as u8; BULK]) {
            scratch::remove("bulk")?;
            event("full", 1.0).with("why", error.to_string().as_str()).send()?;
        }
        let mut event = event("kept", wakes as f64).with("free", scratch::free() as i64);
        for entry in scratch::entries() {
            event = event.with(&entry.name, entry.bytes as i64);
        }
        if let Ok(last) = scratch::get("bulk", (wakes - 1) % 10 * BULK as u64, 2) {
            event = event.with("last", format!("{last:?}").as_str());
        }
        event.send()?;
        if wakes % 3 == 0 { Err(Error::new("every third time")) } else { Ok(()) }
    }
}

gleaner_sdk::lambda!(Keeper);
