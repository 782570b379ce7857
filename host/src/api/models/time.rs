//! Time that the models of a wake take.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Run time of the models in the current wake. No call waits for another one to read it.
#[derive(Default)]
pub(super) struct ModelTime {
    pub(super) used_ns: AtomicU64,
    /// The limit; 0 for none.
    pub(super) allowed_ns: AtomicU64,
}

impl ModelTime {
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
