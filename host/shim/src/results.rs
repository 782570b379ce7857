//! The files of a live lambda's results. Its process hands pages on through a pipe, and a thread of
//! this program writes them.
//!
//! Native code of a lambda can write into the pipe as well. So each page is parsed before it is
//! written, has a bounded length, and is counted if it is refused: whatever arrives costs the
//! lambda its own results, and no more than a share of a core.

use std::fmt::Display;
use std::fs;
use std::io::{self, PipeReader, PipeWriter, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, visible};
use gleaner_lambda::results::LIVE_LOG_MAX;
use gleaner_lambda::{Decision, Output, OutputError, PAGE_BYTES};
use gleaner_protocol::{ExitRecord, Live, Page, Report, WokenBy};
use gleaner_vitals::Pulse;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Access, access};
use rustix::io::ioctl_fionbio;

use crate::lines::{Lines, PIECE};

/// How long lines may wait until they are written to the file. Decisions with a trigger or a fault
/// do not wait.
const FLUSH: Duration = Duration::from_millis(500);
/// Bytes that are read in a turn. More stay in the pipe: a flood of 16 MiB or 65,000 lines a second
/// is no lambda's honest work, and must not take a core or the disk from others.
const TURN_BYTES: usize = 1600 << 10;
/// The length of a turn.
const TURN: Duration = Duration::from_millis(100);
/// Bytes that are still read once the runtime has ended. A pipe has room for 1 MiB, unless root
/// allowed more.
const LEFT: usize = 4 << 20;

/// Results that are being written.
pub(crate) struct Results {
    thread: JoinHandle<Writer>,
    /// Closed when the runtime has ended.
    runs: PipeWriter,
}

impl Results {
    /// Makes `folder`, and returns the end of the pipe that is the runtime's. With `again`, lines
    /// are added to the files that are there; else these stay until the runtime is about to enter
    /// its lambda.
    pub(crate) fn begin(
        folder: &Path,
        again: bool,
        pulse: &Pulse,
    ) -> Result<(Self, PipeWriter), Failure> {
        let cannot =
            |error: io::Error| Failure::caused_by(Exit::Internal, "cannot receive results", &error);
        let mut writer = Writer::new(folder, pulse.clone());
        if again {
            writer.output = Some(begun(folder, again)?);
        } else {
            let made =
                fs::create_dir_all(folder).and_then(|()| Ok(access(folder, Access::WRITE_OK)?));
            made.map_err(|source| OutputError { path: folder.to_owned(), source })?;
        }
        let (pages, runtimes) = io::pipe().map_err(cannot)?;
        // Neither side waits for the other: a runtime counts what does not fit.
        for end in [pages.as_fd(), runtimes.as_fd()] {
            ioctl_fionbio(end, true).map_err(|error| cannot(error.into()))?;
        }
        let (ended, runs) = io::pipe().map_err(cannot)?;
        let thread = thread::Builder::new().name("gleaner-results".to_owned());
        let thread = thread.spawn(move || writer.write(pages, &ended)).map_err(cannot)?;
        Ok((Self { thread, runs }, runtimes))
    }

    /// Waits until all pages are read that the runtime, which has ended, left in the pipe.
    pub(crate) fn end(self) -> Writer {
        drop(self.runs);
        self.thread.join().expect("writing results does not panic")
    }
}

/// Writes pages.
pub(crate) struct Writer {
    folder: PathBuf,
    /// The files, once they have begun.
    output: Option<Output>,
    /// When it was last tried to begin them.
    tried: Option<Instant>,
    pulse: Pulse,
    woken_by: Option<WokenBy>,
    last: Option<Box<Live>>,
    /// Lines that were no pages.
    refused: u64,
    /// Pages that came while there were no files.
    homeless: u64,
    /// When the files were last up to date; `None` while they are.
    behind_since: Option<Instant>,
    /// A decision with a trigger or a fault was read, and is not in the file yet.
    is_urgent: bool,
    is_failing: bool,
    first: Option<OutputError>,
}

impl Writer {
    fn new(folder: &Path, pulse: Pulse) -> Self {
        Self {
            folder: folder.to_owned(),
            output: None,
            tried: None,
            pulse,
            woken_by: None,
            last: None,
            refused: 0,
            homeless: 0,
            behind_since: None,
            is_urgent: false,
            is_failing: false,
            first: None,
        }
    }

