//! Measures live topics: losses and costs, in a private network with `gleaner-player`
//! (Cyclone DDS) as publisher.

mod busy_cores;
mod load;
mod packet_loss;
mod scale;

use std::fs::{File, TryLockError};
use std::io;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Command, ExitStatus};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use gleaner_tests::live::no_player;
use gleaner_tests::{namespace, root};
use rustix::process::{
    Pid, Signal, WaitId, WaitIdOptions, kill_current_process_group, kill_process_group,
    set_parent_process_death_signal, waitid,
};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use crate::measure::Twin;
pub use busy_cores::BusyCores;
pub(crate) use load::LiveProcesses;
pub use scale::{ScaleOptions, loads};

/// Environment variable of the process in the private network: the process that started it.
const ALONE: &str = "GLEANER_BENCH_ALONE";

/// Environment variable of that process: the limit of socket buffers before.
const LIMIT_BEFORE: &str = "GLEANER_BENCH_LIMIT_BEFORE";

/// The system's limit of socket buffers. It applies to all network namespaces, and can be changed
/// in the first one only.
pub(crate) const BUFFER_LIMIT: &str = "/proc/sys/net/core/rmem_max";
const BUFFER_BYTES: u64 = 64 << 20;

/// Runs this program again in a private network; `None` in that process.
///
/// Meanwhile the limit of socket buffers is raised, if that is permitted.
pub fn in_private_network() -> Option<Result<bool, String>> {
    if std::env::var_os(ALONE).is_some() {
        return None;
    }
    Some(start_in_private_network())
}

/// Returns the id of the process that started this one in its private network.
pub(crate) fn starter() -> Option<String> {
    std::env::var(ALONE).ok()
}

fn start_in_private_network() -> Result<bool, String> {
    if let Some(why) = namespace::unavailable().or(no_player()) {
        return Err(why.to_owned());
    }
    // Of two at once, the second one would restore what the first one has set.
    let limit = File::open(BUFFER_LIMIT);
    if let Ok(limit) = &limit
        && let Err(TryLockError::WouldBlock) = limit.try_lock()
    {
        eprintln!(
            "error: another benchmark of live topics runs on this machine\n  help:  wait for its end"
        );
        return Ok(false);
    }
    let before = std::fs::read_to_string(BUFFER_LIMIT).unwrap_or_default();
    let is_small = before.trim().parse::<u64>().is_ok_and(|bytes| bytes < BUFFER_BYTES);
    let raised = is_small && std::fs::write(BUFFER_LIMIT, BUFFER_BYTES.to_string()).is_ok();
    let mut inner = namespace::rerun(ALONE, &std::process::id().to_string());
    inner.args(std::env::args_os().skip(1)).env(LIMIT_BEFORE, before.trim());
    let status = until_end(&mut inner);
    // Restored for the other users of this machine, whatever the benchmark has set.
    if raised || std::fs::read_to_string(BUFFER_LIMIT).is_ok_and(|after| after != before) {
        let _ = std::fs::write(BUFFER_LIMIT, before.trim());
    }
    status.map(|(status, _)| status.success()).map_err(|error| error.to_string())
}

/// Ends this process, in its private network, with all that it has started, once it is asked to or
/// the process that started it has ended.
pub fn end_with_the_starter() {
    let is_asked = Arc::<AtomicBool>::default();
    let registered = signal_hook::flag::register(SIGTERM, Arc::clone(&is_asked));
    registered.expect("this signal can be handled");
    set_parent_process_death_signal(Some(Signal::TERM)).expect("a signal that exists");
    thread::spawn(move || {
        while !is_asked.load(Ordering::Relaxed) {
            thread::sleep(Duration::from_millis(100));
        }
        // The group is that of this process: see `until_end`.
        let _ = kill_current_process_group(Signal::TERM);
        std::process::exit(128 + SIGTERM);
    });
}

/// The limit of socket buffers before this program has changed it; unknown outside of a private
/// network.
pub fn limit_before() -> Option<String> {
    std::env::var(LIMIT_BEFORE).ok()
}

/// Runs a command to its end. A signal that asks this program to end is passed on to the command
/// and all that it has started, so that nothing goes on without it, the end is waited for, and the
/// limit restored. Returns also whether there was such a signal.
pub(crate) fn until_end(command: &mut Command) -> io::Result<(ExitStatus, bool)> {
    let is_asked = Arc::<AtomicBool>::default();
    for asks in [SIGHUP, SIGINT, SIGTERM] {
        signal_hook::flag::register(asks, Arc::clone(&is_asked))?;
    }
    let mut child = command.process_group(0).spawn()?;
    let mut was_asked = false;
    loop {
        let pid = WaitId::Pid(Pid::from_child(&child));
        let looks = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
        if waitid(pid, looks)?.is_some() {
            // What it has left, while its id is still its own.
            let _ = kill_process_group(Pid::from_child(&child), Signal::TERM);
            let status = child.wait()?;
            return Ok((status, was_asked || is_asked.load(Ordering::Relaxed)));
        }
        if is_asked.swap(false, Ordering::Relaxed) {
            was_asked = true;
            // The group is that of the child, which was not waited for yet.
            let group = Pid::from_child(&child);
            let _ = kill_process_group(group, Signal::TERM);
        }
        thread::sleep(Duration::from_millis(100));
    }
}

pub(crate) fn lambda(name: &str, kind: Twin) -> PathBuf {
    root().join("bench/lambdas").join(name).join(kind.folder())
}
