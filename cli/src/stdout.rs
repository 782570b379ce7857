//! Prints to standard output.

use std::io::{self, ErrorKind, Write};

use gleaner_base::{Exit, Failure};

/// Prints all of `text`. A closed pipe is not an error, since the effect of a command does not
/// depend on its reader.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::caused_by(Exit::Internal, "cannot write to standard output", &error))
        }
        _ => Ok(()),
    }
}
