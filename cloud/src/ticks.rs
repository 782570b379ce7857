//! The ticks of what a process does again and again.

use std::time::Duration;

use tokio::time::{Interval, MissedTickBehavior, interval};

/// Returns ticks, now and then after each interval. One that comes late moves those after it.
pub(crate) fn ticks(period: Duration) -> Interval {
    let mut ticks = interval(period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    ticks
}
