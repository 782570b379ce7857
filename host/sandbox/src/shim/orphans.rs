//! Kills the processes that a runtime started and did not end: the shim adopts them.

use std::fs;
use std::io;
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, WaitOptions, getpid, kill_process, set_child_subreaper, wait};

/// Makes this process adopt its descendants that lose their parent.
pub(crate) fn adopt() -> io::Result<()> {
    Ok(set_child_subreaper(Some(getpid()))?)
}

/// Kills all descendants of this process, repeatedly, as they may leave children. Returns the
/// number of processes that ended.
pub(crate) fn kill_all() -> u32 {
    // A process that forks faster than it is killed must not keep the shim for ever.
    let until = Instant::now() + Duration::from_secs(5);
    let mut ended = 0;
    loop {
        let children = children();
        for child in &children {
            let _ = kill_process(*child, Signal::KILL);
        }
        while let Ok(Some(_)) = wait(WaitOptions::NOHANG) {
            ended += 1;
        }
        if children.is_empty() || Instant::now() > until {
            return ended;
        }
        thread::sleep(Duration::from_millis(1));
    }
}

/// Returns the children of this process, from the kernel's list of its first thread, which starts
/// and adopts them.
fn children() -> Vec<Pid> {
    let list = fs::read_to_string(format!("/proc/self/task/{}/children", std::process::id()))
        .unwrap_or_default();
    list.split_whitespace().filter_map(|pid| pid.parse().ok().and_then(Pid::from_raw)).collect()
}
