//! Time that the models of a wake take.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use super::Models;
use crate::api::call::Due;
use crate::api::call_time::CallTime;

/// Run time of the models in the current wake. No call waits for another one to read it.
#[derive(Default)]
pub(super) struct ModelTime {
    used_ns: AtomicU64,
    /// The limit; 0 for none.
    allowed_ns: AtomicU64,
    /// Time at which calls end whose guest gives them no due time.
    due: Due,
}

impl Models {
    /// Limits the run time of the models of a wake.
    pub fn limit(&self, allowed: Option<Duration>) {
        let ns = allowed.map_or(0, |it| u64::try_from(it.as_nanos()).unwrap_or(u64::MAX));
        self.time.allowed_ns.store(ns, Ordering::Relaxed);
    }

    /// Begins a wake.
    pub fn begin(&self) {
        self.time.used_ns.store(0, Ordering::Relaxed);
    }

    /// Run time of the models since [`Models::begin`], in ns.
    pub fn run_ns(&self) -> u64 {
        self.time.used_ns.load(Ordering::Relaxed)
    }

    /// Ends calls with this one, also for a guest that gives its calls no due time, as Python does:
    /// a signal interrupts no call into the host. `None` for no deadline.
    pub fn end_with(&self, call: Option<CallTime>) {
        self.time.due.set(call);
    }
}

impl ModelTime {
    /// Returns the earlier of the due times of a call and of its guest.
    pub(super) fn earliest(&self, of_call: &Due) -> Due {
        match (of_call.at(), self.due.at()) {
            (Some(call), Some(guest)) if guest < call => self.due.clone(),
            (None, Some(_)) => self.due.clone(),
            _ => of_call.clone(),
        }
    }

    pub(super) fn add(&self, time: Duration) {
        let ns = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        self.used_ns.fetch_add(ns, Ordering::Relaxed);
    }

    pub(super) fn allowed(&self) -> Option<Duration> {
        let ns = self.allowed_ns.load(Ordering::Relaxed);
        (ns > 0).then_some(Duration::from_nanos(ns))
    }

    /// Returns the time that is left; `None` without a limit.
    pub(super) fn left(&self) -> Option<Duration> {
        let used = Duration::from_nanos(self.used_ns.load(Ordering::Relaxed));
        self.allowed().map(|allowed| allowed.saturating_sub(used))
    }
}
