//! Times as programs exchange them: whole nanoseconds.

use std::time::Duration;

/// `duration` in ns. No duration in a manifest comes near to the largest one, 292 years.
pub fn nanoseconds(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}
