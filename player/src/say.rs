//! What the player has to say to people, on standard error.

use std::io::{self, Write};

use gleaner_base::visible;

/// Says `text`. A reader that is gone is no reason to stop playing.
pub(crate) fn line(text: &str) {
    let _ = writeln!(io::stderr().lock(), "{text}");
}

/// Says that data or time was lost, or will be. Control characters, which a drive may hold, are
/// shown.
pub(crate) fn warn(text: &str) {
    line(&format!("warning: {}", visible(text)));
}
