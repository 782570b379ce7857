//! What a process of ours does when it starts, before anything of others runs in it.

use std::fs::File;
use std::io;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use rustix::io::fcntl_dupfd_cloexec;
use rustix::stdio::{dup2_stdout, stdout};
use signal_hook::consts::SIGTERM;

/// What was standard output, for reports. What a library writes there by itself goes to standard
/// error from now on; what a lambda prints is in its log.
///
/// # Errors
///
/// Those of the system.
pub fn reports() -> io::Result<File> {
    // Not for processes that a lambda starts: whoever reads the reports waits for their end.
    let reports = fcntl_dupfd_cloexec(stdout(), 3)?;
    dup2_stdout(io::stderr())?;
    Ok(File::from(reports))
}

/// Raised by SIGTERM from now on. SIGINT is for whoever started us, who then sends the other.
///
/// # Errors
///
/// Those of the system.
pub fn stop_flag() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGTERM, Arc::clone(&stop))?;
    Ok(stop)
}
