//! Open files that a process hands to the program that it starts; their numbers stand in
//! environment variables.
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

/// Has all open files but the standard streams close on `exec`, those included that the starter of
/// this process had open by chance.
///
/// # Errors
///
/// If the system can neither do that at once nor list them.
pub fn close_on_exec() -> io::Result<()> {
    // SAFETY: it changes a flag of files that are open, and no memory.
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
            // SAFETY: as above; a number that is not open any more is an error, which does not
            // matter.
            let _ = unsafe { libc::fcntl(number, libc::F_SETFD, libc::FD_CLOEXEC) };
        }
    }
    Ok(())
}

/// The open file that the environment variable `name` gives the number of, which `exec` closes;
/// `None` without that variable.
///
/// # Errors
///
/// If the variable is set and gives the number of no open file, or that of a standard stream.
pub fn inherited(name: &str) -> io::Result<Option<OwnedFd>> {
    let Some(number) = std::env::var_os(name) else { return Ok(None) };
    let wrong = || {
        io::Error::new(io::ErrorKind::InvalidInput, format!("{name} is the number of no open file"))
    };
    let number: i32 =
        number.to_str().and_then(|text| text.parse().ok()).filter(|n| *n > 2).ok_or_else(wrong)?;
    // SAFETY: `dup` of a number that is no open file fails and does nothing else, and what it gives
    // is ours alone.
    let copy = unsafe { libc::fcntl(number, libc::F_DUPFD_CLOEXEC, 3) };
    if copy < 0 {
        return Err(wrong());
    }
    // SAFETY: the number was made a line above and no other code has it.
    Ok(Some(unsafe { OwnedFd::from_raw_fd(copy) }))
}
