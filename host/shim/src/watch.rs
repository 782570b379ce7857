//! Watches a runtime from its start to its end.

use std::io;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use gleaner_jail::cgroup::Group;
use gleaner_protocol::{ExitRecord, Killed, Phase, SHUTDOWN_TIMEOUT};
use gleaner_vitals::Pulse;
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, PidfdFlags, Signal, kill_process, pidfd_open};

use crate::health_check::HealthCheck;
use crate::signals::{Signals, time_of_day_ns};

/// Time to wait for the end of a killed process before it is killed again.
const UNTIL_GONE: Duration = Duration::from_millis(100);

/// A runtime that has been started.
pub(crate) struct RunningProcess {
    pub(crate) child: Child,
    pub(crate) pulse: Pulse,
    pub(crate) signals: Signals,
    pub(crate) group: Option<Group>,
}

/// The end of a runtime, and its circumstances.
pub(crate) struct ProcessEnd {
    pid: u32,
    status: ExitStatus,
    killed: Option<Killed>,
    out_of_memory: bool,
    asked: bool,
    phase: Option<Phase>,
    /// Dropped last: orphans are still in the group.
    _group: Option<Group>,
}

impl RunningProcess {
    /// Waits for the end, forwards signals, and kills an overdue runtime.
    pub(crate) fn wait(mut self) -> io::Result<ProcessEnd> {
        let pid = Pid::from_child(&self.child);
        let process = pidfd_open(pid, PidfdFlags::empty())?;
        let mut killed = None;
        let mut health = HealthCheck::of(self.child.id());
        let mut asked: Option<Instant> = None;
        loop {
            let timeout = match health.check(&self.pulse) {
                Ok(why) => {
                    killed = killed.or(Some(why));
                    kill_process(pid, Signal::KILL)?;
                    UNTIL_GONE
                }
                Err(timeout) => timeout,
            };
            if asked.is_some_and(|asked| asked.elapsed() >= SHUTDOWN_TIMEOUT) {
                kill_process(pid, Signal::KILL)?;
            }
            let timeout = Timespec {
                tv_sec: timeout.as_secs().cast_signed(),
                tv_nsec: i64::from(timeout.subsec_nanos()),
            };
            let mut ready = [
                PollFd::new(&process, PollFlags::IN),
                PollFd::from_borrowed_fd(self.signals.bell(), PollFlags::IN),
            ];
            match poll(&mut ready, Some(&timeout)) {
                Ok(_) | Err(rustix::io::Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
            for signal in self.signals.take() {
                // The process may just have ended, which makes no difference.
                let _ = kill_process(pid, signal);
                asked = asked.or(Some(Instant::now()));
            }
            if let Some(status) = self.child.try_wait()? {
                let full = status.signal() == Some(Signal::ABORT.as_raw()) && self.pulse.was_full();
                let out_of_memory =
                    full || self.group.as_ref().is_some_and(|group| group.killed_for_memory() > 0);
                // It may have returned, or ended by itself, just before it was killed.
                let killed = killed.filter(|_| status.signal() == Some(Signal::KILL.as_raw()));
                let pid = self.child.id();
                let (asked, phase) = (asked.is_some(), Some(self.pulse.phase()));
                return Ok(ProcessEnd {
                    pid,
                    status,
                    killed,
                    out_of_memory,
                    asked,
                    phase,
                    _group: self.group,
                });
            }
        }
    }
}

impl ProcessEnd {
    pub(crate) fn record(&self, started_ns: i64, orphans: u32) -> ExitRecord {
        // It was the only child that was waited for, but for its own orphans.
        let usage = getrusage(UsageWho::RUSAGE_CHILDREN).ok();
        let cpu =
            usage.map_or(0, |usage| (usage.user_time() + usage.system_time()).num_microseconds());
        ExitRecord {
            pid: self.pid,
            started_ns,
            ended_ns: time_of_day_ns(),
            code: self.status.code(),
            signal: self.status.signal(),
            killed: self.killed,
            out_of_memory: self.out_of_memory,
            max_rss_bytes: usage
                .map_or(0, |usage| u64::try_from(usage.max_rss()).unwrap_or(0) * 1024),
            cpu_ns: u64::try_from(cpu).unwrap_or(0) * 1000,
            orphans,
            end_requested: self.asked,
            phase: self.phase,
        }
    }
}
