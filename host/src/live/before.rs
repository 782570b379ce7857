//! What became of the process before this one, if it did not end well: a wake that it did not live to decide is a fault, too.

use std::path::Path;

use gleaner_protocol::manifest::Manifest;
use gleaner_protocol::{Decision, ExitRecord};

/// The decision that the process before could not write, by the record of its end in `out`. None if nobody wrote down how, or if it
/// was asked to end, or because something around the lambda failed.
pub(super) fn undecided(manifest: &Manifest, out: &Path) -> Option<Decision> {
    let record = ExitRecord::read(&out.join(format!("{}{}", ExitRecord::FILE, ExitRecord::EARLIER))).ok()?;
    record.undecided(manifest)
}
