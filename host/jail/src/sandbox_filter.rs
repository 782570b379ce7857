//! Sandboxes a process for its lambda: no new processes, no new sockets, no signals to other
//! processes, no more than its share of the machine.
//!
//! Open files and sockets stay usable. So a runtime applies this once its topics are open, and
//! before the lambda is loaded.

use gleaner_protocol::Layer;

use crate::filter::{DeniedCalls, install, install_everywhere};
use crate::{JailError, base_filter, memory};

/// The name of the layer for processes.
pub const PROCESSES: &str = "processes";
/// The name of the layer for sockets.
pub const SOCKETS: &str = "sockets";
/// The name of the layer for resources that a process shares with others.
pub const SHARED_RESOURCES: &str = "shared resources";
/// The name of the layer of [`apply_before_interpreter`].
pub const START: &str = "interpreter start";

/// Calls that create or connect sockets. A pair of connected streams, which no other process can
/// reach, is still allowed.
pub(crate) const NEW_SOCKETS: &[i64] = &[
    libc::SYS_socket,
    libc::SYS_bind,
    libc::SYS_listen,
    libc::SYS_accept,
    libc::SYS_accept4,
    // The open ones belong to the transport.
    libc::SYS_connect,
    // A message can send files, and the kernel counts those in flight for all processes of a user.
    libc::SYS_sendmsg,
    libc::SYS_sendmmsg,
];

const NEW_PROGRAMS: &[i64] = &[libc::SYS_execve, libc::SYS_execveat];
#[cfg(target_arch = "x86_64")]
const NEW_PROCESSES: &[i64] = &[libc::SYS_fork, libc::SYS_vfork];
#[cfg(not(target_arch = "x86_64"))]
const NEW_PROCESSES: &[i64] = &[];

/// Signals to other processes.
const SIGNALS: &[i64] = &[
    libc::SYS_tkill,
    libc::SYS_rt_sigqueueinfo,
    libc::SYS_rt_tgsigqueueinfo,
    libc::SYS_pidfd_send_signal,
];
/// Calls that the transport needs first, to find its own sockets.
const PIDFDS: &[i64] = &[libc::SYS_pidfd_open, libc::SYS_pidfd_getfd];

/// Calls that take more than a share of the machine, memory that outlives a process, and the owners
/// and dates of files, which Landlock does not restrict.
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
    // Landlock restricts it since Linux 6.2 only.
    libc::SYS_truncate,
    libc::SYS_setrlimit,
    // Resources that are scarce for a user or the system, and those that other processes would wait
    // for.
    libc::SYS_inotify_init1,
    libc::SYS_inotify_add_watch,
    libc::SYS_fanotify_init,
    libc::SYS_fanotify_mark,
    libc::SYS_io_setup,
    libc::SYS_timer_create,
    // No limit counts the pages that a pipe holds.
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

// Newer than the lists of `libc`; the numbers are the same on every architecture.
const MEMFD_SECRET: i64 = 447;
const FCHMODAT2: i64 = 452;
const SETXATTRAT: i64 = 463;
const REMOVEXATTRAT: i64 = 466;
const FILE_SETATTR: i64 = 469;

/// Requests of `fcntl` for signals to other processes, for leases and watches, for which others
/// wait, and for larger pipes, of which a user has few.
const REQUESTS_OF_FILES: [u64; 6] = [8, 10, 15, 1024, 1026, 1031];
/// Requests of `ioctl`: the same for sockets, and input into another user's terminal.
const REQUESTS: [u64; 4] = [0x8901, 0x8902, libc::TIOCSTI, 0x541C];

/// Socket types that DDS does not use: streams above all, which may connect.
const TYPES: [u64; 5] = [1, 4, 5, 6, 10];

/// Number of descriptors that a process may still open: files of a drive opened again, modules, and
/// those of the transport for a new writer.
const MORE_FILES: u64 = 512;

/// Number of socket families: those of Linux, and some to come.
const FAMILIES: i32 = 64;

/// All bits of an argument.
const ALL: u64 = u32::MAX as u64;
/// The bits of a socket's type that are not flags.
const TYPE: u64 = 0xf;

