//! Limits of one call of a lambda: bytes, items, fuel and time. Neither fuel nor a deadline
//! interrupts a call from outside.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use gleaner_lambda::manifest::Limits;
use gleaner_rules::clamps;

use super::call_time::CallTime;
use super::error::DataError;
use super::fuel::{Fuel, OutOfFuel};
use super::shared_bytes::SharedBytes;

/// Limits of one call, shared by all inputs of a lambda.
#[derive(Clone)]
pub struct PerCall {
    /// Maximum number of bytes that it copies out.
    pub(super) bytes: usize,
    /// Maximum number of values of a column or of a list.
    pub(super) items: usize,
    /// Time at which it has to end.
    pub(super) due: Due,
    /// Fuel that the calls of this wake have used.
    pub(super) fuel: Fuel,
}

impl PerCall {
    /// Creates the limits of a call, without a deadline and without a fuel allowance.
    pub fn new(limits: &Limits) -> Self {
        let items = usize::try_from(limits.call_items).unwrap_or(usize::MAX);
        Self {
            bytes: limits.call_bytes.as_usize(),
            items,
            due: Due::default(),
            fuel: Fuel::default(),
        }
    }

    /// Charges a call that touches `bytes` bytes. Each call of a lambda is charged once, before its
    /// work.
    pub(super) fn charge(&self, bytes: impl FnOnce() -> usize) -> Result<(), OutOfFuel> {
        self.fuel.charge(bytes)
    }

    /// Returns `len` bytes of `whole` from `offset`, or fewer where it ends, never because of the
    /// limit, and charges them. `whole` is a `kind` of `topic`.
    pub(super) fn piece(
        &self,
        whole: &SharedBytes,
        (offset, len): (u64, u32),
        kind: &'static str,
        topic: &str,
    ) -> Result<SharedBytes, DataError> {
        let piece = whole.part(offset, len as usize);
        let (bytes, most) = (piece.len(), self.bytes);
        self.charge(|| bytes.min(most))?;
        if bytes > most {
            return Err(DataError::TooLong { kind, topic: topic.to_owned(), bytes, most });
        }
        Ok(piece)
    }

    pub(super) fn clamps(&self) -> clamps::PerCall {
        clamps::PerCall { bytes: self.bytes, items: self.items }
    }
}

/// Time at which the current call into the lambda has to end; long operations check it regularly. A
/// replay has none.
#[derive(Clone, Default)]
pub struct Due(Arc<Mutex<Option<CallTime>>>);

impl Due {
    /// Sets the current call; `None` for no deadline.
    pub fn set(&self, call: Option<CallTime>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = call;
    }

    fn call(&self) -> Option<CallTime> {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the time at which a call that only waits has to end; `None` without a deadline.
    pub(super) fn at(&self) -> Option<Instant> {
        self.call().map(|call| call.end())
    }

    /// Returns an error if the call has to end.
    pub(super) fn check(&self) -> Result<(), DataError> {
        self.allows(0, 1)
    }

    /// Refuses work on `bytes` that no machine can do in the remaining time, since the work cannot
    /// be interrupted. `fastest` is the speed of the fastest machine in bytes per microsecond, so
    /// the deadline is exceeded at most by the factor by which this machine is slower.
    pub(super) fn allows(&self, bytes: usize, fastest: u64) -> Result<(), DataError> {
        let Some(call) = self.call() else { return Ok(()) };
        let needed = Duration::from_micros(bytes as u64 / fastest);
        let left = call.left(needed);
        if left.is_zero() || needed > left { Err(DataError::OutOfTime) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn begun(seconds: u64) -> Option<CallTime> {
        Some(CallTime::begin(Duration::from_secs(seconds)))
    }

    #[test]
    fn a_call_without_time_is_over_and_one_without_a_deadline_is_not() {
        let due = Due::default();
        assert!(due.check().is_ok());
        due.set(begun(3600));
        assert!(due.check().is_ok());
        due.set(begun(0));
        assert!(matches!(due.check(), Err(DataError::OutOfTime)));
        due.set(None);
        assert!(due.check().is_ok() && due.allows(usize::MAX, 1).is_ok());
    }

    #[test]
    fn work_that_cannot_end_in_time_does_not_begin() {
        let due = Due::default();
        due.set(begun(3600));
        assert!(due.allows(3_000_000_000, 1).is_ok());
        assert!(due.allows(4_000_000_000, 1).is_err() && due.allows(4_000_000_000, 2).is_ok());
    }
}
