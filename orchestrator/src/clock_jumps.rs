//! Notices that the clock was set.

use gleaner_base::UtcTime;
use rustix::time::{ClockId, clock_gettime};

/// Difference from which on a clock was set and does not only drift, in s.
const JUMP_S: i64 = 60;

/// The clock, compared with the time since the machine was started.
pub(crate) struct ClockJumps {
    /// Time of the clock at that start, as it was seen last, in s since 1970.
    boot: i64,
}

impl ClockJumps {
    pub(crate) fn new() -> Self {
        let [clock, since_boot] = clocks();
        Self { boot: clock - since_boot }
    }

    /// Returns the text of an event if the clock was set since the last look.
    pub(crate) fn look(&mut self) -> Option<String> {
        self.look_at(clocks())
    }

    fn look_at(&mut self, [clock, since_boot]: [i64; 2]) -> Option<String> {
        let expected = self.boot + since_boot;
        if (clock - expected).abs() < JUMP_S {
            return None;
        }
        self.boot = clock - since_boot;
        let (from, to) = (UtcTime::of(expected), UtcTime::of(clock));
        Some(format!(
            "the clock was set from {from} to {to}; stamps of samples and names of clips go on from \
             the former time until `systemctl restart gleaner`"
        ))
    }
}

/// Returns the time of day and the time since the machine was started, in s. Both go on while it is
/// suspended.
fn clocks() -> [i64; 2] {
    [ClockId::Realtime, ClockId::Boottime].map(|clock| clock_gettime(clock).tv_sec)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_set_clock_is_noticed_once_and_drift_is_not() {
        let mut jumps = ClockJumps { boot: 100 };
        assert_eq!(jumps.look_at([110, 10]), None);
        assert_eq!(jumps.look_at([1_000_159, 1_000_000]), None, "59 s in 11 days");
        let text = jumps.look_at([1_795_695_692, 1_000_003]).unwrap();
        assert!(text.contains("from 1970-01-12T13:48:23Z to 2026-11-26T12:21:32Z"), "{text}");
        assert_eq!(jumps.look_at([1_795_695_702, 1_000_013]), None);
        let back = jumps.look_at([1_795_692_102, 1_000_013]).unwrap();
        assert!(back.contains("to 2026-11-26T11:21:42Z"), "{back}");
    }
}
