//! The back-off of a lambda that faults repeatedly.

/// Number of consecutive faults at which the back-off starts. Fewer may be caused by one bad second
/// of a sensor.
pub const FAULTS_IN_A_ROW: u32 = 8;

/// The first back-off; each further fault doubles it. It counts from the time of the wake, so a
/// wake that takes longer than its back-off, for example because of a long `init`, has no effective
/// back-off.
const MIN_BACKOFF_NS: i64 = 100_000_000;

/// The longest back-off, and so the longest time until a lambda runs again after the cause of its
/// faults has ended. A lambda that always uses up a deadline of 100 ms then takes 1 % of the time.
const MAX_BACKOFF_NS: i64 = 10_000_000_000;

/// Log line of a wake that re-initialised the lambda.
pub const REINITIALISED: &str = "gleaner: the lambda was re-initialised after a fault: \
                                 its variables are lost \
                                 (in Python, all but the globals of its module)";

/// Log line at the start of the back-off.
pub const BACKING_OFF: &str = "gleaner: the lambda faulted 8 times in a row: \
                               wakes are skipped and counted, for 100 ms and twice as long after \
                               each further fault, at most 10 s, until a wake succeeds";

/// Counts consecutive faults. Time is that of the lambda, so that a replay backs off as the vehicle
/// did.
#[derive(Debug, Default)]
pub struct Faults {
    in_a_row: u32,
    backoff_ns: i64,
    /// From the last wake that faulted until the first that may run, exclusive.
    backoff: Option<(i64, i64)>,
}

impl Faults {
    /// Returns whether to skip a wake at that time. A clock that goes back ends the back-off.
    pub fn is_backing_off(&self, at_ns: i64) -> bool {
        self.backoff.is_some_and(|(from, until)| (from..until).contains(&at_ns))
    }

    /// Returns the log line for the start of a wake, if any.
    pub fn begin(&self) -> Option<&'static str> {
        (self.in_a_row > 0).then_some(REINITIALISED)
    }

    /// Counts the end of the wake at `at_ns`; returns the log line for it, if any.
    pub fn end(&mut self, at_ns: i64, faulted: bool) -> Option<&'static str> {
        if !faulted {
            *self = Self::default();
            return None;
        }
        self.in_a_row = self.in_a_row.saturating_add(1);
        if self.in_a_row < FAULTS_IN_A_ROW {
            return None;
        }
        self.backoff_ns = (2 * self.backoff_ns).clamp(MIN_BACKOFF_NS, MAX_BACKOFF_NS);
        self.backoff = Some((at_ns, at_ns.saturating_add(self.backoff_ns)));
        (self.in_a_row == FAULTS_IN_A_ROW).then_some(BACKING_OFF)
    }
}
