//! Prints to standard output.

use std::io::{self, ErrorKind, Write};

use gleaner_base::{Exit, Failure};

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
