//! Result files, for a run that a user started.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use gleaner_base::Failure;
use gleaner_lambda::results::LIVE_LOG_MAX;
use gleaner_lambda::{Decision, LogLine, Output, OutputError};
use rustix::fs::{Access, access};

use super::sink::{ProcessResults, ResultSink};

/// Longest time that lines wait, and shortest time between two attempts to open the files.
const FLUSH: Duration = Duration::from_millis(500);

pub(crate) struct ResultFiles {
    folder: PathBuf,
    /// The files, once they are open.
    output: Option<Output>,
    /// Time of the last attempt to open them.
    tried: Option<Instant>,
    /// Number of items that came while no files were open.
    without_file: u64,
    has_pending: bool,
}

impl ResultFiles {
    /// Creates `folder`. With `again`, lines are appended to the existing files; otherwise these
    /// stay until the runtime is about to enter its lambda.
    pub(crate) fn open(folder: &Path, again: bool) -> Result<Self, Failure> {
        let mut output = None;
        if again {
            output = Some(open_output(folder, again)?);
        } else {
            let created =
                fs::create_dir_all(folder).and_then(|()| Ok(access(folder, Access::WRITE_OK)?));
            created.map_err(|source| OutputError { path: folder.to_owned(), source })?;
        }
        let folder = folder.to_owned();
        Ok(Self { folder, output, tried: None, without_file: 0, has_pending: false })
    }

    fn put(
        &mut self,
        put: impl FnOnce(&mut Output) -> Result<(), OutputError>,
    ) -> Result<(), Failure> {
        let opened = self.begin();
        let Some(output) = &mut self.output else {
            self.without_file += 1;
            return opened;
        };
        put(output)?;
        self.has_pending = true;
        Ok(())
    }
}

impl ResultSink for ResultFiles {
    fn interval(&self) -> Duration {
        FLUSH
    }

    /// Opens the files if they are not open. After a failure it retries at most every [`FLUSH`].
    fn begin(&mut self) -> Result<(), Failure> {
        if self.output.is_none() && self.tried.is_none_or(|tried| tried.elapsed() >= FLUSH) {
            self.tried = Some(Instant::now());
            self.output = Some(open_output(&self.folder, false)?);
        }
        Ok(())
    }

    fn decision(&mut self, decision: Box<Decision>) -> Result<(), Failure> {
        self.put(|output| output.decision(&decision))
    }

    fn log(&mut self, line: LogLine) -> Result<(), Failure> {
        self.put(|output| output.log(&[line]))
    }

    fn has_pending(&self) -> bool {
        self.has_pending
    }

    fn is_due(&self) -> bool {
        // The files write many lines by themselves.
        false
    }

    fn flush(&mut self, _invalid: u64) -> Result<(), Failure> {
        self.has_pending = false;
        Ok(self.output.as_mut().map_or(Ok(()), Output::flush)?)
    }

    fn lost(&self) -> u64 {
        self.output.as_ref().map_or(0, Output::lost) + self.without_file
    }

    fn finish(self: Box<Self>, end: ProcessResults<'_>) -> Result<(), Failure> {
        Ok(match (self.output, &end.summary) {
            (Some(output), Some(last)) => output.finish(last),
            (Some(mut output), None) => output.flush(),
            (None, _) => Ok(()),
        }?)
    }
}

fn open_output(folder: &Path, again: bool) -> Result<Output, OutputError> {
    Ok(Output::begin(folder, true, again)?.with_log_rotation(LIVE_LOG_MAX.bytes()))
}
