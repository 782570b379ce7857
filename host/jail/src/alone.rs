//! From here on a process stays alone: no new processes, no new sockets, no signals to others, nothing that would let it take
//! more than its share.
//!
//! What it has open stays usable. So a runtime calls this once its topics are open, and before the lambda is let in.

use gleaner_protocol::Layer;

use crate::JailError;
use crate::filter::{Refused, install_everywhere};

/// What a lambda's manifest grants of it.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub struct Grants {
    /// It may start processes, and end them.
    pub processes: bool,
}

/// The name of the layer for processes.
pub const PROCESSES: &str = "processes";
/// The name of the layer for sockets.
pub const SOCKETS: &str = "sockets";
/// The name of the layer for what a process shares with others.
pub const SHARE: &str = "others' share";

/// Sockets. A pair of connected ones, which reaches nobody else, can still be made.
const NEW_SOCKETS: &[i64] = &[
    libc::SYS_socket,
    libc::SYS_bind,
    libc::SYS_listen,
    libc::SYS_accept,
    libc::SYS_accept4,
    // Those that are open belong to the transport.
    libc::SYS_connect,
];

const NEW_PROGRAMS: &[i64] = &[libc::SYS_execve, libc::SYS_execveat];
#[cfg(target_arch = "x86_64")]
const NEW_PROCESSES: &[i64] = &[libc::SYS_fork, libc::SYS_vfork];
#[cfg(not(target_arch = "x86_64"))]
const NEW_PROCESSES: &[i64] = &[];

/// Signals to others than oneself.
const SIGNALS: &[i64] = &[
    libc::SYS_tkill,
    libc::SYS_rt_sigqueueinfo,
    libc::SYS_rt_tgsigqueueinfo,
    libc::SYS_pidfd_send_signal,
    libc::SYS_pidfd_open,
];

/// More of the machine than one's share, memory that outlives a process, and the owners and dates of files, which Landlock
/// leaves alone.
const SHARED: &[i64] = &[
    libc::SYS_sched_setscheduler,
    libc::SYS_sched_setattr,
    libc::SYS_sched_setparam,
    libc::SYS_sched_setaffinity,
    libc::SYS_setpriority,
    libc::SYS_ioprio_set,
    libc::SYS_shmget,
    libc::SYS_shmat,
    libc::SYS_shmctl,
    libc::SYS_semget,
    libc::SYS_semctl,
    libc::SYS_msgget,
    libc::SYS_msgctl,
    libc::SYS_mq_open,
    libc::SYS_mq_unlink,
    libc::SYS_fchmod,
    libc::SYS_fchmodat,
    libc::SYS_fchown,
    libc::SYS_fchownat,
    libc::SYS_utimensat,
    libc::SYS_setxattr,
    libc::SYS_lsetxattr,
    libc::SYS_fsetxattr,
    libc::SYS_removexattr,
    libc::SYS_lremovexattr,
    libc::SYS_fremovexattr,
];
#[cfg(target_arch = "x86_64")]
const SHARED_HERE: &[i64] =
    &[libc::SYS_chmod, libc::SYS_chown, libc::SYS_lchown, libc::SYS_utime, libc::SYS_utimes, libc::SYS_futimesat];
#[cfg(not(target_arch = "x86_64"))]
const SHARED_HERE: &[i64] = &[];

/// `fchmodat2` is younger than libc's list, and has the same number on every machine.
const FCHMODAT2: i64 = 452;

/// Leaves this process alone, in all of its threads. Gives the layers with what was refused; whether they hold is for
/// [`tried`](crate::tried) to see.
pub fn stay(grants: Grants) -> Vec<Layer> {
    match install_for(grants) {
        Ok(()) => {
            let processes = if grants.processes {
                Layer::no(PROCESSES, "granted by the manifest")
            } else {
                Layer::yes(PROCESSES, "seccomp: no new ones, no programs, no signals to others")
            };
            vec![
                processes,
                Layer::yes(SOCKETS, "seccomp: no new ones, no connections"),
                Layer::yes(SHARE, "seccomp: no priorities, no cores, no shared memory, no owners or dates of files"),
            ]
        }
        Err(error) => [PROCESSES, SOCKETS, SHARE].map(|name| Layer::no(name, error.told())).to_vec(),
    }
}

fn install_for(grants: Grants) -> Result<(), JailError> {
    let me = u64::from(std::process::id());
    let mut refused = Refused::default()
        .calls(NEW_SOCKETS)
        .calls(SHARED)
        .calls(SHARED_HERE)
        // The transport needed it, to find its own sockets.
        .calls(&[libc::SYS_pidfd_getfd])
        .calls(&[FCHMODAT2])
        // Else it would outlive `gleaner-shim`, which watches it.
        .bits(libc::SYS_prctl, 0, u64::from(u32::MAX), libc::PR_SET_PDEATHSIG as u64)
        // Typing into somebody's terminal.
        .bits(libc::SYS_ioctl, 1, u64::from(u32::MAX), libc::TIOCSTI);
    if !grants.processes {
        let thread = libc::CLONE_THREAD as u64;
        refused = refused
            .calls(NEW_PROGRAMS)
            .calls(NEW_PROCESSES)
            .calls(SIGNALS)
            .bits(libc::SYS_clone, 0, thread, 0)
            .unless(libc::SYS_kill, 0, me)
            .unless(libc::SYS_tgkill, 0, me);
    }
    install_everywhere(&refused.filter(libc::EPERM)?)
}
