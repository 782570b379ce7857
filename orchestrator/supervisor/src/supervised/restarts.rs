//! Decides whether and when a lambda is started again after its process has ended.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::process::{EndCause, ProcessFailure};
use crate::restart_delay::{RestartDelay, jittered};

/// Number of ends within [`WINDOW`], and of ends in a row before the lambda was ready, after which
/// it is not started again.
const ENDS_MAX: usize = 5;
const UNREADY_MAX: u32 = 3;
const WINDOW: Duration = Duration::from_secs(600);

/// Number of kills in a row, each within [`SOON`] of being ready or before, after which the lambda
/// is not started again. A user or the kernel does not do that; a thread of the lambda can.
const KILLS_MAX: u32 = 15;
const SOON: Duration = Duration::from_secs(1);

pub(super) enum RestartPolicy {
    /// After every end, but not after a start that fails before a process `was_ready`.
    Run { was_ready: bool, delay: RestartDelay },
    /// Of a deployed lambda: after every end, unless it fails too often.
    Kept { crashes: CrashLoop, faults: RestartDelay, kills: RestartDelay },
}

impl RestartPolicy {
    pub(super) fn of(is_kept: bool) -> Self {
        let (faults, kills) = (RestartDelay::new(), RestartDelay::of_killed());
        match is_kept {
            true => Self::Kept { crashes: CrashLoop::default(), faults, kills },
            false => Self::Run { was_ready: false, delay: faults },
        }
    }

    pub(super) fn became_ready(&mut self) {
        if let Self::Run { was_ready, .. } = self {
            *was_ready = true;
        }
    }

    /// Returns whether a start that fails now is the last one.
    pub(super) fn starts_once(&self) -> bool {
        matches!(self, Self::Run { was_ready: false, .. })
    }

    /// Returns the delay before the next start, or the reason why there is none.
    pub(super) fn after(&mut self, failure: &ProcessFailure) -> Result<Duration, String> {
        let ProcessFailure { reason, ran, ready_for, .. } = failure;
        let (crashes, faults, kills) = match self {
            Self::Run { delay, .. } => return Ok(delay.after(*ran)),
            Self::Kept { crashes, faults, kills } => (crashes, faults, kills),
        };
        let (is_loop, delays) = match failure.cause {
            EndCause::Unusable => return Err(reason.clone()),
            EndCause::Shortage => (None, faults),
            EndCause::Killed => (crashes.killed(ready_for.unwrap_or_default()), kills),
            EndCause::Fault => (crashes.ended(Instant::now(), ready_for.is_some()), faults),
        };
        match is_loop {
            Some(why) => Err(format!("{why}; the last time, {reason}")),
            None => Ok(jittered(delays.after(*ran))),
        }
    }
}

/// The ends of a lambda, for reasons of its own or by kills.
#[derive(Debug, Default)]
pub(super) struct CrashLoop {
    /// Times of the last ends, at most [`ENDS_MAX`].
    ends: VecDeque<Instant>,
    unready: u32,
    kills: u32,
}

impl CrashLoop {
    /// Counts an end at `now`. Returns the reason if the lambda is not to be started again.
    fn ended(&mut self, now: Instant, was_ready: bool) -> Option<String> {
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

    /// Counts a kill by an unknown sender, after the lambda was ready for this time. Returns the
    /// reason if it is not to be started again.
    fn killed(&mut self, ready_for: Duration) -> Option<String> {
        self.kills = if ready_for < SOON { self.kills + 1 } else { 0 };
        let is_loop = self.kills >= KILLS_MAX;
        is_loop.then(|| format!("it was killed {KILLS_MAX} times in a row, within a second each"))
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

    #[test]
    fn only_kills_in_a_row_that_come_soon_are_a_loop() {
        let last = |kills: &[u64]| {
            let mut crashes = CrashLoop::default();
            let ends = kills.iter().map(|ms| crashes.killed(Duration::from_millis(*ms)));
            ends.last().flatten().is_some()
        };
        assert!(last(&[300; 15]) && !last(&[300; 14]));
        let mut one_later = [300; 28];
        one_later[13] = 1000;
        assert!(!last(&one_later));
        assert!(!last(&[1000; 100]), "chaos, once every few seconds");
    }
}
