//! Tries the system calls that a lambda's process needs to start: where a container refuses one,
//! the start would fail, and the lambda would be blamed.
#![allow(unsafe_code)]

use std::io;

use gleaner_protocol::{Layer, NEEDED_CALLS};
use libc::c_long;

macro_rules! names_and_numbers {
    ($($call:ident)*) => { &[$((stringify!($call), libc::$call)),*] };
}

/// The calls up to a lambda's `init` of which an error ends the start: found by refusing each call
/// of a trace. Those that each program needs are left out, and `futex`, which may give ENOSYS.
const CALLS: &[(&str, c_long)] = names_and_numbers!(
    SYS_prctl SYS_prlimit64 SYS_memfd_create SYS_ftruncate SYS_fcntl SYS_ioctl SYS_socketpair
    SYS_pipe2 SYS_ppoll SYS_wait4 SYS_getpid SYS_getppid SYS_clock_gettime SYS_sigaltstack
    SYS_setitimer
);

/// Returns a layer that names the needed calls that are refused; none if all are permitted.
pub fn refused() -> Option<Layer> {
    let refused = |(name, call): &(&str, c_long)| {
        Some(format!("`{}`: {}", name.trim_start_matches("SYS_"), refusal(*call)?))
    };
    let refused: Vec<_> = CALLS.iter().filter_map(refused).collect();
    (!refused.is_empty()).then(|| Layer::no(NEEDED_CALLS, refused.join(", ")))
}

/// Returns the error of a filter that refuses `call`, or of a kernel without it.
pub(crate) fn refusal(call: c_long) -> Option<io::Error> {
    const NONE: c_long = -1;
    // Gleaner's own filters, below which a shim may run, permit this family only.
    let first = if call == libc::SYS_socketpair { libc::AF_UNIX.into() } else { NONE };
    // SAFETY: no call above, nor `landlock_create_ruleset`, has an effect with these arguments:
    // each takes an address, a descriptor, a flag or a number, of which none but a family is valid.
    let result = unsafe { libc::syscall(call, first, NONE, NONE, NONE, NONE, NONE) };
    let error = io::Error::last_os_error();
    let answers = [libc::EPERM, libc::EACCES, libc::ENOSYS];
    (result < 0 && answers.map(Some).contains(&error.raw_os_error())).then_some(error)
}
