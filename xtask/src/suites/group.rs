//! Runs the command of a suite in a process group of its own, which can be ended as a whole.

use std::io::{self, PipeReader, Read};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::format_duration;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, kill_process_group, waitid};
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM};

/// Time between SIGTERM and SIGKILL. After the first, nextest ends the groups of its tests, for
/// which it gives them 10 s.
const GRACE: Duration = Duration::from_secs(15);

const LOOK_INTERVAL: Duration = Duration::from_millis(100);

pub(super) struct SuiteBounds {
    time: Duration,
    /// Set when all suites are to end.
    is_interrupted: Arc<AtomicBool>,
}

impl SuiteBounds {
    pub(super) fn new(time: Duration) -> Self {
        Self { time, is_interrupted: Arc::default() }
    }

    /// Makes the signals of a terminal end all suites. They would only end this program, and not
    /// the groups that it has started.
    pub(super) fn end_by_signals(&self) {
        for signal in [SIGHUP, SIGINT, SIGQUIT, SIGTERM] {
            let _ = signal_hook::flag::register(signal, Arc::clone(&self.is_interrupted));
        }
    }

    pub(super) fn is_interrupted(&self) -> bool {
        self.is_interrupted.load(Ordering::Relaxed)
    }

    /// Returns the reason why a suite with this deadline has to end, if there is one.
    fn reason(&self, deadline: Instant) -> Option<String> {
        if self.is_interrupted() {
            return Some("interrupted by a signal".to_owned());
        }
        let is_late = Instant::now() >= deadline;
        is_late.then(|| format!("not ended after {}", format_duration(self.time)))
    }
}

/// Runs a suite, and passes each line of both streams to `show`, in order. A suite beyond a bound
/// is ended with its process group, which is an error.
pub(super) fn run(
    mut command: Command,
    bounds: &SuiteBounds,
    show: impl FnMut(&[u8]),
) -> io::Result<ExitStatus> {
    let (reader, writer) = io::pipe()?;
    command.stdin(Stdio::null()).stdout(writer.try_clone()?).stderr(writer).process_group(0);
    let mut child = command.spawn()?;
    // The command holds write ends of the pipe: with them open, reading would never end.
    drop(command);
    let followed = follow(&child, reader, bounds, show);
    if let Ok(None) = followed {
        return child.wait();
    }
    // Until the child is waited for, no other process gets its number.
    let _ = kill_process_group(Pid::from_child(&child), Signal::KILL);
    child.wait()?;
    Err(followed.map_or_else(|error| error, |reason| io::Error::other(reason.unwrap_or_default())))
}

/// Passes lines to `show` until the suite has ended. Returns the reason why it has to be killed, if
/// there is one.
fn follow(
    child: &Child,
    mut reader: PipeReader,
    bounds: &SuiteBounds,
    mut show: impl FnMut(&[u8]),
) -> io::Result<Option<String>> {
    let (mut deadline, mut reason) = (Instant::now() + bounds.time, None);
    let (mut line, mut bytes) = (Vec::new(), [0; 4096]);
    let (mut is_open, mut left_until) = (true, None);
    while is_open || !has_ended(child)? {
        if reason.is_none() {
            reason = bounds.reason(deadline);
            if reason.is_some() {
                let _ = kill_process_group(Pid::from_child(child), Signal::TERM);
                deadline = Instant::now() + GRACE;
            }
        } else if Instant::now() >= deadline {
            break;
        }
        if !is_open {
            thread::sleep(LOOK_INTERVAL);
        } else if is_readable(&reader)? {
            let count = reader.read(&mut bytes)?;
            is_open = count > 0;
            for piece in bytes[..count].split_inclusive(|byte| *byte == b'\n') {
                line.extend_from_slice(piece);
                if line.ends_with(b"\n") {
                    show(&line);
                    line.clear();
                }
            }
        } else if has_ended(child)? {
            let until = *left_until.get_or_insert_with(|| Instant::now() + GRACE);
            if reason.is_none() && Instant::now() >= until {
                reason = Some("it has left a process that holds its output open".to_owned());
                break;
            }
        }
    }
    if !line.is_empty() {
        show(&line);
    }
    Ok(reason)
}

/// Returns whether the child has ended, and leaves it to be waited for.
fn has_ended(child: &Child) -> io::Result<bool> {
    let options = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
    Ok(waitid(WaitId::Pid(Pid::from_child(child)), options)?.is_some())
}

/// Waits for bytes or the end of the pipe, but not for long; returns whether there are any.
fn is_readable(reader: &PipeReader) -> io::Result<bool> {
    let wait = Timespec::try_from(LOOK_INTERVAL).map_err(io::Error::other)?;
    match poll(&mut [PollFd::new(reader, PollFlags::IN)], Some(&wait)) {
        Err(Errno::INTR) => Ok(false),
        ready => Ok(ready? > 0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_suite_is_ended_with_its_process_group() {
        let bounds = SuiteBounds::new(Duration::from_secs(600));
        let mut command = Command::new("sh");
        // Shells report that `sleep` was terminated on standard error.
        let child = "trap 'echo ended; exit' TERM; echo begun; while :; do sleep 0.1; done";
        command.args(["-c", &format!("({child}) 2>/dev/null & wait")]);
        let mut lines = Vec::new();
        let ended = run(command, &bounds, |line| {
            lines.push(String::from_utf8_lossy(line).into_owned());
            bounds.is_interrupted.store(true, Ordering::Relaxed);
        });
        assert_eq!(ended.unwrap_err().to_string(), "interrupted by a signal");
        assert_eq!(lines, ["begun\n", "ended\n"]);
    }

    #[test]
    fn a_suite_that_closes_its_output_is_waited_for() {
        let bounds = SuiteBounds::new(Duration::from_secs(600));
        let mut command = Command::new("sh");
        command.args(["-c", "exec >&- 2>&-; sleep 0.3; exit 3"]);
        assert_eq!(run(command, &bounds, |_| {}).unwrap().code(), Some(3));
        let mut command = Command::new("sh");
        command.args(["-c", "exec >&- 2>&-; sleep 600"]);
        let bounds = SuiteBounds::new(Duration::from_millis(100));
        let ended = run(command, &bounds, |_| {});
        assert_eq!(ended.unwrap_err().to_string(), "not ended after 100ms");
    }
}
