//! Prints to standard output and standard error. All text passes [`Paint::escaped`] here, so that
//! nothing that a vehicle, a cloud or a lambda has sent acts on a terminal; a [`Failure`] and
//! [`json_line`] escape by themselves. `run` and `top` have writers for their terminals.

use std::io::{self, ErrorKind, Write};
use std::thread;

use gleaner_base::{Exit, Failure};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use serde::Serialize;

use crate::render::{Paint, json_line};

/// Prints all of `text`, escaped. A closed pipe is not an error, since the effect of a command does
/// not depend on its reader.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    write(&Paint::of_stdout().escaped(text)).map(drop)
}

/// Prints a line of JSON; returns false if standard output is a pipe that its reader has closed.
pub(crate) fn print_json(result: &impl Serialize) -> Result<bool, Failure> {
    write(&json_line(result))
}

pub(crate) fn show<T: Serialize>(
    json: bool,
    result: &T,
    text: impl FnOnce(&T) -> String,
) -> Result<Exit, Failure> {
    if json {
        print_json(result)?;
    } else {
        print(&text(result))?;
    }
    Ok(Exit::Ok)
}

/// Prints all of `text` to standard error, escaped. An error of standard error itself cannot be
/// reported.
pub(crate) fn print_error(text: &str) {
    let _ = io::stderr().write_all(Paint::of_stderr().escaped(text).as_bytes());
}

fn write(text: &str) -> Result<bool, Failure> {
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
