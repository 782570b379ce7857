//! `summary.json` of a run whose lambda was started again: its processes each count for themselves, and only who started them has
//! seen them all.

use std::fs::{self, File};
use std::io::{self, Write};

use gleaner_protocol::{Exit, Failure, Live};

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

    /// The last one has ended well, and has written its own counts: writes those of all, if there were others.
    ///
    /// # Errors
    ///
    /// A failure that names the file.
    pub(super) fn complete(self, last: Option<Live>) -> Result<(), Failure> {
        let (Some(before), Some(last)) = (self.0, last) else { return Ok(()) };
        let path = last.out.join("summary.json");
        let part = last.out.join("summary.json.part");
        let mut text = serde_json::to_vec_pretty(&last.after(&before)).expect("counts are plain data");
        text.push(b'\n');
        let write = || -> io::Result<()> {
            let mut file = File::create(&part)?;
            file.write_all(&text)?;
            file.sync_all()?;
            fs::rename(&part, &path)
        };
        write()
            .map_err(|error| Failure::caused_by(Exit::Internal, format!("cannot write `{}`", path.display()), &error))
    }
}
