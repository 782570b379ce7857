//! What a command has to say, on standard output.

use std::io::{self, ErrorKind, Write};

use gleaner_base::{Exit, Failure};

/// Prints `text` to its last byte. A reader that is gone is no failure: what a command did does not
/// depend on it.
pub(crate) fn say(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::caused_by(Exit::Internal, "cannot write to standard output", &error))
        }
        _ => Ok(()),
    }
}
