//! Charges calls of a lambda: units of fuel for the bytes that the host touches.
//!
//! Each call is charged by the room that does its work, before the work is done. So the price of a
//! call is the same for every kind of guest. Only a guest with an allowance can run out of fuel.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Bytes that the host touches for one unit of fuel: they take about the time of one instruction of
/// a guest.
const BYTES_PER_FUEL: u64 = 8;
/// Fuel for the call itself.
const FUEL_PER_CALL: u64 = 20;
/// The allowance of guests that are not charged.
const ENDLESS: u64 = u64::MAX;

/// Account of the work of host calls in the current wake. A guest's own instructions are counted
/// elsewhere. Clones share one account, which one thread uses.
#[derive(Clone)]
pub struct Fuel(Arc<Account>);

struct Account {
    used: AtomicU64,
    allowed: AtomicU64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("host calls used all fuel")]
pub struct OutOfFuel;

impl Default for Fuel {
    /// An account without an allowance, which refuses nothing.
    fn default() -> Self {
        Self(Arc::new(Account { used: AtomicU64::new(0), allowed: AtomicU64::new(ENDLESS) }))
    }
}

impl Fuel {
    /// Begins a call into the guest, for which host calls may use `allowed` units.
    pub fn begin(&self, allowed: u64) {
        self.0.used.store(0, Ordering::Relaxed);
        self.0.allowed.store(allowed, Ordering::Relaxed);
    }

    /// Number of units used since [`Fuel::begin`].
    pub fn used(&self) -> u64 {
        self.0.used.load(Ordering::Relaxed)
    }

    /// Charges one call that only reads a value.
    pub fn charge_call(&self) -> Result<(), OutOfFuel> {
        self.charge(|| 0)
    }

    /// Charges one call that touches `bytes` bytes, which are not computed for a guest without an
    /// allowance.
    pub fn charge(&self, bytes: impl FnOnce() -> usize) -> Result<(), OutOfFuel> {
        if self.0.allowed.load(Ordering::Relaxed) == ENDLESS {
            return Ok(());
        }
        self.charge_units(bytes() as u64 / BYTES_PER_FUEL)
    }

    /// Charges one call that takes as long as `units` instructions.
    pub fn charge_units(&self, units: u64) -> Result<(), OutOfFuel> {
        let used = self.used().saturating_add(FUEL_PER_CALL).saturating_add(units);
        self.0.used.store(used, Ordering::Relaxed);
        if used > self.0.allowed.load(Ordering::Relaxed) { Err(OutOfFuel) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_is_refused_once_the_fuel_is_used() {
        let fuel = Fuel::default();
        fuel.begin(1000);
        let other = fuel.clone();
        assert!(fuel.charge(|| 4000).is_ok());
        assert!(other.charge(|| 4000).is_err());
        assert_eq!(fuel.used(), 1040);
        fuel.begin(100);
        assert!(fuel.charge_units(80).is_ok() && fuel.charge_units(u64::MAX).is_err());
    }

    #[test]
    fn a_guest_without_an_allowance_is_not_charged() {
        let fuel = Fuel::default();
        assert_eq!(fuel.charge(|| unreachable!("not charged")), Ok(()));
        assert_eq!(fuel.used(), 0);
    }
}
