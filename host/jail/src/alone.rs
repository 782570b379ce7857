//! From here on a process stays alone: no new processes, no new sockets, no signals to others,
//! nothing that would let it take more than its share.
//!
//! What it has open stays usable. So a runtime calls this once its topics are open, and before the
//! lambda is let in.

use gleaner_protocol::Layer;

use crate::filter::{Refused, install, install_everywhere};
use crate::{JailError, memory, never};

/// The name of the layer for processes.
pub const PROCESSES: &str = "processes";
/// The name of the layer for sockets.
pub const SOCKETS: &str = "sockets";
/// The name of the layer for what a process shares with others.
pub const SHARE: &str = "others' share";
/// The name of the layer of [`before_interpreter`].
pub const START: &str = "start of the interpreter";

/// Sockets. A pair of connected streams, which reaches nobody else, can still be made.
pub(crate) const NEW_SOCKETS: &[i64] = &[
    libc::SYS_socket,
    libc::SYS_bind,
    libc::SYS_listen,
    libc::SYS_accept,
    libc::SYS_accept4,
    // Those that are open belong to the transport.
    libc::SYS_connect,
    // With a message files can be sent, of which the kernel counts those on their way for all
    // processes of a user.
    libc::SYS_sendmsg,
    libc::SYS_sendmmsg,
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
];
/// The transport needs them, to find its own sockets.
const PIDFDS: &[i64] = &[libc::SYS_pidfd_open, libc::SYS_pidfd_getfd];

/// More of the machine than one's share, memory that outlives a process, and the owners and dates
/// of files, which Landlock leaves alone.
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
    libc::SYS_semop,
    libc::SYS_semtimedop,
    libc::SYS_msgget,
    libc::SYS_msgctl,
    libc::SYS_msgsnd,
    libc::SYS_msgrcv,
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
    // Landlock has known it since Linux 6.2 only.
    libc::SYS_truncate,
    libc::SYS_setrlimit,
    // What the user or the system has a few of, and what others would wait for.
    libc::SYS_inotify_init1,
    libc::SYS_inotify_add_watch,
    libc::SYS_fanotify_init,
    libc::SYS_fanotify_mark,
    libc::SYS_io_setup,
    libc::SYS_timer_create,
    // Pages that a pipe holds are counted by no limit.
    libc::SYS_vmsplice,
    libc::SYS_tee,
    libc::SYS_sync,
    libc::SYS_syncfs,
    FCHMODAT2,
    SETXATTRAT,
    REMOVEXATTRAT,
    FILE_SETATTR,
];
#[cfg(target_arch = "x86_64")]
const SHARED_HERE: &[i64] = &[
    libc::SYS_chmod,
    libc::SYS_chown,
    libc::SYS_lchown,
    libc::SYS_utime,
    libc::SYS_utimes,
    libc::SYS_futimesat,
    libc::SYS_inotify_init,
];
#[cfg(not(target_arch = "x86_64"))]
const SHARED_HERE: &[i64] = &[];

// Younger than libc's lists, with the same numbers on every machine.
const MEMFD_SECRET: i64 = 447;
const FCHMODAT2: i64 = 452;
const SETXATTRAT: i64 = 463;
const REMOVEXATTRAT: i64 = 466;
const FILE_SETATTR: i64 = 469;

/// Requests of `fcntl` that have the kernel send signals to others, leases and watches, for which
/// others wait, and larger pipes, of which a user has a few.
const REQUESTS_OF_FILES: [u64; 6] = [8, 10, 15, 1024, 1026, 1031];
/// Requests of `ioctl`: the same for sockets, and typing into somebody's terminal.
const REQUESTS: [u64; 4] = [0x8901, 0x8902, libc::TIOCSTI, 0x541C];

/// Types of sockets that DDS has no use for: streams above all, which may connect.
const TYPES: [u64; 5] = [1, 4, 5, 6, 10];

/// Descriptors that a process may still open: a drive's files again, modules, and what the
/// transport makes for a new writer.
const MORE_FILES: u64 = 512;

/// Families of sockets that Linux knows, with some to come.
const FAMILIES: i32 = 64;

/// All bits of an argument.
const ALL: u64 = u32::MAX as u64;
/// The bits of a socket's type that are not flags.
const TYPE: u64 = 0xf;

/// Leaves this process alone, in all of its threads. With `only_counted_memory` it can take none
/// that a [`memory::limit`] does not count. Gives the layers with what was refused; whether they
/// hold is for [`tried`](crate::tried) to see.
///
/// # Errors
///
/// [`JailError::Loose`] if filters work here and another thread of this process cannot have this
/// one: then nothing holds it.
pub fn stay(only_counted_memory: bool) -> Result<Vec<Layer>, JailError> {
    // An epoll can watch each of the others, and of these watches the user has a few: so many
    // descriptors can make 70,000 of them.
    never::open_files_beyond(MORE_FILES);
    Ok(match install_all(only_counted_memory) {
        Ok(()) => vec![
            Layer::yes(PROCESSES, "seccomp: no new ones, no programs, no signals to others"),
            Layer::yes(SOCKETS, "seccomp: no new ones, no connections"),
            Layer::yes(
                SHARE,
                "seccomp: no priorities, no cores, no shared memory, no owners or dates of files",
            ),
        ],
        Err(error @ JailError::Loose(_)) => return Err(error),
        Err(error) => {
            [PROCESSES, SOCKETS, SHARE].map(|name| Layer::no(name, error.told())).to_vec()
        }
    })
}

