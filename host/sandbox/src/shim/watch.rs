//! Watches a child process, a runtime or a compiler, from its start to its end.

use std::io;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use gleaner_protocol::process_stats::Heartbeat;
use gleaner_protocol::{ExitRecord, Killed, Phase, SHUTDOWN_TIMEOUT};
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, Signal, kill_process};

use super::health_check::HealthCheck;
use super::signals::{Signals, time_of_day_ns};
use crate::cgroup::Group;

/// Time to wait for the end of a killed process before it is killed again.
const KILL_INTERVAL: Duration = Duration::from_millis(100);

/// A child process that has been started, with what it takes to watch it.
pub(crate) struct RunningProcess {
    pub(crate) child: Child,
    pub(crate) heartbeat: Heartbeat,
    pub(crate) signals: Signals,
    pub(crate) group: Option<Group>,
}

pub(crate) struct ProcessEnd {
    pid: u32,
    status: ExitStatus,
    killed: Option<Killed>,
    out_of_memory: bool,
    end_requested: bool,
    phase: Option<Phase>,
    /// Kept until the caller has killed the orphans, which are in the group: dropping removes it.
    _group: Option<Group>,
}

impl RunningProcess {
    /// Waits for the end. Meanwhile forwards signals, and kills the process if [`HealthCheck`]
    /// finds a reason, or if it has not ended [`SHUTDOWN_TIMEOUT`] after the first signal.
    pub(crate) fn wait(mut self) -> io::Result<ProcessEnd> {
        let pid = Pid::from_child(&self.child);
        let mut killed = None;
        let mut health = HealthCheck::of(self.child.id());
        let mut end_requested_at: Option<Instant> = None;
        loop {
            let timeout = match health.check(&self.heartbeat) {
                Ok(why) => {
                    killed = killed.or(Some(why));
                    kill_process(pid, Signal::KILL)?;
                    KILL_INTERVAL
                }
                Err(timeout) => timeout,
            };
            if end_requested_at.is_some_and(|at| at.elapsed() >= SHUTDOWN_TIMEOUT) {
                kill_process(pid, Signal::KILL)?;
            }
            let timeout = Timespec {
                tv_sec: timeout.as_secs().cast_signed(),
                tv_nsec: i64::from(timeout.subsec_nanos()),
            };
            let signals = PollFd::from_borrowed_fd(self.signals.as_fd(), PollFlags::IN);
            match poll(&mut [signals], Some(&timeout)) {
                Ok(_) | Err(rustix::io::Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
            for signal in self.signals.take() {
                // The process may just have ended, which makes no difference.
                let _ = kill_process(pid, signal);
                end_requested_at = end_requested_at.or(Some(Instant::now()));
            }
            if let Some(status) = self.child.try_wait()? {
                let has_aborted = status.signal() == Some(Signal::ABORT.as_raw());
                let out_of_memory = has_aborted && self.heartbeat.was_refused_memory()
                    || self.group.as_ref().is_some_and(|group| group.killed_for_memory() > 0);
                // It may have ended by itself just before the kill.
                let killed = killed.filter(|_| status.signal() == Some(Signal::KILL.as_raw()));
                return Ok(ProcessEnd {
                    pid: self.child.id(),
                    status,
                    killed,
                    out_of_memory,
                    end_requested: end_requested_at.is_some(),
                    phase: Some(self.heartbeat.phase()),
                    _group: self.group,
                });
            }
        }
    }
}

impl ProcessEnd {
    /// Returns the record of the end, now. `orphans` processes outlived the child and were killed.
    pub(crate) fn record(&self, started_ns: i64, orphans: u32) -> ExitRecord {
        // The shim has waited for no other processes than this child and its orphans, so the usage
        // of all its children is the usage of these.
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
            end_requested: self.end_requested,
            phase: self.phase,
        }
    }
}
