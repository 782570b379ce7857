//! The sandbox of a compiler, which runs code of a lambda's author: build scripts and macros.
//!
//! It has to start programs, and to change modes and dates of what it writes, so that less can be
//! taken from it than from a lambda's process. It is not started without all of this: the user who
//! requests it does not trust that code.

use gleaner_protocol::{Holds, Layer};

use crate::alone::{NEW_SOCKETS, SOCKETS, pairs_only};
use crate::filter::{Refused, install};
use crate::{JailError, Paths, files, never, tried};

/// Files of other processes, owners and attributes of files, which Landlock leaves alone, and
/// memory that outlives a process.
const CALLS: &[i64] = &[
    libc::SYS_pidfd_getfd,
    libc::SYS_fchown,
    libc::SYS_fchownat,
    libc::SYS_setxattr,
    libc::SYS_lsetxattr,
    libc::SYS_fsetxattr,
    libc::SYS_removexattr,
    libc::SYS_lremovexattr,
    libc::SYS_fremovexattr,
    libc::SYS_shmget,
    libc::SYS_shmat,
    libc::SYS_shmctl,
    libc::SYS_semget,
    libc::SYS_semctl,
    libc::SYS_msgget,
    libc::SYS_msgctl,
    libc::SYS_mq_open,
    libc::SYS_mq_unlink,
    libc::SYS_setpriority,
    libc::SYS_ioprio_set,
];

/// Limits and schedules of processes, of which each may set its own.
const OF_PROCESSES: &[i64] = &[
    libc::SYS_prlimit64,
    libc::SYS_sched_setaffinity,
    libc::SYS_sched_setattr,
    libc::SYS_sched_setparam,
    libc::SYS_sched_setscheduler,
];
#[cfg(target_arch = "x86_64")]
const CALLS_HERE: &[i64] = &[libc::SYS_chown, libc::SYS_lchown];
#[cfg(not(target_arch = "x86_64"))]
const CALLS_HERE: &[i64] = &[];

/// Requests of `ioctl` that insert input into a terminal.
const TYPING: [u64; 2] = [libc::TIOCSTI, 0x541C];

/// From now on this process, and what it starts, can open only `paths` and the system's programs
/// and libraries, and no socket.
///
/// # Errors
///
/// The first layer that does not hold here as a whole.
pub fn enter(paths: &Paths) -> Result<(), Layer> {
    let mut layers = never::forbid();
    layers.push(files::confine(paths));
    layers.push(match filter() {
        Ok(()) => Layer::yes(SOCKETS, "seccomp: no new ones, no connections"),
        Err(error) => Layer::no(SOCKETS, error.told()),
    });
    tried::tried(layers).into_iter().find(|layer| layer.holds != Holds::Yes).map_or(Ok(()), Err)
}

fn filter() -> Result<(), JailError> {
    let mut refused =
        pairs_only(Refused::default()).calls(NEW_SOCKETS).calls(CALLS).calls(CALLS_HERE);
    for call in OF_PROCESSES {
        refused = refused.unless(*call, 0, 0);
    }
    for request in TYPING {
        refused = refused.bits(libc::SYS_ioctl, 1, u64::from(u32::MAX), request);
    }
    install(&refused.filter(libc::EPERM)?)
}