fn install_all(only_counted_memory: bool) -> Result<(), JailError> {
    let mut refused = no_signals(no_processes(pairs_only(Refused::default())))
        .calls(NEW_SOCKETS)
        .calls(NEW_PROGRAMS)
        .calls(PIDFDS)
        .calls(SHARED)
        .calls(SHARED_HERE)
        // Limits of others. Its own can only become smaller.
        .unless(libc::SYS_prlimit64, 0, 0)
        // Else it would outlive `gleaner-shim`, which watches it.
        .bits(libc::SYS_prctl, 0, ALL, libc::PR_SET_PDEATHSIG as u64);
    for request in REQUESTS_OF_FILES {
        refused = refused.bits(libc::SYS_fcntl, 1, ALL, request);
    }
    for request in REQUESTS {
        refused = refused.bits(libc::SYS_ioctl, 1, ALL, request);
    }
    if only_counted_memory {
        // Others would wait for a file that is locked, and a file that can only be read can be
        // locked.
        refused = refused.calls(&[libc::SYS_flock]);
        refused = match memory::stack() {
            // Moved elsewhere, it would still count as stack, and could be made any size. The
            // allocator moves blocks of data so.
            Some(stack) => counted_only(refused).between(libc::SYS_mremap, 0, stack),
            None => counted_only(refused).calls(&[libc::SYS_mremap]),
        };
    }
    // Without gleaner-shim nobody has done that yet.
    install_everywhere(&Refused::no_clone3()?)?;
    install_everywhere(&refused.filter(libc::EPERM)?)
}

/// What a process that is about to become an interpreter does not need any more: no other process,
/// no socket but those of DDS, and, with `only_counted_memory`, no memory as in [`stay`]. Signals
/// to others neither. Nothing of the lambda's runs until [`stay`], but the interpreter may be any
/// program that calls itself Python.
#[must_use]
pub fn before_interpreter(only_counted_memory: bool) -> Layer {
    match install_before(only_counted_memory) {
        Ok(()) => Layer::yes(
            START,
            "seccomp: no processes, no signals to others, no sockets but those of DDS",
        ),
        Err(error) => Layer::no(START, error.told()),
    }
}

fn install_before(only_counted_memory: bool) -> Result<(), JailError> {
    let mut refused = no_signals(no_processes(pairs_only(Refused::default())));
    if only_counted_memory {
        refused = counted_only(refused);
    }
    for family in 0..FAMILIES {
        if ![libc::AF_INET, libc::AF_INET6, libc::AF_NETLINK].contains(&family) {
            refused = refused.bits(libc::SYS_socket, 0, ALL, u64::from(family.unsigned_abs()));
        }
    }
    for kind in TYPES {
        refused = refused.bits(libc::SYS_socket, 1, TYPE, kind);
    }
    install(&Refused::no_clone3()?)?;
    install(&refused.filter(libc::EPERM)?)
}

fn no_processes(refused: Refused) -> Refused {
    let clone = |refused: Refused, flag: i32| refused.bits(libc::SYS_clone, 0, flag as u64, 0);
    // A thread with files of its own would have as many as a process.
    clone(clone(refused.calls(NEW_PROCESSES), libc::CLONE_THREAD), libc::CLONE_FILES)
}

fn no_signals(refused: Refused) -> Refused {
    let me = u64::from(std::process::id());
    refused.calls(SIGNALS).unless(libc::SYS_kill, 0, me).unless(libc::SYS_tgkill, 0, me)
}

/// No memory but that of the process itself.
fn counted_only(refused: Refused) -> Refused {
    let shared = (libc::MAP_SHARED | libc::MAP_ANONYMOUS) as u64;
    let down = libc::MAP_GROWSDOWN as u64;
    refused
        .bits(libc::SYS_mmap, 3, shared, shared)
        .bits(libc::SYS_mmap, 3, down, down)
        .calls(&[libc::SYS_memfd_create, MEMFD_SECRET])
}

/// Of pairs of sockets only streams: with others one can send to whoever has a name.
pub(crate) fn pairs_only(refused: Refused) -> Refused {
    refused
        .unless(libc::SYS_socketpair, 0, libc::AF_UNIX as u64)
        .bits(libc::SYS_socketpair, 1, TYPE, libc::SOCK_DGRAM as u64)
        .bits(libc::SYS_socketpair, 1, TYPE, libc::SOCK_RAW as u64)
}
