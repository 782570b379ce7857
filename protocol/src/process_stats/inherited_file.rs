//! Passes open files to a program that a process starts; environment variables name their
//! descriptors.
#![allow(unsafe_code)]

use std::io;
use std::os::fd::{AsFd, AsRawFd, FromRawFd, OwnedFd};

use rustix::io::{FdFlags, fcntl_getfd, fcntl_setfd};

/// Makes `file` survive `exec`; returns the value for its environment variable.
///
/// # Errors
///
/// Errors of `fcntl`.
pub fn make_inheritable(file: impl AsFd) -> io::Result<String> {
    fcntl_setfd(&file, fcntl_getfd(&file)? - FdFlags::CLOEXEC)?;
    Ok(file.as_fd().as_raw_fd().to_string())
}

/// Makes all open files but the standard streams close on `exec`, including those that the starter
/// of this process happened to have open.
///
/// # Errors
///
/// If the system can neither do that in one call nor list the files.
pub fn close_on_exec() -> io::Result<()> {
    // SAFETY: the call changes flags of open files, and no memory.
    if unsafe {
        libc::syscall(libc::SYS_close_range, 3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC)
    } == 0
    {
        return Ok(());
    }
    // Linux 5.10 and older.
    for entry in std::fs::read_dir("/proc/self/fd")? {
        let number = entry?.file_name().to_str().and_then(|name| name.parse::<i32>().ok());
        if let Some(number) = number.filter(|number| *number > 2) {
            // SAFETY: as above; an error for a number that is not open any more does not matter.
            let _ = unsafe { libc::fcntl(number, libc::F_SETFD, libc::FD_CLOEXEC) };
        }
    }
    Ok(())
}

/// Returns the open file with the number in the environment variable `name`, as a copy that `exec`
/// closes; `None` without that variable.
///
/// # Errors
///
/// If the variable is set and does not have the number of an open file, or has that of a standard
/// stream.
pub fn inherited(name: &str) -> io::Result<Option<OwnedFd>> {
    let Some(number) = std::env::var_os(name) else { return Ok(None) };
    let wrong = || {
        io::Error::new(io::ErrorKind::InvalidInput, format!("{name} does not name an open file"))
    };
    let number: i32 =
        number.to_str().and_then(|text| text.parse().ok()).filter(|n| *n > 2).ok_or_else(wrong)?;
    // SAFETY: `dup` of a number that is not open fails without effect, and only this code has the
    // number that it returns.
    let copy = unsafe { libc::fcntl(number, libc::F_DUPFD_CLOEXEC, 3) };
    if copy < 0 {
        return Err(wrong());
    }
    // SAFETY: the number was created above, and no other code has it.
    Ok(Some(unsafe { OwnedFd::from_raw_fd(copy) }))
}
