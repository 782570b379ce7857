//! Converts durations to whole nanoseconds, the unit that programs exchange.

use std::time::Duration;

/// Returns `duration` in ns, at most 292 years, far above any duration in a manifest.
pub fn nanoseconds(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}
