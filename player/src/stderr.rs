//! Prints messages for the user to standard error.

use std::io::{self, Write};

use gleaner_base::visible;

/// Prints a line. A closed standard error does not stop the player.
pub(crate) fn line(text: &str) {
    let _ = writeln!(io::stderr().lock(), "{text}");
}

/// Prints that data or time was or will be lost. Control characters, which a drive may contain, are
/// escaped.
pub(crate) fn warn(text: &str) {
    line(&format!("warning: {}", visible(text)));
}
