//! Delays before restarts.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::Duration;

use rustix::process::Signal;

/// Maximum time between two reports of a process that is ready: it sends one each second.
pub(crate) const SILENCE: Duration = Duration::from_secs(15);
/// Delay before the first restart; it doubles with each further one.
const DELAY: Duration = Duration::from_secs(1);
/// As [`DELAY`], of a process that all lambdas need.
const DELAY_SERVICE: Duration = Duration::from_millis(100);
/// Maximum delay, so that a broken deployment does not occupy a core with restarts.
const DELAY_MAX: Duration = Duration::from_secs(30);
/// As [`DELAY_MAX`], of a process that other programs kill: its own faults do not count here.
const DELAY_KILLED_MAX: Duration = Duration::from_secs(1);
/// Run time after which the delay is reset.
const HEALTHY: Duration = Duration::from_secs(60);

#[derive(Clone, Debug)]
pub(crate) struct RestartDelay {
    first: Duration,
    next: Duration,
    most: Duration,
}

impl RestartDelay {
    pub(crate) fn new() -> Self {
        Self { first: DELAY, next: DELAY, most: DELAY_MAX }
    }

    pub(crate) fn of_service() -> Self {
        Self { first: DELAY_SERVICE, next: DELAY_SERVICE, most: DELAY_MAX }
    }

    pub(crate) fn of_killed() -> Self {
        Self { most: DELAY_KILLED_MAX, ..Self::of_service() }
    }

    /// Returns the delay after a failure, before which it `ran` for this time.
    pub(crate) fn after(&mut self, ran: Duration) -> Duration {
        let delay = if ran >= HEALTHY { self.first } else { self.next };
        self.next = (delay * 2).min(self.most);
        delay
    }
}

/// The delays of a process that all lambdas share: after its own faults, and after kills by other
/// programs.
#[derive(Clone, Debug)]
pub(crate) struct ServiceDelays {
    faults: RestartDelay,
    kills: RestartDelay,
}

impl ServiceDelays {
    pub(crate) fn new() -> Self {
        Self { faults: RestartDelay::of_service(), kills: RestartDelay::of_killed() }
    }

    /// Returns the delay after an end, before which it `ran` for this time.
    pub(crate) fn after(&mut self, ran: Duration, is_killed: bool) -> Duration {
        if is_killed { self.kills.after(ran) } else { jittered(self.faults.after(ran)) }
    }
}

/// Returns whether another program has ended a process: by a signal that no fault of its own sends.
pub(crate) fn was_killed(status: ExitStatus) -> bool {
    let signal = status.signal().and_then(Signal::from_named_raw);
    matches!(signal, Some(Signal::KILL | Signal::TERM | Signal::INT | Signal::HUP))
}

/// Returns the delay, up to a fifth shorter: processes that fail together, such as those of several
/// lambdas without a resource, do not start together again.
pub(crate) fn jittered(delay: Duration) -> Duration {
    let random = RandomState::new().build_hasher().finish();
    let shorter = delay.mul_f64(0.2 * (random as f64 / u64::MAX as f64)).as_millis();
    delay - Duration::from_millis(u64::try_from(shorter).unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the delays after failures, each after running for this time.
    fn delays(mut delay: RestartDelay, ran: &[Duration]) -> Vec<Duration> {
        ran.iter().map(|ran| delay.after(*ran)).collect()
    }

    #[test]
    fn delays_double_up_to_a_maximum_and_start_again_after_a_healthy_run() {
        let mut ran = [Duration::ZERO; 8];
        ran[7] = HEALTHY;
        for (delay, expected) in [
            (RestartDelay::new(), [1000, 2000, 4000, 8000, 16000, 30000, 30000, 1000]),
            (RestartDelay::of_service(), [100, 200, 400, 800, 1600, 3200, 6400, 100]),
            (RestartDelay::of_killed(), [100, 200, 400, 800, 1000, 1000, 1000, 100]),
        ] {
            let millis: Vec<_> = delays(delay, &ran).iter().map(Duration::as_millis).collect();
            assert_eq!(millis, expected);
        }
    }

    #[test]
    fn processes_that_fail_together_do_not_start_together() {
        let delay = Duration::from_secs(10);
        let all: std::collections::BTreeSet<_> = (0..8).map(|_| jittered(delay)).collect();
        assert!(all.len() > 1 && all.iter().all(|it| (8.0..=10.0).contains(&it.as_secs_f64())));
    }
}