/// Sandboxes all threads of this process. With `only_counted_memory` it can take no memory that
/// [`memory::limit`] does not count. Returns the layers with what they deny;
/// [`self_test`](crate::self_test) verifies them.
///
/// # Errors
///
/// [`JailError::ExistingThread`] if filters work here and another thread of this process cannot
/// have this one: then the sandbox does not hold.
pub fn apply(only_counted_memory: bool) -> Result<Vec<Layer>, JailError> {
    // An epoll can watch every other descriptor, and these watches are limited for each user:
    // 512 descriptors can make 70,000 of them.
    base_filter::limit_open_files_beyond(MORE_FILES);
    Ok(match install_all(only_counted_memory) {
        Ok(()) => vec![
            Layer::yes(PROCESSES, "seccomp: no new processes, no programs, no signals to others"),
            Layer::yes(SOCKETS, "seccomp: no new sockets, no connections"),
            Layer::yes(
                SHARED_RESOURCES,
                "seccomp: no change of priority, CPU affinity, shared memory, file owners or dates",
            ),
        ],
        Err(error @ JailError::ExistingThread(_)) => return Err(error),
        Err(error) => [PROCESSES, SOCKETS, SHARED_RESOURCES]
            .map(|name| Layer::no(name, error.chain()))
            .to_vec(),
    })
}

fn install_all(only_counted_memory: bool) -> Result<(), JailError> {
    let mut refused = no_signals(no_processes(pairs_only(DeniedCalls::default())))
        .calls(NEW_SOCKETS)
        .calls(NEW_PROGRAMS)
        .calls(PIDFDS)
        .calls(SHARED)
        .calls(SHARED_HERE)
        // Limits of other processes. A process can only lower its own.
        .unless(libc::SYS_prlimit64, 0, 0)
        // The process must not outlive `gleaner-shim`, which watches it.
        .bits(libc::SYS_prctl, 0, ALL, libc::PR_SET_PDEATHSIG as u64);
    for request in REQUESTS_OF_FILES {
        refused = refused.bits(libc::SYS_fcntl, 1, ALL, request);
    }
    for request in REQUESTS {
        refused = refused.bits(libc::SYS_ioctl, 1, ALL, request);
    }
    if only_counted_memory {
        // Other processes would wait for a locked file, and a file that is open for reading only
        // can be locked.
        refused = refused.calls(&[libc::SYS_flock]);
        refused = match memory::stack() {
            // A moved stack would still count as stack, and could grow to any size. The allocator
            // moves blocks of data by this call.
            Some(stack) => counted_only(refused).between(libc::SYS_mremap, 0, stack),
            None => counted_only(refused).calls(&[libc::SYS_mremap]),
        };
    }
    // Not done yet if the process was started without gleaner-shim.
    install_everywhere(&DeniedCalls::no_clone3()?)?;
    install_everywhere(&refused.filter(libc::EPERM)?)
}

/// Denies what a process does not need any more when it is about to become an interpreter: other
/// processes and signals to them, sockets but those of DDS, and, with `only_counted_memory`, memory
/// as in [`apply`]. The lambda's code does not run until [`apply`], but the interpreter may be any
/// program that calls itself Python.
#[must_use]
pub fn apply_before_interpreter(only_counted_memory: bool) -> Layer {
    match install_before(only_counted_memory) {
        Ok(()) => Layer::yes(
            START,
            "seccomp: no processes, no signals to others, no sockets but those of DDS",
        ),
        Err(error) => Layer::no(START, error.chain()),
    }
}

fn install_before(only_counted_memory: bool) -> Result<(), JailError> {
    let mut refused = no_signals(no_processes(pairs_only(DeniedCalls::default())));
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
    install(&DeniedCalls::no_clone3()?)?;
    install(&refused.filter(libc::EPERM)?)
}

fn no_processes(refused: DeniedCalls) -> DeniedCalls {
    let clone = |refused: DeniedCalls, flag: i32| refused.bits(libc::SYS_clone, 0, flag as u64, 0);
    // A thread with its own table of files would have as many as a process.
    clone(clone(refused.calls(NEW_PROCESSES), libc::CLONE_THREAD), libc::CLONE_FILES)
}

fn no_signals(refused: DeniedCalls) -> DeniedCalls {
    let me = u64::from(std::process::id());
    refused.calls(SIGNALS).unless(libc::SYS_kill, 0, me).unless(libc::SYS_tgkill, 0, me)
}

/// Denies memory that [`memory::limit`] does not count.
fn counted_only(refused: DeniedCalls) -> DeniedCalls {
    let shared = (libc::MAP_SHARED | libc::MAP_ANONYMOUS) as u64;
    let down = libc::MAP_GROWSDOWN as u64;
    refused
        .bits(libc::SYS_mmap, 3, shared, shared)
        .bits(libc::SYS_mmap, 3, down, down)
        .calls(&[libc::SYS_memfd_create, MEMFD_SECRET])
}

/// Limits pairs of sockets to streams: other kinds can send to any named socket.
pub(crate) fn pairs_only(refused: DeniedCalls) -> DeniedCalls {
    refused
        .unless(libc::SYS_socketpair, 0, libc::AF_UNIX as u64)
        .bits(libc::SYS_socketpair, 1, TYPE, libc::SOCK_DGRAM as u64)
        .bits(libc::SYS_socketpair, 1, TYPE, libc::SOCK_RAW as u64)
}
