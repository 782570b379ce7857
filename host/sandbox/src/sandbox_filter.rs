//! Sandboxes a process for its lambda: no new processes, no new sockets, no signals to other
//! processes, no more than its share of the machine.
//!
//! Open files and sockets stay usable, and files can be received over these. So a runtime applies
//! this once its topics are open, and before the lambda is loaded.

use gleaner_protocol::Layer;
use rustix::thread::{SecureComputingMode, secure_computing_mode};

use crate::filter::{ALL, DeniedCalls, install, install_everywhere};
use crate::{JailError, base_filter, layer, memory, sockets};

/// The name of the layer for processes.
pub const PROCESSES: &str = "processes";
/// The name of the layer for resources that a process shares with others.
pub const SHARED_RESOURCES: &str = "shared resources";
/// The name of the layer of [`apply_before_interpreter`].
pub const START: &str = "interpreter start";

/// Returns the layers of a process that serves lambdas, once `installed` has denied it what it does
/// not need: new sockets, which `sockets` names and describes, processes, and shared resources.
///
/// # Errors
///
/// [`JailError::ExistingThread`]: then the sandbox does not hold.
pub(crate) fn service_layers(
    installed: Result<(), JailError>,
    sockets: (&'static str, &str),
) -> Result<[Layer; 3], JailError> {
    let (name, note) = sockets;
    match installed {
        Ok(()) => Ok([
            Layer::yes(name, note),
            Layer::yes(PROCESSES, "seccomp: no new processes, no programs, no signals to others"),
            Layer::yes(
                SHARED_RESOURCES,
                "seccomp: no change of priority, CPU affinity, file owners or dates",
            ),
        ]),
        Err(error @ JailError::ExistingThread(_)) => Err(error),
        Err(error) => {
            Ok([name, PROCESSES, SHARED_RESOURCES].map(|name| Layer::no(name, error.chain())))
        }
    }
}

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
/// Calls that open handles of processes.
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
const FUTEX_REQUEUE: i64 = 456;
const FCHMODAT2: i64 = 452;
const SETXATTRAT: i64 = 463;
const REMOVEXATTRAT: i64 = 466;
const FILE_SETATTR: i64 = 469;

/// Requests of `futex` that act on a second word, for memory that processes share.
const FUTEX_REQUESTS: [i32; 5] = [
    libc::FUTEX_REQUEUE,
    libc::FUTEX_CMP_REQUEUE,
    libc::FUTEX_WAKE_OP,
    libc::FUTEX_WAIT_REQUEUE_PI,
    libc::FUTEX_CMP_REQUEUE_PI,
];
/// The bits of a request of `futex`, and the one that limits it to a process.
const FUTEX_REQUEST: u64 = 0xff;

/// Requests of `fcntl` for signals to other processes, for leases and watches, for which others
/// wait, and for larger pipes, of which a user has few.
const REQUESTS_OF_FILES: [u64; 6] = [8, 10, 15, 1024, 1026, 1031];
/// Requests of `ioctl`: the same for sockets, and input into another user's terminal.
const REQUESTS: [u64; 4] = [0x8901, 0x8902, libc::TIOCSTI, 0x541C];

/// Advice by which a process takes pages of shared memory out of use, or moves them.
const PAGE_ADVICE: [i32; 4] =
    [libc::MADV_REMOVE, libc::MADV_COLD, libc::MADV_PAGEOUT, libc::MADV_COLLAPSE];

/// Number of descriptors that a process may still open: files of a drive opened again, modules, and
/// those that the ingress or the starter sends.
const MORE_FILES: u64 = 512;

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
            Layer::yes(sockets::NAME, "seccomp: no new sockets, no connections"),
            Layer::yes(
                SHARED_RESOURCES,
                "seccomp: no change of priority, CPU affinity, shared memory, file owners or dates",
            ),
        ],
        Err(error @ JailError::ExistingThread(_)) => return Err(error),
        // An interpreter has run code of its environment, which may have denied the call itself.
        Err(JailError::Install(error))
            if only_counted_memory
                && matches!(secure_computing_mode(), Ok(SecureComputingMode::Filter)) =>
        {
            return Err(JailError::ExistingThread(error));
        }
        Err(error) => missing(&error),
    })
}

