//! Caps the memory and the tables of a store.

use gleaner_lambda::manifest::Limits;
use wasmtime::ResourceLimiter;

use crate::api::fuel::Fuel;

/// Bytes of a page of linear memory.
const PAGE: usize = 64 << 10;

/// Caps memory and tables, and keeps the last refusal, since a guest traps only afterwards.
pub(super) struct Caps {
    memory_allowed: usize,
    tables_allowed: usize,
    /// Size of all linear memories together: a component may have several.
    memory_bytes: usize,
    /// Number of elements of all tables together.
    table_elements: usize,
    refused: Option<RefusedGrowth>,
    fuel: Fuel,
}

/// A request beyond a cap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct RefusedGrowth {
    /// Key in `[limits]`: `memory`, in bytes, or `tables`, in elements.
    pub(super) limit: &'static str,
    pub(super) requested: u64,
    pub(super) allowed: u64,
}

impl Caps {
    /// The caps in `limits`; growth is charged to `fuel`.
    pub(super) fn new(limits: &Limits, fuel: Fuel) -> Self {
        let tables_allowed = usize::try_from(limits.tables).unwrap_or(usize::MAX);
        let memory_allowed = limits.memory.as_usize();
        Self {
            memory_allowed,
            tables_allowed,
            memory_bytes: 0,
            table_elements: 0,
            refused: None,
            fuel,
        }
    }

    pub(super) fn forget_refusal(&mut self) {
        self.refused = None;
    }

    pub(super) fn refused(&self) -> Option<RefusedGrowth> {
        self.refused
    }
}

impl ResourceLimiter for Caps {
    fn memory_growing(
        &mut self,
        now: usize,
        desired: usize,
        max: Option<usize>,
    ) -> wasmtime::Result<bool> {
        let more = desired.saturating_sub(now);
        let total = self.memory_bytes.saturating_add(more);
        let fits = total <= self.memory_allowed;
        // Beyond its own maximum it does not grow, and must not be counted.
        let grows = fits && max.is_none_or(|max| desired <= max);
        // One instruction makes the kernel clear all these pages, and a loop of refusals takes
        // time, too. The initial size of a memory is free, since no loop can repeat it.
        if now > 0 {
            self.fuel.charge(|| if grows { more } else { PAGE })?;
        }
        if !fits {
            let (requested, allowed) = (total as u64, self.memory_allowed as u64);
            self.refused = Some(RefusedGrowth { limit: "memory", requested, allowed });
            return Ok(false);
        }
        if grows {
            self.memory_bytes = total;
        }
        Ok(grows)
    }

    fn table_growing(
        &mut self,
        now: usize,
        desired: usize,
        max: Option<usize>,
    ) -> wasmtime::Result<bool> {
        let total = self.table_elements.saturating_add(desired.saturating_sub(now));
        if total > self.tables_allowed {
            let (requested, allowed) = (total as u64, self.tables_allowed as u64);
            self.refused = Some(RefusedGrowth { limit: "tables", requested, allowed });
            return Ok(false);
        }
        let grows = max.is_none_or(|max| desired <= max);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::api::fuel::OutOfFuel;

    #[test]
    fn the_last_refused_growth_is_kept() {
        let mut caps = caps();
        assert!(caps.memory_growing(0, MIB, None).unwrap());
        assert_eq!(caps.refused(), None);
        assert!(!caps.memory_growing(MIB, MIB + 1, None).unwrap());
        let requested = MIB as u64 + 1;
        assert_eq!(
            caps.refused(),
            Some(RefusedGrowth { limit: "memory", requested, allowed: requested - 1 })
        );
        caps.forget_refusal();
        assert!(!caps.table_growing(0, 101, None).unwrap());
        assert_eq!(
            caps.refused(),
            Some(RefusedGrowth { limit: "tables", requested: 101, allowed: 100 })
        );
    }

    const MIB: usize = 1 << 20;
    /// Fuel of the call that grows a memory.
    const FUEL_PER_CALL: u64 = 20;

    /// Caps of a mebibyte and 100 elements.
    fn caps() -> Caps {
        let mut limits = Limits::default();
        (limits.memory, limits.tables) = (gleaner_base::ByteSize::mib(1), 100);
        let fuel = Fuel::default();
        fuel.begin(1_000_000);
        Caps::new(&limits, fuel)
    }

    #[test]
    fn growing_costs_fuel_by_the_byte_and_a_refusal_as_much_as_a_page() {
        let mut caps = caps();
        let (grown, refused) =
            ((MIB / 2) as u64 / 8 + FUEL_PER_CALL, PAGE as u64 / 8 + FUEL_PER_CALL);
        caps.fuel.begin(grown + 2 * refused - 1);
        assert!(caps.memory_growing(0, MIB / 2, None).unwrap());
        assert_eq!(caps.fuel.used(), 0);
        assert!(caps.memory_growing(MIB / 2, MIB, None).unwrap());
        assert_eq!(caps.fuel.used(), grown);
        assert!(!caps.memory_growing(MIB, 2 * MIB, None).unwrap());
        assert_eq!(caps.fuel.used(), grown + refused);
        let error = caps.memory_growing(MIB, 2 * MIB, None).unwrap_err();
        assert!(error.downcast_ref::<OutOfFuel>().is_some());
    }

    #[test]
    fn several_memories_and_tables_count_together() {
        let mut caps = caps();
        assert!(caps.memory_growing(0, MIB / 2 + 1, None).unwrap());
        assert!(!caps.memory_growing(0, MIB / 2, None).unwrap());
        assert!(caps.memory_growing(MIB / 2 + 1, MIB, None).unwrap());
        assert!(caps.table_growing(0, 100, None).unwrap());
        assert!(!caps.table_growing(0, 1, None).unwrap());
    }
}
