//! Open files that a process hands to the program that it starts; their numbers stand in environment variables.
#![allow(unsafe_code)]

use std::io;
use std::os::fd::{AsFd, AsRawFd, FromRawFd, OwnedFd};

use rustix::io::{FdFlags, fcntl_getfd, fcntl_setfd};

/// Has `file` survive `exec`; returns the value for its environment variable.
///
/// # Errors
///
/// Those of `fcntl`.
pub fn hand_on(file: impl AsFd) -> io::Result<String> {
    fcntl_setfd(&file, fcntl_getfd(&file)? - FdFlags::CLOEXEC)?;
    Ok(file.as_fd().as_raw_fd().to_string())
}

/// The open file that the environment variable `name` gives the number of, which `exec` closes; `None` without that variable.
///
/// # Errors
///
/// If the variable is set and gives the number of no open file, or that of a standard stream.
pub fn inherited(name: &str) -> io::Result<Option<OwnedFd>> {
    let Some(number) = std::env::var_os(name) else { return Ok(None) };
    let wrong = || io::Error::new(io::ErrorKind::InvalidInput, format!("{name} is the number of no open file"));
    let number: i32 = number.to_str().and_then(|text| text.parse().ok()).filter(|n| *n > 2).ok_or_else(wrong)?;
    // SAFETY: `dup` of a number that is no open file fails and does nothing else, and what it gives is ours alone.
    let copy = unsafe { libc::fcntl(number, libc::F_DUPFD_CLOEXEC, 3) };
    if copy < 0 {
        return Err(wrong());
    }
    // SAFETY: the number was made a line above and no other code has it.
    Ok(Some(unsafe { OwnedFd::from_raw_fd(copy) }))
}