/// Returns the layers of [`apply`], none of which holds for this reason.
pub fn missing(error: &JailError) -> Vec<Layer> {
    [PROCESSES, sockets::NAME, SHARED_RESOURCES].map(|name| Layer::no(name, error.chain())).to_vec()
}

fn install_all(only_counted_memory: bool) -> Result<(), JailError> {
    let denied = no_removed_pages(sockets::none(DeniedCalls::default()));
    let mut refused = own_process_only(denied).calls(PIDFDS);
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

/// Denies new processes and programs, signals to other processes, and what would take more than a
/// share of the machine.
pub(crate) fn own_process_only(refused: DeniedCalls) -> DeniedCalls {
    let mut refused = no_foreign_queues(no_signals(no_processes(refused)))
        .calls(SHARED)
        .calls(SHARED_HERE)
        // Limits of other processes. A process can only lower its own.
        .unless(libc::SYS_prlimit64, 0, 0)
        // The process must not outlive its parent, which watches it.
        .bits(libc::SYS_prctl, 0, ALL, libc::PR_SET_PDEATHSIG as u64);
    for request in REQUESTS_OF_FILES {
        refused = refused.bits(libc::SYS_fcntl, 1, ALL, request);
    }
    for request in REQUESTS {
        refused = refused.bits(libc::SYS_ioctl, 1, ALL, request);
    }
    refused
}

/// Denies what a process does not need any more when it is about to become an interpreter: other
/// processes and signals to them, sockets, removal of shared pages, and, with
/// `only_counted_memory`, memory as in [`apply`].
/// The lambda's code does not run until [`apply`], but the interpreter may be any program that
/// calls itself Python.
#[must_use]
pub fn apply_before_interpreter(only_counted_memory: bool) -> Layer {
    let installed = install_before(only_counted_memory).map_err(|error| error.chain());
    layer(START, "seccomp: no processes, no signals to others, no sockets", installed)
}

fn install_before(only_counted_memory: bool) -> Result<(), JailError> {
    let denied = no_removed_pages(sockets::none(DeniedCalls::default()));
    let mut refused = no_new_processes(no_signals(denied));
    if only_counted_memory {
        refused = counted_only(refused);
    }
    install(&DeniedCalls::no_clone3()?)?;
    install(&refused.filter(libc::EPERM)?)
}

pub(crate) fn no_processes(refused: DeniedCalls) -> DeniedCalls {
    no_new_processes(refused.calls(NEW_PROGRAMS))
}

fn no_new_processes(refused: DeniedCalls) -> DeniedCalls {
    let clone = |refused: DeniedCalls, flag: i32| refused.bits(libc::SYS_clone, 0, flag as u64, 0);
    // A thread with its own table of files would have as many as a process.
    clone(clone(refused.calls(NEW_PROCESSES), libc::CLONE_THREAD), libc::CLONE_FILES)
}

/// Denies requests that move or wake sleeping threads of other processes, through memory that is
/// shared with them for reading. Libraries use these requests within a process only.
fn no_foreign_queues(refused: DeniedCalls) -> DeniedCalls {
    FUTEX_REQUESTS.iter().fold(refused.calls(&[FUTEX_REQUEUE]), |refused, request| {
        refused.bits(libc::SYS_futex, 1, FUTEX_REQUEST, *request as u64)
    })
}

/// Denies calls that take pages of shared memory away: at its next access, another process that
/// maps the page would wait for their end. Allocators use neither; libraries that reserve space in
/// a file go on without.
fn no_removed_pages(refused: DeniedCalls) -> DeniedCalls {
    PAGE_ADVICE.iter().fold(refused.calls(&[libc::SYS_fallocate]), |refused, advice| {
        refused.bits(libc::SYS_madvise, 2, ALL, *advice as u64)
    })
}

pub(crate) fn no_signals(refused: DeniedCalls) -> DeniedCalls {
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
