//! What a store refuses: memory beyond the cap, and host work beyond the fuel.

use wasmtime::ResourceLimiter;

/// Elements of all tables together; a lambda built from Rust has one of some hundred.
const TABLE_ELEMENTS: usize = 20_000;

/// Bytes that the host touches for one unit of fuel: roughly what an instruction of a guest does in the same time.
const BYTES_PER_FUEL: u64 = 8;
/// Fuel for the call itself.
const FUEL_PER_CALL: u64 = 20;

/// Caps memory and remembers what it refused, since a guest only traps afterwards.
pub(super) struct Limits {
    memory_bytes: usize,
    refused: Option<usize>,
}

impl Limits {
    pub(super) fn new(memory_bytes: u64) -> Self {
        Self { memory_bytes: usize::try_from(memory_bytes).unwrap_or(usize::MAX), refused: None }
    }

    pub(super) fn forget_refusal(&mut self) {
        self.refused = None;
    }

    /// Bytes asked for beyond the cap, and the cap.
    pub(super) fn refused(&self) -> Option<(u64, u64)> {
        self.refused.map(|asked| (asked as u64, self.memory_bytes as u64))
    }
}

impl ResourceLimiter for Limits {
    fn memory_growing(&mut self, _now: usize, desired: usize, _max: Option<usize>) -> wasmtime::Result<bool> {
        let fits = desired <= self.memory_bytes;
        if !fits {
            self.refused = Some(desired);
        }
        Ok(fits)
    }

    fn table_growing(&mut self, _now: usize, desired: usize, _max: Option<usize>) -> wasmtime::Result<bool> {
        Ok(desired <= TABLE_ELEMENTS)
    }

    fn instances(&self) -> usize {
        20
    }

    fn memories(&self) -> usize {
        4
    }

    fn tables(&self) -> usize {
        20
    }
}

/// Counts the work of host calls as fuel. The guest's own instructions are counted by the store.
#[derive(Default)]
pub(super) struct Meter {
    used: u64,
    allowed: u64,
}

/// The host has done as much for a guest as its fuel allows.
#[derive(Debug, thiserror::Error)]
#[error("host calls used all fuel")]
pub(super) struct OutOfFuel;

impl Meter {
    pub(super) fn new(allowed: u64) -> Self {
        Self { used: 0, allowed }
    }

    pub(super) fn used(&self) -> u64 {
        self.used
    }

    /// Charges one call that touches `bytes`, before it is done.
    pub(super) fn charge(&mut self, bytes: usize) -> Result<(), OutOfFuel> {
        self.used = self.used.saturating_add(FUEL_PER_CALL + bytes as u64 / BYTES_PER_FUEL);
        if self.used > self.allowed { Err(OutOfFuel) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_is_refused_once_the_fuel_is_used() {
        let mut meter = Meter::new(1000);
        assert!(meter.charge(4000).is_ok());
        assert!(meter.charge(4000).is_err());
        assert_eq!(meter.used(), 1040);
    }

    #[test]
    fn a_refused_growth_is_remembered() {
        let mut limits = Limits::new(100);
        assert!(limits.memory_growing(0, 100, None).unwrap());
        assert_eq!(limits.refused(), None);
        assert!(!limits.memory_growing(100, 101, None).unwrap());
        assert_eq!(limits.refused(), Some((101, 100)));
    }
}
