//! What one call of a lambda may take: bytes, items, fuel and time. Neither fuel nor a deadline
//! ends a call from outside.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use gleaner_lambda::manifest::Limits;
use gleaner_rules::clamps;

use super::error::DataError;
use super::fuel::{Fuel, OutOfFuel};

/// What one call may take, for all inputs of a lambda.
#[derive(Clone)]
pub struct PerCall {
    /// Bytes that it copies out.
    pub(super) bytes: usize,
    /// Values of a column or of a list.
    pub(super) items: usize,
    /// When it has to end.
    pub(super) due: Due,
    /// What all of them have cost in this wake.
    pub(super) fuel: Fuel,
}

impl PerCall {
    /// By these limits, without end and without a price.
    pub fn new(limits: &Limits) -> Self {
        let items = usize::try_from(limits.call_items).unwrap_or(usize::MAX);
        Self {
            bytes: limits.call_bytes.as_usize(),
            items,
            due: Due::default(),
            fuel: Fuel::default(),
        }
    }

    /// Charges a call that touches so many bytes. Each call of a lambda is charged once, before its
    /// work.
    pub(super) fn charge(&self, bytes: impl FnOnce() -> usize) -> Result<(), OutOfFuel> {
        self.fuel.charge(bytes)
    }

    /// What it hands out at most.
    pub(super) fn clamps(&self) -> clamps::PerCall {
        clamps::PerCall { bytes: self.bytes, items: self.items }
    }
}

/// Never.
const NEVER: u64 = 0;

/// When the lambda that runs has to end: what takes long looks at it now and then. Never, in a
/// replay.
#[derive(Clone)]
pub struct Due(Arc<Clock>);

struct Clock {
    base: Instant,
    /// In ns since `base`.
    at: AtomicU64,
}

impl Default for Due {
    fn default() -> Self {
        Self(Arc::new(Clock { base: Instant::now(), at: AtomicU64::new(NEVER) }))
    }
}

impl Due {
    /// From now on it is at that time, or never.
    pub fn set(&self, at: Option<Instant>) {
        let since = |at: Instant| {
            at.saturating_duration_since(self.0.base).max(Duration::from_nanos(NEVER + 1))
        };
        let ns = at.map_or(NEVER, |at| u64::try_from(since(at).as_nanos()).unwrap_or(u64::MAX));
        self.0.at.store(ns, Ordering::Relaxed);
    }

    /// Refuses to go on once it is over.
    pub(super) fn check(&self) -> Result<(), DataError> {
        self.allows(0, 1)
    }

    /// Refuses to begin what nothing could end: `bytes` that no machine goes through in the time
    /// that is left. So what is begun takes longer than allowed by no more than this machine is
    /// slower than `fastest`, in bytes for each microsecond.
    pub(super) fn allows(&self, bytes: usize, fastest: u64) -> Result<(), DataError> {
        let at = self.0.at.load(Ordering::Relaxed);
        if at == NEVER {
            return Ok(());
        }
        let left = Duration::from_nanos(at).saturating_sub(self.0.base.elapsed());
        let needed = Duration::from_micros(bytes as u64 / fastest);
        if left.is_zero() || needed > left { Err(DataError::OutOfTime) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_due_in_the_past_is_over_and_what_is_never_due_is_not() {
        let due = Due::default();
        assert!(due.check().is_ok());
        due.set(Some(Instant::now() + Duration::from_secs(3600)));
        assert!(due.check().is_ok());
        for past in [Instant::now(), due.0.base] {
            due.set(Some(past));
            assert!(matches!(due.check(), Err(DataError::OutOfTime)));
        }
        due.set(None);
        assert!(due.check().is_ok() && due.allows(usize::MAX, 1).is_ok());
    }

    #[test]
    fn what_could_not_end_in_time_does_not_begin() {
        let due = Due::default();
        due.set(Some(Instant::now() + Duration::from_secs(3600)));
        assert!(due.allows(3_000_000_000, 1).is_ok());
        assert!(due.allows(4_000_000_000, 1).is_err() && due.allows(4_000_000_000, 2).is_ok());
    }
}
