//! Real-time priority for the ingress.
//!
//! A burst of a sender on the same machine fills a small socket buffer within 100 us. Linux may put
//! the thread that reads the socket on the sender's core, where it waits for the end of the
//! sender's turn; a page that is new to the process takes as long as a datagram. So a thread of
//! real-time priority, which runs at once, also needs memory that the process has already.
#![allow(unsafe_code)]

use std::io;

use libc::c_int;

/// The lowest real-time priority.
const PRIORITY: c_int = 1;
/// Freed memory at the end of the heap that is so large is given back to the system, except `KEPT`.
#[cfg(target_env = "gnu")]
const MIN_TRIMMED: c_int = 512 << 20;
/// As much as topics map before their first sample.
#[cfg(target_env = "gnu")]
const KEPT: c_int = gleaner_dds::MAX_MAPPED as c_int;
/// Blocks of this size and larger are not kept. Some versions of glibc accept no larger number.
#[cfg(target_env = "gnu")]
const MIN_MAPPED: c_int = 32 << 20;

/// Gives this thread, and those that it starts from now on, real-time priority, and lets the
/// allocator keep freed memory.
///
/// # Errors
///
/// `EPERM` without `CAP_SYS_NICE`, if `RLIMIT_RTPRIO` or a seccomp filter does not permit it.
pub(super) fn enter() -> io::Result<()> {
    let priority = libc::sched_param { sched_priority: PRIORITY };
    // SAFETY: the call reads `priority`, which lives until it returns; 0 is the calling thread.
    if unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const priority) } != 0 {
        return Err(io::Error::last_os_error());
    }
    keep_memory();
    Ok(())
}

/// Lets all threads share one heap, which keeps the memory of freed samples.
fn keep_memory() {
    #[cfg(target_env = "gnu")]
    for (parameter, value) in [
        (libc::M_ARENA_MAX, 1),
        (libc::M_MMAP_THRESHOLD, MIN_MAPPED),
        (libc::M_TRIM_THRESHOLD, MIN_TRIMMED),
        (libc::M_TOP_PAD, KEPT),
    ] {
        // SAFETY: `mallopt` takes two numbers by value and locks what it changes. It fails only
        // for an unknown parameter or value, and then nothing has changed.
        unsafe { libc::mallopt(parameter, value) };
    }
}
