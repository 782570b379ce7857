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
    allowed_bytes: usize,
    /// Of all linear memories together: a component may have several.
    memory_bytes: usize,
    /// Of all tables together.
    table_elements: usize,
    refused: Option<usize>,
}

impl Limits {
    pub(super) fn new(memory_bytes: u64) -> Self {
        let allowed_bytes = usize::try_from(memory_bytes).unwrap_or(usize::MAX);
        Self { allowed_bytes, memory_bytes: 0, table_elements: 0, refused: None }
    }

    pub(super) fn forget_refusal(&mut self) {
        self.refused = None;
    }

    /// Bytes asked for beyond the cap, and the cap.
    pub(super) fn refused(&self) -> Option<(u64, u64)> {
        self.refused.map(|asked| (asked as u64, self.allowed_bytes as u64))
    }
}

impl ResourceLimiter for Limits {
    fn memory_growing(&mut self, now: usize, desired: usize, max: Option<usize>) -> wasmtime::Result<bool> {
        let total = self.memory_bytes.saturating_add(desired.saturating_sub(now));
        if total > self.allowed_bytes {
            self.refused = Some(total);
            return Ok(false);
        }
        // Beyond its own maximum it does not grow, and must not be counted as if it had.
        let grows = max.is_none_or(|max| desired <= max);
        if grows {
            self.memory_bytes = total;
        }
        Ok(grows)
    }

    fn table_growing(&mut self, now: usize, desired: usize, max: Option<usize>) -> wasmtime::Result<bool> {
        let total = self.table_elements.saturating_add(desired.saturating_sub(now));
        let grows = total <= TABLE_ELEMENTS && max.is_none_or(|max| desired <= max);
        if grows {
            self.table_elements = total;
        }
        Ok(grows)
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

    #[test]
    fn several_memories_and_tables_count_together() {
        let mut limits = Limits::new(100);
        assert!(limits.memory_growing(0, 60, None).unwrap());
        assert!(!limits.memory_growing(0, 60, None).unwrap());
        assert!(limits.memory_growing(60, 100, None).unwrap());
        assert!(limits.table_growing(0, TABLE_ELEMENTS, None).unwrap());
        assert!(!limits.table_growing(0, 1, None).unwrap());
    }
}
