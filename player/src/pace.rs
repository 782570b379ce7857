//! Computes when a message is due: an absolute schedule, so that delays do not add up.

use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec};

use crate::stamp::now;

#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) enum Rate {
    /// Multiple of the recorded speed.
    Times(f64),
    /// As fast as writers accept.
    Max,
}

impl FromStr for Rate {
    type Err = String;

    fn from_str(text: &str) -> Result<Rate, String> {
        if text == "max" {
            return Ok(Rate::Max);
        }
        let times = text.parse::<f64>().ok().filter(|times| (0.000_1..=10_000.0).contains(times));
        times
            .map(Rate::Times)
            .ok_or_else(|| "write a number greater than 0, at most 10000, or max".to_owned())
    }
}

/// The schedule: maps time in the drive to the monotonic clock.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Pace {
    pub(crate) rate: Rate,
    /// Monotonic time at which the drive begins, in ns.
    pub(crate) begin_ns: i64,
}

/// Interval at which a wait checks whether the player stops.
const SLICE_NS: i64 = 100_000_000;

impl Pace {
    /// Monotonic time at which a message `at_ns` after the begin of the drive is due; `None` if it
    /// is due at once.
    pub(crate) fn due_ns(&self, at_ns: i64) -> Option<i64> {
        match self.rate {
            // A double is exact for the nanoseconds of a hundred days.
            Rate::Times(times) => Some(self.begin_ns.saturating_add((at_ns as f64 / times) as i64)),
            Rate::Max => None,
        }
    }

    /// Waits until a message is due. Returns its delay in ns, or `None` if the player stops.
    pub(crate) fn wait(&self, at_ns: i64, stop: &AtomicBool) -> Option<i64> {
        loop {
            if stop.load(Ordering::Relaxed) {
                return None;
            }
            let now_ns = now(ClockId::Monotonic);
            let Some(due_ns) = self.due_ns(at_ns) else { return Some(0) };
            if now_ns >= due_ns {
                return Some(now_ns - due_ns);
            }
            let until_ns = due_ns.min(now_ns + SLICE_NS);
            let until = Timespec {
                tv_sec: until_ns.div_euclid(1_000_000_000),
                tv_nsec: until_ns.rem_euclid(1_000_000_000),
            };
            // A signal ends the sleep early; the loop checks again.
            let _ = clock_nanosleep_absolute(ClockId::Monotonic, &until);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn due_times_are_computed_from_the_begin_not_from_the_last_message() {
        let pace = Pace { rate: Rate::Times(1.0), begin_ns: 1_000 };
        assert_eq!(pace.due_ns(0), Some(1_000));
        assert_eq!(pace.due_ns(86_400_000_000_007), Some(86_400_000_001_007));
        let twice = Pace { rate: Rate::Times(2.0), begin_ns: 1_000 };
        assert_eq!(twice.due_ns(500), Some(1_250));
        assert_eq!(Pace { rate: Rate::Max, begin_ns: 0 }.due_ns(i64::MAX), None);
    }

    #[test]
    fn extreme_times_in_a_drive_do_not_overflow() {
        let slow = Pace { rate: Rate::Times(0.000_1), begin_ns: i64::MAX - 1 };
        assert_eq!(slow.due_ns(i64::MAX), Some(i64::MAX));
    }

    #[test]
    fn a_wait_ends_when_the_message_is_due_and_not_before() {
        let pace = Pace { rate: Rate::Times(1.0), begin_ns: now(ClockId::Monotonic) };
        let late = pace.wait(20_000_000, &AtomicBool::new(false)).unwrap();
        assert!(late >= 0);
        assert!(now(ClockId::Monotonic) >= pace.begin_ns + 20_000_000);
    }

    #[test]
    fn a_wait_for_a_message_in_the_far_future_ends_when_the_player_stops() {
        let pace = Pace { rate: Rate::Times(1.0), begin_ns: now(ClockId::Monotonic) };
        let stop = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| pace.wait(i64::MAX, &stop));
            // The wait should have begun before the flag is set.
            std::thread::sleep(std::time::Duration::from_millis(20));
            assert!(!waiting.is_finished());
            stop.store(true, Ordering::Relaxed);
            assert_eq!(waiting.join().unwrap(), None);
        });
    }
}
