//! Writes the result files of a live lambda: its process sends items through a pipe, and a thread
//! of the shim writes them.
//!
//! Native code of a lambda can write into the pipe as well. So each item is parsed before it is
//! written, has a bounded length, and is counted if it is refused: arbitrary input costs the lambda
//! its own results, and no more than a share of a core.

use std::fmt::Display;
use std::fs;
use std::io::{self, PipeReader, PipeWriter, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, visible};
use gleaner_lambda::results::LIVE_LOG_MAX;
use gleaner_lambda::{Decision, Output, OutputError, RESULT_ITEM_MAX};
use gleaner_protocol::{ExitRecord, LiveStatus, Report, ResultItem, WokenBy};
use gleaner_vitals::Pulse;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Access, access};
use rustix::io::ioctl_fionbio;

use crate::lines::{LineSplitter, PIECE};

/// Longest time that lines wait to be flushed. Decisions with a trigger or a fault do not wait.
const FLUSH: Duration = Duration::from_millis(500);
/// Bytes read in a turn; further ones stay in the pipe. No healthy lambda sends 16 MiB or 65,000
/// lines a second, and a flood must not take a core or the disk from others.
const TURN_BYTES: usize = 1600 << 10;
/// The length of a turn.
const TURN: Duration = Duration::from_millis(100);
/// Bytes that are still read after the runtime has ended. A pipe holds 1 MiB, unless root allowed
/// more.
const DRAIN_BYTES: usize = 4 << 20;

/// A running thread that writes results.
pub(crate) struct Results {
    thread: JoinHandle<ItemWriter>,
    /// Closed when the runtime has ended.
    runs: PipeWriter,
}

impl Results {
    /// Creates `folder`, and returns the runtime's end of the pipe. With `again`, lines are
    /// appended to the existing files; otherwise these stay until the runtime is about to enter its
    /// lambda.
    pub(crate) fn begin(
        folder: &Path,
        again: bool,
        pulse: &Pulse,
    ) -> Result<(Self, PipeWriter), Failure> {
        let cannot =
            |error: io::Error| Failure::caused_by(Exit::Internal, "cannot receive results", &error);
        let mut writer = ItemWriter::new(folder, pulse.clone());
        if again {
            writer.output = Some(open_output(folder, again)?);
        } else {
            let created =
                fs::create_dir_all(folder).and_then(|()| Ok(access(folder, Access::WRITE_OK)?));
            created.map_err(|source| OutputError { path: folder.to_owned(), source })?;
        }
        let (items, runtimes) = io::pipe().map_err(cannot)?;
        // Neither side blocks: a runtime counts the items that do not fit.
        for end in [items.as_fd(), runtimes.as_fd()] {
            ioctl_fionbio(end, true).map_err(|error| cannot(error.into()))?;
        }
        let (ended, runs) = io::pipe().map_err(cannot)?;
        let thread = thread::Builder::new().name("gleaner-results".to_owned());
        let thread = thread.spawn(move || writer.write(items, &ended)).map_err(cannot)?;
        Ok((Self { thread, runs }, runtimes))
    }

    /// Waits until all items are read that the runtime left in the pipe when it ended.
    pub(crate) fn end(self) -> ItemWriter {
        drop(self.runs);
        self.thread.join().expect("writing results does not panic")
    }
}

/// Writes items to the result files.
pub(crate) struct ItemWriter {
    folder: PathBuf,
    /// The files, once they are open.
    output: Option<Output>,
    /// Time of the last attempt to open them.
    tried: Option<Instant>,
    pulse: Pulse,
    woken_by: Option<WokenBy>,
    last: Option<Box<LiveStatus>>,
    /// Number of lines that were not valid items.
    refused: u64,
    /// Number of items that came while no files were open.
    without_file: u64,
    /// Time since which lines wait to be flushed; `None` if none do.
    behind_since: Option<Instant>,
    /// Set if a decision with a trigger or a fault waits to be flushed.
    is_urgent: bool,
    is_failing: bool,
    first: Option<OutputError>,
}

