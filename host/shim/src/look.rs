//! A look at a runtime, ten times a second at least: whether there is a reason to kill it.

use std::time::{Duration, Instant};

use gleaner_protocol::{Doing, Killed, Why};
use gleaner_vitals::Pulse;
use gleaner_vitals::usage::{Process, data_limit};

/// Time between two looks that both find a runtime late, before it is killed. After a suspend it
/// has this long to return.
const AGAIN: Duration = Duration::from_millis(100);
/// Longest time that a runtime may be stopped by a signal. Between two wakes nothing is overdue,
/// and it would stay so.
const STOPPED: Duration = Duration::from_millis(350);
/// Longest time above the memory limit, in which a wake must have ended: its own process makes that
/// a fault, and takes the memory away.
const TOO_MUCH: Duration = Duration::from_secs(1);
/// Looks that are further apart than this do not count as two: the shim itself did not run.
const ASLEEP: Duration = Duration::from_secs(1);

/// Most threads of a runtime, its own twenty included. Each costs the kernel some memory that no
/// limit of a process counts.
const THREADS: u64 = 512;
/// Memory that RLIMIT_DATA does not count in a healthy process: stacks, what the loader has made
/// read-only, page tables.
const UNCOUNTED: u64 = 64 << 20;

/// State of the looks at one process.
pub(crate) struct Look {
    pid: u32,
    late: Lasting,
    stopped: Lasting,
    too_much: Lasting,
}

impl Look {
    /// Looks at the process `pid`.
    pub(crate) fn at(pid: u32) -> Self {
        Self {
            pid,
            late: Lasting::default(),
            stopped: Lasting::default(),
            too_much: Lasting::default(),
        }
    }

    /// Returns why to kill the runtime, or the time until the next look.
    pub(crate) fn again(&mut self, pulse: &Pulse) -> Result<Killed, Duration> {
        let overdue = pulse.overdue();
        let late_for = self.late.seen(overdue.is_ok());
        // Asked first: one that is stopped in a wake is late as well, and no deadline is too short.
        if let Some(killed) = self.by_itself(pulse) {
            return Ok(killed);
        }
        match overdue {
            Ok(late) if late_for >= Some(AGAIN) => Ok(late),
            Ok(_) => Err(AGAIN),
            Err(patience) => Err(patience.min(AGAIN)),
        }
    }

    /// Checks the process in `/proc`, which the runtime cannot forge.
    fn by_itself(&mut self, pulse: &Pulse) -> Option<Killed> {
        // One that has just ended has no memory.
        let seen = Process::seen(Some(self.pid))?;
        if let Some(stopped) =
            self.stopped.seen(seen.is_stopped).filter(|stopped| *stopped >= STOPPED)
        {
            let [ran_ns, allowed_ns] = [stopped, STOPPED].map(|time| time.as_nanos() as u64);
            return Some(Killed { ran_ns, allowed_ns, ..pulse.killed(Why::Stopped) });
        }
        if seen.threads > THREADS {
            return Some(pulse.killed(Why::Threads { used: seen.threads, allowed: THREADS }));
        }
        // The kernel's number, which the process cannot raise. What it counts no more, such as
        // pages that were made read-only, is still there.
        if let Some(most) = data_limit(self.pid)
            && seen.held > most.saturating_add(UNCOUNTED)
        {
            return Some(pulse.killed(Why::Memory { used: seen.held, allowed: most }));
        }
        let (share, used) = pulse.share(seen.held)?;
        let lasts =
            self.too_much.seen(share.is_exceeded_by(used)).filter(|lasts| *lasts >= TOO_MUCH)?;
        let killed = pulse.killed(Why::Memory { used, allowed: share.most });
        // A wake that began before is not over: when it is, its own process takes the memory away.
        let came_back = killed.doing == Doing::Rounds || killed.ran_ns < lasts.as_nanos() as u64;
        came_back.then_some(killed)
    }
}

/// Something that is acted upon only if each look for some time has shown it.
#[derive(Default)]
struct Lasting {
    /// The first of these looks, and the last.
    looks: Option<(Instant, Instant)>,
}

impl Lasting {
    /// How long all looks have shown it, if this one does.
    fn seen(&mut self, is_there: bool) -> Option<Duration> {
        self.seen_at(is_there, Instant::now())
    }

    fn seen_at(&mut self, is_there: bool, now: Instant) -> Option<Duration> {
        let first = match self.looks {
            Some((first, last)) if now.duration_since(last) < ASLEEP => first,
            _ => now,
        };
        self.looks = is_there.then_some((first, now));
        is_there.then(|| now.duration_since(first))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lasts_is_what_each_look_shows_and_a_long_sleep_begins_again() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut lasting = Lasting::default();
        assert_eq!(lasting.seen_at(false, at(0)), None);
        assert_eq!(lasting.seen_at(true, at(100)), Some(Duration::ZERO));
        assert_eq!(lasting.seen_at(true, at(300)), Some(Duration::from_millis(200)));
        assert_eq!(lasting.seen_at(false, at(400)), None);
        assert_eq!(lasting.seen_at(true, at(500)), Some(Duration::ZERO));
        assert_eq!(lasting.seen_at(true, at(1500)), Some(Duration::ZERO), "we stood still");
        assert_eq!(lasting.seen_at(true, at(2400)), Some(Duration::from_millis(900)));
    }
}
