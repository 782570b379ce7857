//! Prints to standard output.

use std::io::{self, ErrorKind, Write};
use std::thread;

use gleaner_base::{Exit, Failure};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;

/// Prints all of `text`. A closed pipe is not an error, since the effect of a command does not
/// depend on its reader.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    print_to_reader(text).map(drop)
}

/// Prints all of `text`; returns false if standard output is a pipe that its reader has closed.
pub(crate) fn print_to_reader(text: &str) -> Result<bool, Failure> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        Err(error) => {
            Err(Failure::caused_by(Exit::Internal, "cannot write to standard output", &error))
        }
    }
}

/// Ends this process with success as soon as the reader of standard output has gone: it has closed
/// the pipe, or the terminal has hung up. For commands that follow something, and would notice it
/// only with their next line.
pub(crate) fn end_with_reader() {
    let watch = || {
        let stdout = io::stdout();
        // Without wanted events, only an error or the end of the reader is one. A file has none.
        let mut waited = [PollFd::new(&stdout, PollFlags::empty())];
        while poll(&mut waited, None) == Err(Errno::INTR) {}
        let is_gone = waited[0].revents().intersects(PollFlags::ERR | PollFlags::HUP);
        if is_gone {
            std::process::exit(Exit::Ok.code().into());
        }
    };
    // Without a thread, it ends with its next line, or by a signal.
    let _ = thread::Builder::new().name("reader".to_owned()).spawn(watch);
}
