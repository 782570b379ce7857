//! The clock that orders everything on a vehicle.

/// `CLOCK_MONOTONIC`, set to the time of day once. It never goes back, and its stamps can be read
/// as dates.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Clock {
    offset_ns: i64,
}

impl Clock {
    /// A clock that is `offset_ns` ahead of `CLOCK_MONOTONIC`. All processes of a vehicle use the
    /// same.
    pub fn new(offset_ns: i64) -> Self {
        Self { offset_ns }
    }

    /// A clock that shows the time of day now.
    pub fn of_today() -> Self {
        Self::new(time_of_day().saturating_sub(monotonic()))
    }

    /// How far it is ahead of `CLOCK_MONOTONIC`, in ns.
    pub fn offset_ns(&self) -> i64 {
        self.offset_ns
    }

    /// Now, in ns.
    pub fn now(&self) -> i64 {
        self.offset_ns.saturating_add(monotonic())
    }

    /// What `CLOCK_MONOTONIC` shows when this clock shows `at_ns`.
    pub fn monotonic(&self, at_ns: i64) -> i64 {
        at_ns.saturating_sub(self.offset_ns)
    }
}

/// Returns the time of day, in ns since 1970.
pub fn time_of_day() -> i64 {
    let now =
        std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    i64::try_from(now.as_nanos()).unwrap_or(0)
}

/// Returns what CLOCK_MONOTONIC shows, in ns.
pub fn monotonic() -> i64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec.saturating_mul(1_000_000_000).saturating_add(now.tv_nsec)
}
