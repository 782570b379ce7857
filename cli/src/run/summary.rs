//! `summary.json` of a run whose lambda was started again: its processes each count for themselves, and only who started them has
//! seen them all.

use std::path::Path;

use gleaner_base::{Exit, Failure, write_whole};
use gleaner_protocol::Live;

/// What the processes of a lambda counted that have ended.
#[derive(Default)]
pub(super) struct Earlier {
    counted: Option<Live>,
    /// Wakes that ended with their process, which so did not count them.
    lost_wakes: u64,
}

impl Earlier {
    /// One more has ended. `last` is what it said last: of one that broke, up to a second of counts is missing.
    pub(super) fn add(&mut self, last: Option<Live>, has_lost_wake: bool) {
        self.lost_wakes += u64::from(has_lost_wake);
        self.counted = match (last, self.counted.take()) {
            (Some(last), Some(before)) => Some(last.after(&before)),
            (last, before) => last.or(before),
        };
    }

    /// There will be no further one. Writes the counts of all, if there were others than the last one, for which the shim has written
    /// its own: `last`, if it ended well.
    ///
    /// # Errors
    ///
    /// A failure that names the file.
    pub(super) fn complete(self, last: Option<Live>, out: &Path) -> Result<(), Failure> {
        let Self { counted, lost_wakes } = self;
        let sum = match (last, counted) {
            (Some(last), Some(before)) => last.after(&before),
            (None, Some(before)) => before,
            (Some(last), None) if lost_wakes > 0 => last,
            _ => return Ok(()),
        };
        let sum = Live { faults: sum.faults.saturating_add(lost_wakes), ..sum };
        // Not where the report says: it comes from the lambda's process.
        let path = out.join("summary.json");
        let mut text = serde_json::to_vec_pretty(&sum).expect("counts are plain data");
        text.push(b'\n');
        write_whole(&path, &text)
            .map_err(|error| Failure::caused_by(Exit::Internal, format!("cannot write `{}`", path.display()), &error))
    }
}
