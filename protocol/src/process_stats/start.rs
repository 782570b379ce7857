//! Prepares a Gleaner process when it starts, before foreign code runs in it.

use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use rustix::io::fcntl_dupfd_cloexec;
use rustix::stdio::{dup2_stdout, stdout};
use signal_hook::consts::{SIGINT, SIGTERM};

/// Returns the original standard output, for reports. From now on, libraries that print to standard
/// output print to standard error; the output of a lambda is in its log.
///
/// # Errors
///
/// Errors of the system.
pub fn reports() -> io::Result<File> {
    // Processes that a lambda starts must not inherit it: the reader of the reports waits until all
    // copies are closed.
    let reports = fcntl_dupfd_cloexec(stdout(), 3)?;
    dup2_stdout(io::stderr())?;
    Ok(File::from(reports))
}

/// Returns a socket that becomes readable at SIGTERM. SIGINT, which Ctrl-C in a terminal sends to
/// all processes, is ignored: the starter decides when this process ends.
///
/// # Errors
///
/// Errors of the system.
pub fn stop_socket() -> io::Result<OwnedFd> {
    let (stop, notifier) = UnixStream::pair()?;
    signal_hook::low_level::pipe::register(SIGTERM, notifier)?;
    signal_hook::flag::register(SIGINT, Arc::default())?;
    Ok(stop.into())
}

/// Returns a flag that SIGTERM sets. SIGINT is handled by the starter, which then sends SIGTERM.
///
/// # Errors
///
/// Errors of the system.
pub fn stop_flag() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGTERM, Arc::clone(&stop))?;
    Ok(stop)
}