    /// Writes what comes through the pipe until `ended` is closed and the pipe empty.
    fn write(mut self, mut pages: PipeReader, ended: &PipeReader) -> Self {
        let mut piece = vec![0; PIECE];
        let mut lines = Lines::default();
        let mut turn = (Instant::now(), 0);
        let mut left: Option<usize> = None;
        loop {
            if left.is_none() && wait(Some(pages.as_fd()), ended, self.patience()) {
                left = Some(LEFT);
            }
            let most = left.map_or(PIECE, |left| left.min(PIECE));
            match pages.read(&mut piece[..most]) {
                // Every writing end is closed, or as much was read as a pipe can hold.
                Ok(0) => break,
                Ok(read) => {
                    turn.1 += lines.add(&piece[..read], |line| self.page(line));
                    left = left.map(|left| left - read);
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock && left.is_none() => {}
                Err(_) => break,
            }
            if self.is_urgent || self.patience().is_some_and(|patience| patience.is_zero()) {
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
            self.refuse("it has no end");
        }
        self.flush();
        self.pulse.set_unwritten(self.unwritten());
        self
    }

    /// Adds the summary and, where the runtime's end ended a wake, the decision of that, which is
    /// reported as well.
    ///
    /// # Errors
    ///
    /// A failure that names the first file that could not be written.
    pub(crate) fn finish(mut self, record: &ExitRecord) -> Result<(), Failure> {
        // A lambda can have its process end as if that had been asked for.
        let is_complete = self.last.is_some()
            && record.asked
            && record.signal.is_none()
            && record.killed.is_none();
        // None if the lambda was not entered.
        let undecided = self.woken_by.clone().and_then(|woken_by| record.undecided(woken_by));
        if let Some(decision) = undecided.filter(|_| !is_complete) {
            self.keep(&decision);
            self.flush();
            report(decision);
        }
        let unwritten = self.unwritten();
        let finished = match (self.output, self.last.filter(|_| is_complete)) {
            (Some(output), Some(mut last)) => {
                // What a recorder counted is not the lambda's to say.
                last.recording = None;
                last.unwritten = last.unwritten.saturating_add(unwritten);
                output.finish(&last)
            }
            (Some(mut output), None) => output.flush(),
            (None, _) => Ok(()),
        };
        Ok(self.first.map_or(finished, Err)?)
    }

    /// Pages that were not written, for whichever cause.
    fn unwritten(&self) -> u64 {
        self.output.as_ref().map_or(0, Output::lost) + self.refused + self.homeless
    }

    /// How long the files may stay as they are; `None` while nothing waits.
    fn patience(&self) -> Option<Duration> {
        self.behind_since.map(|since| FLUSH.saturating_sub(since.elapsed()))
    }

    /// Takes one line; `None` for one that is too long.
    fn page(&mut self, line: Option<&[u8]>) {
        match line.map(serde_json::from_slice) {
            None => self.refuse(format_args!("it is longer than {PAGE_BYTES} bytes")),
            Some(Err(error)) => self.refuse(error),
            Some(Ok(Page::Woken(by))) if self.woken_by.is_none() => {
                self.woken_by = Some(by);
                self.begin();
            }
            Some(Ok(_)) if self.woken_by.is_none() => self.refuse("another one comes first"),
            Some(Ok(Page::Woken(_))) => self.refuse("it comes once"),
            Some(Ok(Page::Last(last))) => self.last = Some(last),
            Some(Ok(Page::Decision(decision))) => self.keep(&decision),
            Some(Ok(Page::Log(line))) => self.put(|output| output.log(&[line])),
        }
    }

    fn keep(&mut self, decision: &Decision) {
        self.is_urgent |= !decision.triggers.is_empty() || decision.fault.is_some();
        self.put(|output| output.decision(decision));
    }

    /// Begins the files, if they have not begun. Where that fails it is tried again now and then.
    fn begin(&mut self) {
        if self.output.is_some() || self.tried.is_some_and(|tried| tried.elapsed() < FLUSH) {
            return;
        }
        self.tried = Some(Instant::now());
        match begun(&self.folder, false) {
            Ok(output) => self.output = Some(output),
            Err(error) => self.written(Err(error)),
        }
    }

    /// Has the files take lines.
    fn put(&mut self, put: impl FnOnce(&mut Output) -> Result<(), OutputError>) {
        self.begin();
        let Some(output) = &mut self.output else { return self.homeless += 1 };
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
            say(format_args!("results are written again; {} were not", self.unwritten()));
        }
    }

    /// Notes whether lines were written. Those that come later are tried again.
    fn written(&mut self, result: Result<(), OutputError>) {
        let Err(error) = result else { return };
        if !std::mem::replace(&mut self.is_failing, true) {
            say(format_args!("{error}: {}; later lines are tried again", error.source));
        }
        self.first.get_or_insert(error);
    }

    /// Counts what is no page. The first one is named.
    fn refuse(&mut self, why: impl Display) {
        self.refused += 1;
        if self.refused == 1 {
            // It may quote what a lambda wrote.
            let why: String = why.to_string().chars().take(200).collect();
            say(format_args!(
                "a line is no page of results: {}; further ones are counted as not written",
                visible(&why)
            ));
        }
    }
}

/// The files in `folder`.
fn begun(folder: &Path, again: bool) -> Result<Output, OutputError> {
    Ok(Output::begin(folder, true, again)?.with_log_of(LIVE_LOG_MAX.bytes()))
}

/// Waits for `pages`, if there are any to wait for, but not longer than `patience`. Returns whether
/// `ended` is closed.
fn wait(pages: Option<BorrowedFd<'_>>, ended: &PipeReader, patience: Option<Duration>) -> bool {
    let patience = patience.and_then(|patience| Timespec::try_from(patience).ok());
    let mut waited: Vec<_> = [Some(ended.as_fd()), pages]
        .into_iter()
        .flatten()
        .map(|file| PollFd::from_borrowed_fd(file, PollFlags::IN))
        .collect();
    // A signal, which is for the other thread, ends the wait early; so may anything.
    let _ = poll(&mut waited, patience.as_ref());
    !waited[0].revents().is_empty()
}

/// Reports `decision` to the starter, as the runtime did while it lived.
fn report(decision: Decision) {
    let report = serde_json::to_string(&Report::Decision(Box::new(decision)))
        .expect("a decision is plain data");
    // The runtime may have ended within a line. Where the starter has gone there is the file.
    let _ = writeln!(io::stdout(), "\n{report}");
}

/// Writes a line for people. A reader that has gone is no reason to end.
fn say(text: impl Display) {
    let _ = writeln!(io::stderr(), "gleaner-shim: {text}");
}