impl ItemWriter {
    fn new(folder: &Path, pulse: Pulse) -> Self {
        Self {
            folder: folder.to_owned(),
            output: None,
            tried: None,
            pulse,
            woken_by: None,
            last: None,
            refused: 0,
            without_file: 0,
            behind_since: None,
            is_urgent: false,
            is_failing: false,
            first: None,
        }
    }

    /// Writes the items from the pipe until `ended` is closed and the pipe is empty.
    fn write(mut self, mut items: PipeReader, ended: &PipeReader) -> Self {
        let mut piece = vec![0; PIECE];
        let mut lines = LineSplitter::default();
        let mut turn = (Instant::now(), 0);
        let mut left: Option<usize> = None;
        loop {
            if left.is_none() && wait(Some(items.as_fd()), ended, self.timeout()) {
                left = Some(DRAIN_BYTES);
            }
            let max_bytes = left.map_or(PIECE, |left| left.min(PIECE));
            match items.read(&mut piece[..max_bytes]) {
                // All writers have closed the pipe, or as much was read as it can hold.
                Ok(0) => break,
                Ok(read) => {
                    turn.1 += lines.add(&piece[..read], |line| self.item(line));
                    left = left.map(|left| left - read);
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock && left.is_none() => {}
                Err(_) => break,
            }
            if self.is_urgent || self.timeout().is_some_and(|timeout| timeout.is_zero()) {
                self.flush();
            }
            self.pulse.set_unwritten(self.unwritten());
            let elapsed = turn.0.elapsed();
            if turn.1 >= TURN_BYTES && elapsed < TURN && left.is_none() {
                wait(None, ended, Some(TURN - elapsed));
            }
            if turn.1 >= TURN_BYTES || elapsed >= TURN {
                turn = (Instant::now(), 0);
            }
        }
        if lines.is_within() {
            self.refuse("it is incomplete");
        }
        self.flush();
        self.pulse.set_unwritten(self.unwritten());
        self
    }

    /// Adds the summary and, if a wake was in progress when the runtime ended, the decision of that
    /// wake, which is reported as well.
    ///
    /// # Errors
    ///
    /// A failure that names the first file that could not be written.
    pub(crate) fn finish(mut self, record: &ExitRecord) -> Result<(), Failure> {
        // A lambda can make its process end as if that had been requested.
        let is_complete = self.last.is_some()
            && record.end_requested
            && record.signal.is_none()
            && record.killed.is_none();
        // None if the lambda was not entered.
        let undecided =
            self.woken_by.clone().and_then(|woken_by| record.interrupted_wake(woken_by));
        if let Some(decision) = undecided.filter(|_| !is_complete) {
            self.keep(&decision);
            self.flush();
            report(decision);
        }
        let unwritten = self.unwritten();
        let finished = match (self.output, self.last.filter(|_| is_complete)) {
            (Some(output), Some(mut last)) => {
                // The recorder's counts are not the lambda's to report.
                last.recording = None;
                last.unwritten = last.unwritten.saturating_add(unwritten);
                output.finish(&last)
            }
            (Some(mut output), None) => output.flush(),
            (None, _) => Ok(()),
        };
        Ok(self.first.map_or(finished, Err)?)
    }

    /// Returns the number of items that were not written, for any reason.
    fn unwritten(&self) -> u64 {
        self.output.as_ref().map_or(0, Output::lost) + self.refused + self.without_file
    }

    /// Returns the remaining time until the files must be flushed; `None` while no line waits.
    fn timeout(&self) -> Option<Duration> {
        self.behind_since.map(|since| FLUSH.saturating_sub(since.elapsed()))
    }

    /// Handles one line; `None` for one that is too long.
    fn item(&mut self, line: Option<&[u8]>) {
        match line.map(serde_json::from_slice) {
            None => self.refuse(format_args!("it is longer than {RESULT_ITEM_MAX} bytes")),
            Some(Err(error)) => self.refuse(error),
            Some(Ok(ResultItem::Woken(by))) if self.woken_by.is_none() => {
                self.woken_by = Some(by);
                self.begin();
            }
            Some(Ok(_)) if self.woken_by.is_none() => self.refuse("the first item must be `woken`"),
            Some(Ok(ResultItem::Woken(_))) => self.refuse("`woken` comes only once"),
            Some(Ok(ResultItem::Last(last))) => self.last = Some(last),
            Some(Ok(ResultItem::Decision(decision))) => self.keep(&decision),
            Some(Ok(ResultItem::Log(line))) => self.put(|output| output.log(&[line])),
        }
    }

    fn keep(&mut self, decision: &Decision) {
        self.is_urgent |= !decision.triggers.is_empty() || decision.fault.is_some();
        self.put(|output| output.decision(decision));
    }

    /// Opens the files if they are not open. After a failure it retries at most every [`FLUSH`].
    fn begin(&mut self) {
        if self.output.is_some() || self.tried.is_some_and(|tried| tried.elapsed() < FLUSH) {
            return;
        }
        self.tried = Some(Instant::now());
        match open_output(&self.folder, false) {
            Ok(output) => self.output = Some(output),
            Err(error) => self.written(Err(error)),
        }
    }

    /// Writes lines to the files.
    fn put(&mut self, put: impl FnOnce(&mut Output) -> Result<(), OutputError>) {
        self.begin();
        let Some(output) = &mut self.output else { return self.without_file += 1 };
        let written = put(output);
        self.behind_since.get_or_insert_with(Instant::now);
        self.written(written);
    }

    fn flush(&mut self) {
        self.is_urgent = false;
        if self.behind_since.take().is_none() {
            return;
        }
        let flushed = self.output.as_mut().map_or(Ok(()), Output::flush);
        let is_over = flushed.is_ok() && std::mem::take(&mut self.is_failing);
        self.written(flushed);
        if is_over {
            log(format_args!("results are written again; {} items were lost", self.unwritten()));
        }
    }

    /// Records a failure to write, and logs the first in a row. Later lines are tried again.
    fn written(&mut self, result: Result<(), OutputError>) {
        let Err(error) = result else { return };
        if !std::mem::replace(&mut self.is_failing, true) {
            log(format_args!("{error}: {}; later lines are retried", error.source));
        }
        self.first.get_or_insert(error);
    }

    /// Counts a line that is not an item, and logs the first.
    fn refuse(&mut self, why: impl Display) {
        self.refused += 1;
        if self.refused == 1 {
            // The text may quote what a lambda wrote.
            let why: String = why.to_string().chars().take(200).collect();
            log(format_args!(
                "invalid result item: {}; further ones are only counted",
                visible(&why)
            ));
        }
    }
}

/// Opens the result files in `folder`.
fn open_output(folder: &Path, again: bool) -> Result<Output, OutputError> {
    Ok(Output::begin(folder, true, again)?.with_log_rotation(LIVE_LOG_MAX.bytes()))
}

/// Waits for `items`, if given, for `ended` and for at most `timeout`. Returns whether `ended` is
/// closed.
fn wait(items: Option<BorrowedFd<'_>>, ended: &PipeReader, timeout: Option<Duration>) -> bool {
    let timeout = timeout.and_then(|timeout| Timespec::try_from(timeout).ok());
    let mut waited: Vec<_> = [Some(ended.as_fd()), items]
        .into_iter()
        .flatten()
        .map(|file| PollFd::from_borrowed_fd(file, PollFlags::IN))
        .collect();
    // A signal, which the other thread handles, ends the wait early. That is harmless.
    let _ = poll(&mut waited, timeout.as_ref());
    !waited[0].revents().is_empty()
}

/// Reports `decision` to the starter, as the live runtime does.
fn report(decision: Decision) {
    let report = serde_json::to_string(&Report::Decision(Box::new(decision)))
        .expect("a decision is plain data");
    // The runtime may have ended within a line. A starter that has gone can read the file.
    let _ = writeln!(io::stdout(), "\n{report}");
}

/// Prints a line for the user. A closed standard error is not fatal.
fn log(text: impl Display) {
    let _ = writeln!(io::stderr(), "gleaner-shim: {text}");
}
