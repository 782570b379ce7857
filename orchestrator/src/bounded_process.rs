//! Programs that must end within a time.

use std::io::{self, Read};
use std::os::unix::process::CommandExt;
use std::process::{Command, Output, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process_group};

/// Maximum length of each output that is kept; the rest is dropped.
const OUTPUT_MAX: u64 = 64 << 10;
/// Interval of looks at the process.
const INTERVAL: Duration = Duration::from_millis(10);

/// Runs `command`, as `Command::output` does, in a process group of its own. After `limit`, the
/// whole group is killed, and the result is `None`.
pub(crate) fn output(command: &mut Command, limit: Duration) -> io::Result<Option<Output>> {
    let command = command.process_group(0).stdin(Stdio::null());
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
    let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
    let until = Instant::now() + limit;
    thread::scope(|scope| {
        let [stdout, stderr] = [
            scope.spawn(move || stdout.map_or_else(Vec::new, kept)),
            scope.spawn(move || stderr.map_or_else(Vec::new, kept)),
        ];
        let status = loop {
            match child.try_wait() {
                Ok(None) if Instant::now() < until => thread::sleep(INTERVAL),
                Ok(Some(status)) => break Ok(Some(status)),
                not_ended => {
                    // It has not been waited for, so that its number is still its own.
                    let _ = kill_process_group(Pid::from_child(&child), Signal::KILL);
                    break not_ended.and_then(|_| child.wait()).map(|_| None);
                }
            }
        };
        let [stdout, stderr] = [stdout, stderr].map(|it| it.join().unwrap_or_default());
        Ok(status?.map(|status| Output { status, stdout, stderr }))
    })
}

fn kept(mut pipe: impl Read) -> Vec<u8> {
    let mut bytes = Vec::new();
    // What cannot be read is lost with the process.
    let _ = pipe.by_ref().take(OUTPUT_MAX).read_to_end(&mut bytes);
    let _ = io::copy(&mut pipe, &mut io::sink());
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_that_takes_too_long_is_killed_with_its_children() {
        let started = Instant::now();
        let mut command = Command::new("sh");
        command.args(["-c", "sleep 1000 & sleep 1000"]);
        assert!(output(&mut command, Duration::from_millis(50)).unwrap().is_none());
        // The pipes are closed only when all of them have ended.
        assert!(started.elapsed() < Duration::from_secs(500));
    }

    #[test]
    fn the_output_of_one_that_ends_is_returned() {
        let mut command = Command::new("sh");
        command.args(["-c", "head -c 200000 /dev/zero; echo no >&2; exit 3"]);
        let ended = output(&mut command, Duration::from_secs(600)).unwrap().unwrap();
        assert_eq!((ended.status.code(), &*ended.stderr), (Some(3), &b"no\n"[..]));
        assert_eq!(ended.stdout.len() as u64, OUTPUT_MAX);
    }
}
