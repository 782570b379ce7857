//! `summary.json` of a run whose lambda was started again: its processes each count for themselves, and only who started them has
//! seen them all.

use std::path::Path;

use gleaner_protocol::{Exit, Failure, Live, write_whole};

/// What the processes of a lambda counted that have ended.
#[derive(Default)]
pub(super) struct Earlier(Option<Live>);

impl Earlier {
    /// One more has ended. `last` is what it said last: of one that broke, up to a second of counts is missing.
    pub(super) fn add(&mut self, last: Option<Live>) {
        self.0 = match (last, self.0.take()) {
            (Some(last), Some(before)) => Some(last.after(&before)),
            (last, before) => last.or(before),
        };
    }

    /// A wake ended with the last process.
    pub(super) fn add_fault(&mut self) {
        if let Some(counted) = &mut self.0 {
            counted.faults += 1;
        }
    }

    /// There will be no further one. Writes the counts of all, if there were others than the last one, which has written its own:
    /// `last`, if it ended well.
    ///
    /// # Errors
    ///
    /// A failure that names the file.
    pub(super) fn complete(self, last: Option<Live>, out: &Path) -> Result<(), Failure> {
        let Some(before) = self.0 else { return Ok(()) };
        let last = last.map_or_else(|| before.clone(), |last| last.after(&before));
        // Not where the report says: it comes from the lambda's process.
        let path = out.join("summary.json");
        let mut text = serde_json::to_vec_pretty(&last).expect("counts are plain data");
        text.push(b'\n');
        write_whole(&path, &text)
            .map_err(|error| Failure::caused_by(Exit::Internal, format!("cannot write `{}`", path.display()), &error))
    }
}
