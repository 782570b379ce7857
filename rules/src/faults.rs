//! When a lambda that faults again and again rests.

/// Faults in a row that are taken for bad luck, or for one bad second of a sensor. From then on the
/// lambda rests.
pub const FAULTS_IN_A_ROW: u32 = 8;

/// The first rest; each further fault doubles it. It counts from the time of the wake: one that
/// runs for longer than its rest, as a long `init` does, has none.
const MIN_BACKOFF_NS: i64 = 100_000_000;

/// The longest rest: so long it takes at most until a lambda runs again whose cause of faults is
/// gone. A lambda that always takes all of a deadline of 100 ms then has a hundredth of the time.
const MAX_BACKOFF_NS: i64 = 10_000_000_000;

/// What the log says when a wake finds a fresh lambda.
pub const REINITIALISED: &str = "gleaner: the lambda was made anew after a fault: what it kept in its variables is gone \
                             (in Python, all but the globals of its module)";

/// What the log says when a lambda begins to rest.
pub const BACKING_OFF: &str = "gleaner: the lambda faulted 8 times in a row: wakes are passed over and counted, for 100 ms and \
                         twice as long after each further fault, 10 s at most, until a wake ends well";

/// Faults without a good wake between them. Time is that of the lambda, so that a replay rests as
/// the vehicle did.
#[derive(Debug, Default)]
pub struct Faults {
    in_a_row: u32,
    backoff_ns: i64,
    /// From the wake that faulted last until the first that may run, without the latter.
    backoff: Option<(i64, i64)>,
}

impl Faults {
    /// Returns whether to skip a wake at that time. A clock that went back is no reason to rest for
    /// long.
    pub fn is_backing_off(&self, at_ns: i64) -> bool {
        self.backoff.is_some_and(|(from, until)| (from..until).contains(&at_ns))
    }

    /// What the log says as a wake begins.
    pub fn begin(&self) -> Option<&'static str> {
        (self.in_a_row > 0).then_some(REINITIALISED)
    }

    /// Counts how the wake at `at_ns` ended, and returns what the log says of it.
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
