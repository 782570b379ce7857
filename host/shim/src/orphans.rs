//! Processes that a runtime started and did not end: they become ours when it ends, and are killed.

use std::fs;
use std::io;
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, WaitOptions, getpid, kill_process, set_child_subreaper, wait};

/// From now on children of our children that lose their parent are ours.
pub(crate) fn adopt() -> io::Result<()> {
    Ok(set_child_subreaper(Some(getpid()))?)
}

/// Kills all processes below this one, and what these leave in turn. Gives their number.
pub(crate) fn end() -> u32 {
    // Whoever starts processes faster than they are killed must not keep us for ever.
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

/// Our children, from the list that the kernel keeps for each thread: the first one starts and
/// adopts them.
fn children() -> Vec<Pid> {
    let list = fs::read_to_string(format!("/proc/self/task/{}/children", std::process::id()))
        .unwrap_or_default();
    list.split_whitespace().filter_map(|pid| pid.parse().ok().and_then(Pid::from_raw)).collect()
}
