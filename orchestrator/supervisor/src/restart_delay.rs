//! Delays before restarts.

use std::time::Duration;

/// Delay before the first restart; it doubles with each further one.
const DELAY: Duration = Duration::from_secs(1);
/// As [`DELAY`], of a process that all lambdas need.
const DELAY_SERVICE: Duration = Duration::from_millis(100);
/// Maximum delay, so that a broken deployment does not occupy a core with restarts.
const DELAY_MAX: Duration = Duration::from_secs(30);
/// Run time after which the delay is reset.
const HEALTHY: Duration = Duration::from_secs(60);

/// The delay before the next restart of something.
#[derive(Clone, Debug)]
pub(crate) struct RestartDelay {
    first: Duration,
    next: Duration,
}

impl RestartDelay {
    pub(crate) fn new() -> Self {
        Self { first: DELAY, next: DELAY }
    }

    pub(crate) fn of_service() -> Self {
        Self { first: DELAY_SERVICE, next: DELAY_SERVICE }
    }

    /// Returns the delay after a failure, before which it `ran` for this time.
    pub(crate) fn after(&mut self, ran: Duration) -> Duration {
        let delay = if ran >= HEALTHY { self.first } else { self.next };
        self.next = (delay * 2).min(DELAY_MAX);
        delay
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_double_up_to_a_maximum_and_start_again_after_a_healthy_run() {
        let mut delay = RestartDelay::new();
        let broken: Vec<_> = (0..7).map(|_| delay.after(Duration::ZERO).as_secs()).collect();
        assert_eq!(broken, [1, 2, 4, 8, 16, 30, 30]);
        assert_eq!(delay.after(HEALTHY).as_secs(), 1);
        assert_eq!(delay.after(Duration::ZERO).as_secs(), 2);
        let mut delay = RestartDelay::of_service();
        assert_eq!(delay.after(Duration::ZERO).as_millis(), 100);
        assert_eq!(delay.after(HEALTHY).as_millis(), 100);
    }
}
