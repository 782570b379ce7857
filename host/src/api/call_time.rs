//! Time that a call into a lambda takes, and the rule of its deadline.
//!
//! The deadline is CPU time of the calling thread, so that neither a busy machine nor a slow model
//! costs a lambda its state. Waiting is bounded, too: by [`WALL_FACTOR`] times the deadline.

use std::time::{Duration, Instant};

use gleaner_lambda::{Fault, FaultKind};
use rustix::time::{ClockId, clock_gettime};

/// Wall time that a call may take, as a multiple of its deadline.
pub const WALL_FACTOR: u32 = 5;

/// The time of one call, from its start on. Its methods are for the thread that began it.
#[derive(Clone, Copy, Debug)]
pub struct CallTime {
    started: Instant,
    /// CPU time of this thread at the start.
    cpu: Duration,
    allowed: Duration,
}

#[derive(Clone, Copy, Debug, Default)]
pub struct TimeUsed {
    cpu: Duration,
    wall: Duration,
    allowed: Duration,
}

impl CallTime {
    pub fn begin(allowed: Duration) -> Self {
        Self { started: Instant::now(), cpu: thread_cpu(), allowed }
    }

    /// Returns the earliest time at which the call may exceed its deadline.
    pub fn first_check(&self) -> Instant {
        self.started + self.allowed
    }

    /// Returns the time at which the call has to end, even if it only waits.
    pub fn end(&self) -> Instant {
        self.started + self.allowed.saturating_mul(WALL_FACTOR)
    }

    pub fn used(&self) -> TimeUsed {
        let cpu = thread_cpu().saturating_sub(self.cpu);
        TimeUsed { cpu, wall: self.started.elapsed(), allowed: self.allowed }
    }

    /// Returns a lower bound of the time that is left, which is exact unless it exceeds `needed`;
    /// zero if the call has to end.
    pub fn left(&self, needed: Duration) -> Duration {
        // A thread uses no more CPU time than passes, and its clock costs a system call.
        match self.allowed.saturating_sub(self.started.elapsed()) {
            left if left > needed => left,
            _ => self.used().left(),
        }
    }

    /// Returns the time used if the call exceeded its deadline although it returned before it was
    /// interrupted: no check follows an instruction that fills a large memory, or native code.
    pub fn late(&self) -> Option<TimeUsed> {
        let may_be_late = self.started.elapsed() > self.allowed;
        may_be_late.then(|| self.used()).filter(|used| used.is_late())
    }
}

impl TimeUsed {
    fn wall_allowed(self) -> Duration {
        self.allowed.saturating_mul(WALL_FACTOR)
    }

    fn left(self) -> Duration {
        let wall_left = self.wall_allowed().saturating_sub(self.wall);
        self.allowed.saturating_sub(self.cpu).min(wall_left)
    }

    fn is_late(self) -> bool {
        /// Delay with which an interruption may take effect.
        const TOLERANCE: Duration = Duration::from_millis(2);
        let exceeds = |used: Duration, allowed: Duration| used > allowed.saturating_add(TOLERANCE);
        exceeds(self.cpu, self.allowed) || exceeds(self.wall, self.wall_allowed())
    }

    /// Returns the fault of a call that has used this time: CPU time, or wall time if it has waited
    /// for too long. `location` is the place where it was interrupted, as the beginning of the
    /// message.
    pub fn fault(self, location: &str) -> Fault {
        let ms = |time: Duration| time.as_secs_f64() * 1e3;
        let [cpu, wall, allowed] = [self.cpu, self.wall, self.allowed].map(ms);
        let text = format!(
            "{location}used {cpu:.1} ms of CPU ({wall:.1} ms passed); the deadline is \
             {allowed:.1} ms"
        );
        let has_waited = self.cpu < self.allowed && self.wall >= self.wall_allowed();
        let (message, used) = match has_waited {
            true => (format!("{text}, and with waiting {WALL_FACTOR} times that"), self.wall),
            false => (text, self.cpu),
        };
        let ns = |time: Duration| u64::try_from(time.as_nanos()).ok();
        Fault { kind: FaultKind::Deadline, message, used: ns(used), allowed: ns(self.allowed) }
    }
}

fn thread_cpu() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    let seconds = u64::try_from(time.tv_sec).unwrap_or(0);
    Duration::new(seconds, u32::try_from(time.tv_nsec).unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn used([cpu, wall]: [u64; 2]) -> TimeUsed {
        let [cpu, wall, allowed] = [cpu, wall, 10].map(Duration::from_millis);
        TimeUsed { cpu, wall, allowed }
    }

    #[test]
    fn a_call_ends_after_its_deadline_in_cpu_time_or_after_five_times_that() {
        // CPU time and wall time, of a deadline of 10 ms; time left; whether it is a fault, which
        // has used this time in ns, and the end of its message.
        let of_cpu = "the deadline is 10.0 ms";
        let of_wall = "the deadline is 10.0 ms, and with waiting 5 times that";
        for (times, left, is_late, used_ns, end) in [
            ([4, 4], 6, false, 4_000_000, of_cpu),
            // On a busy machine, and while it waits for a model.
            ([4, 12], 6, false, 4_000_000, of_cpu),
            ([1, 45], 5, false, 1_000_000, of_cpu),
            ([10, 12], 0, false, 10_000_000, of_cpu),
            ([13, 13], 0, true, 13_000_000, of_cpu),
            ([0, 50], 0, false, 50_000_000, of_wall),
            ([0, 53], 0, true, 53_000_000, of_wall),
        ] {
            let used = used(times);
            assert_eq!((used.left().as_millis(), used.is_late()), (left, is_late), "{used:?}");
            let (fault, [cpu, wall]) = (used.fault(""), times);
            let text = format!("used {cpu}.0 ms of CPU ({wall}.0 ms passed); {end}");
            assert_eq!((fault.message, fault.used), (text, Some(used_ns)));
        }
    }

    #[test]
    fn a_thread_that_worked_has_no_time_left() {
        let worked = CallTime::begin(Duration::from_millis(20));
        while worked.used().cpu < Duration::from_millis(25) {}
        assert!(worked.left(Duration::ZERO).is_zero() && worked.late().is_some());
    }
}
