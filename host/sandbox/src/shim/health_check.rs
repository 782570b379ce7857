//! Checks a runtime at least ten times a second, and finds reasons to kill it.

use std::time::{Duration, Instant};

use gleaner_protocol::process_stats::Heartbeat;
use gleaner_protocol::process_stats::usage::{StatusFile, data_limit};
use gleaner_protocol::{KillReason, Killed, Phase};

/// Interval between two checks that both find a runtime late, before it is killed: after a suspend
/// of the machine it has this long to return.
const INTERVAL: Duration = Duration::from_millis(100);
/// Longest time that a runtime may be stopped by a signal. Between two wakes no deadline runs, so
/// it could stay stopped for ever.
const MAX_STOPPED: Duration = Duration::from_millis(350);
/// Longest time above the memory limit. A wake must end within it: the process itself then reports
/// a fault and frees the memory.
const EXCESS: Duration = Duration::from_secs(1);
/// Checks that are further apart are not consecutive: the shim itself did not run.
const MAX_GAP: Duration = Duration::from_secs(1);

/// Thread limit of a runtime, including some twenty of its own. Each thread takes kernel memory
/// that no limit of a process counts.
const MAX_THREADS: u64 = 512;
/// Memory that RLIMIT_DATA does not count in a healthy process: stacks, pages that the loader made
/// read-only, page tables.
const UNCOUNTED: u64 = 64 << 20;

#[derive(Default)]
pub(crate) struct HealthCheck {
    pid: u32,
    /// `None` while it cannot be opened, for example as the system has too many open files.
    status: Option<StatusFile>,
    late: Sustained,
    stopped: Sustained,
    excess: Sustained,
}

impl HealthCheck {
    pub(crate) fn of(pid: u32) -> Self {
        Self { pid, ..Self::default() }
    }

    /// Returns the reason to kill the runtime, or the time until the next check.
    pub(crate) fn check(&mut self, heartbeat: &Heartbeat) -> Result<Killed, Duration> {
        let overdue = heartbeat.overdue();
        let late_for = self.late.seen(overdue.is_ok());
        // Checked first: a runtime that is stopped in a wake is late as well, and the cause is not
        // the deadline.
        if let Some(killed) = self.check_proc(heartbeat) {
            return Ok(killed);
        }
        match overdue {
            Ok(late) if late_for >= Some(INTERVAL) => Ok(late),
            Ok(_) => Err(INTERVAL),
            Err(remaining) => Err(remaining.min(INTERVAL)),
        }
    }

    /// Checks the process in `/proc`, which the runtime cannot forge.
    fn check_proc(&mut self, heartbeat: &Heartbeat) -> Option<Killed> {
        // A process that has just ended has no memory.
        if self.status.is_none() {
            self.status = StatusFile::open(Some(self.pid)).ok();
        }
        let usage = self.status.as_ref()?.usage()?;
        if let Some(stopped) =
            self.stopped.seen(usage.is_stopped).filter(|stopped| *stopped >= MAX_STOPPED)
        {
            let [ran_ns, allowed_ns] = [stopped, MAX_STOPPED].map(|time| time.as_nanos() as u64);
            return Some(Killed { ran_ns, allowed_ns, ..heartbeat.killed(KillReason::Stopped) });
        }
        if usage.threads > MAX_THREADS {
            return Some(
                heartbeat.killed(KillReason::Threads { used: usage.threads, allowed: MAX_THREADS }),
            );
        }
        // The kernel's number, which the process cannot raise. Pages that it no longer counts, such
        // as those made read-only, are still in memory.
        if usage.held > UNCOUNTED
            && let Some(limit) = data_limit(self.pid)
            && usage.held > limit.saturating_add(UNCOUNTED)
        {
            return Some(heartbeat.killed(KillReason::Memory { used: usage.held, allowed: limit }));
        }
        let (share, used) = heartbeat.share(usage.held)?;
        let lasts =
            self.excess.seen(share.is_exceeded_by(used)).filter(|lasts| *lasts >= EXCESS)?;
        let killed = heartbeat.killed(KillReason::Memory { used, allowed: share.most });
        // A wake that began before the excess is not over: when it ends, its own process frees the
        // memory.
        let wake_has_ended =
            killed.phase == Phase::Housekeeping || killed.ran_ns < lasts.as_nanos() as u64;
        wake_has_ended.then_some(killed)
    }
}

/// A condition that counts only if every check for some time has found it.
#[derive(Default)]
struct Sustained {
    /// Times of the first and the last of these checks.
    checks: Option<(Instant, Instant)>,
}

impl Sustained {
    /// Returns how long all checks have found the condition, if this one does.
    fn seen(&mut self, is_found: bool) -> Option<Duration> {
        self.seen_at(is_found, Instant::now())
    }

    fn seen_at(&mut self, is_found: bool, now: Instant) -> Option<Duration> {
        let first = match self.checks {
            Some((first, last)) if now.duration_since(last) < MAX_GAP => first,
            _ => now,
        };
        self.checks = is_found.then_some((first, now));
        is_found.then(|| now.duration_since(first))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_condition_lasts_while_each_check_finds_it_and_a_long_pause_restarts_it() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut sustained = Sustained::default();
        assert_eq!(sustained.seen_at(false, at(0)), None);
        assert_eq!(sustained.seen_at(true, at(100)), Some(Duration::ZERO));
        assert_eq!(sustained.seen_at(true, at(300)), Some(Duration::from_millis(200)));
        assert_eq!(sustained.seen_at(false, at(400)), None);
        assert_eq!(sustained.seen_at(true, at(500)), Some(Duration::ZERO));
        assert_eq!(
            sustained.seen_at(true, at(1500)),
            Some(Duration::ZERO),
            "the shim was suspended"
        );
        assert_eq!(sustained.seen_at(true, at(2400)), Some(Duration::from_millis(900)));
    }
}
