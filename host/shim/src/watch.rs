//! From the start of a runtime to its end.

use std::io;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use gleaner_jail::cgroup::Group;
use gleaner_protocol::{Doing, ExitRecord, Killed, UNTIL_KILLED};
use gleaner_vitals::Pulse;
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, PidfdFlags, Signal, kill_process, pidfd_open};

use crate::look::Look;
use crate::signals::{Signals, time_of_day_ns};

/// How long to wait for the end of what was killed, before it is killed again.
const UNTIL_GONE: Duration = Duration::from_millis(100);

/// A runtime that has been started.
pub(crate) struct Watched {
    pub(crate) child: Child,
    pub(crate) pulse: Pulse,
    pub(crate) signals: Signals,
    pub(crate) group: Option<Group>,
}

/// How a runtime ended.
pub(crate) struct Ended {
    pid: u32,
    status: ExitStatus,
    killed: Option<Killed>,
    out_of_memory: bool,
    asked: bool,
    doing: Option<Doing>,
    /// Removed last: what was left behind is still in it.
    _group: Option<Group>,
}

impl Watched {
    /// Waits for the end, passes on signals, and kills what is overdue.
    pub(crate) fn until_its_end(mut self) -> io::Result<Ended> {
        let pid = Pid::from_child(&self.child);
        let process = pidfd_open(pid, PidfdFlags::empty())?;
        let mut killed = None;
        let mut look = Look::at(self.child.id());
        let mut asked: Option<Instant> = None;
        loop {
            let patience = match look.again(&self.pulse) {
                Ok(why) => {
                    killed = killed.or(Some(why));
                    kill_process(pid, Signal::KILL)?;
                    UNTIL_GONE
                }
                Err(patience) => patience,
            };
            if asked.is_some_and(|asked| asked.elapsed() >= UNTIL_KILLED) {
                kill_process(pid, Signal::KILL)?;
            }
            let patience = Timespec {
                tv_sec: patience.as_secs().cast_signed(),
                tv_nsec: i64::from(patience.subsec_nanos()),
            };
            let mut heard = [
                PollFd::new(&process, PollFlags::IN),
                PollFd::from_borrowed_fd(self.signals.bell(), PollFlags::IN),
            ];
            match poll(&mut heard, Some(&patience)) {
                Ok(_) | Err(rustix::io::Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
            for signal in self.signals.take() {
                // One that has just ended is not there to be told, which is as good.
                let _ = kill_process(pid, signal);
                asked = asked.or(Some(Instant::now()));
            }
            if let Some(status) = self.child.try_wait()? {
                let full = status.signal() == Some(Signal::ABORT.as_raw()) && self.pulse.was_full();
                let out_of_memory =
                    full || self.group.as_ref().is_some_and(|group| group.killed_for_memory() > 0);
                // It may have come back, or ended by itself, just before it was killed.
                let killed = killed.filter(|_| status.signal() == Some(Signal::KILL.as_raw()));
                let pid = self.child.id();
                let (asked, doing) = (asked.is_some(), Some(self.pulse.doing()));
                return Ok(Ended {
                    pid,
                    status,
                    killed,
                    out_of_memory,
                    asked,
                    doing,
                    _group: self.group,
                });
            }
        }
    }
}

impl Ended {
    pub(crate) fn record(&self, started_ns: i64, orphans: u32) -> ExitRecord {
        // It was our only child that we waited for, but for those that it left behind.
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
            asked: self.asked,
            doing: self.doing,
        }
    }
}
