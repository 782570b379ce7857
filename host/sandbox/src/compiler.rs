//! The sandbox of a compiler, which runs code of a lambda's author: build scripts and macros; and
//! of pip, which fetches what the author names.
//!
//! A compiler has to start programs, and to change modes and dates of what it writes, so this
//! sandbox is weaker than that of a lambda's process. The compiler is not started unless every
//! layer holds: the user who requests the sandbox does not trust that code.

use gleaner_protocol::{Holds, Layer};

use crate::filter::{ALL, DeniedCalls, install};
use crate::{JailError, Paths, base_filter, files, layer, self_test, sockets};

/// Calls on files of other processes, on owners and attributes of files, which Landlock does not
/// restrict, and on memory that outlives a process.
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

/// Limits and scheduling of processes; each process may set its own.
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

/// Restricts this process and its descendants to `paths` and the system's programs and libraries,
/// without sockets, or with those of the internet only.
///
/// # Errors
///
/// The first layer that does not fully hold on this machine.
pub fn enter(paths: &Paths, has_network: bool) -> Result<(), Layer> {
    let mut layers = base_filter::apply();
    let (name, note) = match has_network {
        true => (sockets::INTERNET_ONLY, "seccomp: no new sockets but those of the internet"),
        false => (sockets::NAME, "seccomp: no new sockets, no connections"),
    };
    layers.push(if has_network { files::confine_client(paths) } else { files::confine(paths) });
    layers.push(layer(name, note, filter(has_network).map_err(|error| error.chain())));
    self_test::verify(layers)
        .into_iter()
        .find(|layer| layer.holds != Holds::Yes)
        .map_or(Ok(()), Err)
}

fn filter(has_network: bool) -> Result<(), JailError> {
    let deny = if has_network { sockets::internet_only } else { sockets::none };
    let mut refused = deny(DeniedCalls::default()).calls(CALLS).calls(CALLS_HERE);
    for call in OF_PROCESSES {
        refused = refused.unless(*call, 0, 0);
    }
    for request in TYPING {
        refused = refused.bits(libc::SYS_ioctl, 1, ALL, request);
    }
    install(&refused.filter(libc::EPERM)?)
}
