//! Ends of a lambda that fails again and again.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Number of ends within [`WINDOW`], and of ends in a row before the lambda was ready, after which
/// it is not started again.
const ENDS_MAX: usize = 5;
const UNREADY_MAX: u32 = 3;
const WINDOW: Duration = Duration::from_secs(600);

/// The ends of a lambda for reasons of its own.
#[derive(Debug, Default)]
pub(crate) struct CrashLoop {
    /// Times of the last ends, at most [`ENDS_MAX`].
    ends: VecDeque<Instant>,
    unready: u32,
}

impl CrashLoop {
    /// Counts an end at `now`. Returns the reason if the lambda is not to be started again.
    pub(crate) fn ended(&mut self, now: Instant, was_ready: bool) -> Option<String> {
        self.unready = if was_ready { 0 } else { self.unready + 1 };
        self.ends.push_back(now);
        while self.ends.front().is_some_and(|at| now.duration_since(*at) > WINDOW) {
            self.ends.pop_front();
        }
        if self.unready >= UNREADY_MAX {
            return Some(format!("it failed {UNREADY_MAX} times in a row before it was ready"));
        }
        let minutes = WINDOW.as_secs() / 60;
        let is_loop = self.ends.len() >= ENDS_MAX;
        is_loop.then(|| format!("it failed {ENDS_MAX} times within {minutes} minutes"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the number of the end at which it is not started again: each is at its second, of a
    /// lambda that was ready or not.
    fn quarantined_at(ends: &[(u64, bool)]) -> Option<usize> {
        let (start, mut crashes) = (Instant::now(), CrashLoop::default());
        ends.iter().position(|(second, was_ready)| {
            crashes.ended(start + Duration::from_secs(*second), *was_ready).is_some()
        })
    }

    #[test]
    fn three_ends_before_it_is_ready_or_five_in_ten_minutes_are_a_loop() {
        assert_eq!(quarantined_at(&[(0, false), (1000, false), (2000, false)]), Some(2));
        assert_eq!(quarantined_at(&[(0, false), (1, false), (2, true), (3, false)]), None);
        let often = [0, 100, 200, 300, 400].map(|second| (second, true));
        assert_eq!(quarantined_at(&often), Some(4));
        let rarely = [0, 200, 400, 600, 801, 1002].map(|second| (second, true));
        assert_eq!(quarantined_at(&rarely), None);
    }
}
