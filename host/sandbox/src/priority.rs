//! Gives up the real-time priority that a process has from its starter, for the CPU and for disks.
#![allow(unsafe_code)]

use std::io;

use libc::c_long;

/// Gives this thread, and those that it starts from now on, the priorities of usual programs, if it
/// has those of real time (`chrt`, `ionice -c 1`). Its nice value stays.
///
/// # Errors
///
/// Those of the calls, which only a filter of a container refuses here.
pub fn leave_real_time() -> io::Result<()> {
    let usual = libc::sched_param { sched_priority: 0 };
    // The functions of musl do nothing.
    // SAFETY: the calls take numbers by value, and read `usual`, which lives until they return.
    unsafe {
        let policy = succeeds(libc::syscall(libc::SYS_sched_getscheduler, 0))?;
        let reset = policy & c_long::from(libc::SCHED_RESET_ON_FORK);
        let real_time = [libc::SCHED_FIFO, libc::SCHED_RR, libc::SCHED_DEADLINE];
        if real_time.into_iter().any(|it| policy - reset == c_long::from(it)) {
            let policy = c_long::from(libc::SCHED_OTHER) | reset;
            succeeds(libc::syscall(libc::SYS_sched_setscheduler, 0, policy, &raw const usual))?;
        }
        // Of threads (1), this one (0): class 1, at bit 13, is that of real time. Kernels without
        // the call have no classes.
        if libc::syscall(libc::SYS_ioprio_get, 1, 0) >> 13 == 1 {
            succeeds(libc::syscall(libc::SYS_ioprio_set, 1, 0, 0))?;
        }
    }
    Ok(())
}

fn succeeds(result: c_long) -> io::Result<c_long> {
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(result) }
}
