//! The clock that orders all samples of a vehicle.

use std::fmt;

/// `CLOCK_MONOTONIC` with an offset that is set once from the time of day. It never goes back, and
/// its time stamps can be read as dates.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Clock {
    offset_ns: i64,
}

impl Clock {
    /// Creates a clock that is `offset_ns` ahead of `CLOCK_MONOTONIC`. All processes of a vehicle
    /// use the same offset.
    pub fn new(offset_ns: i64) -> Self {
        Self { offset_ns }
    }

    /// Creates a clock that now shows the time of day.
    pub fn from_time_of_day() -> Self {
        Self::new(time_of_day().saturating_sub(monotonic()))
    }

    /// Returns the offset from `CLOCK_MONOTONIC`, in ns.
    pub fn offset_ns(&self) -> i64 {
        self.offset_ns
    }

    /// Returns the time, in ns.
    pub fn now(&self) -> i64 {
        self.offset_ns.saturating_add(monotonic())
    }

    /// Returns the value of `CLOCK_MONOTONIC` at the time `at_ns` of this clock.
    pub fn monotonic(&self, at_ns: i64) -> i64 {
        at_ns.saturating_sub(self.offset_ns)
    }
}

impl fmt::Display for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "CLOCK_MONOTONIC, {} ns ahead", self.offset_ns)
    }
}

/// Returns the time of day, in ns since 1970.
pub fn time_of_day() -> i64 {
    let now =
        std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    i64::try_from(now.as_nanos()).unwrap_or(0)
}

/// Returns the value of `CLOCK_MONOTONIC`, in ns.
pub fn monotonic() -> i64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec.saturating_mul(1_000_000_000).saturating_add(now.tv_nsec)
}
