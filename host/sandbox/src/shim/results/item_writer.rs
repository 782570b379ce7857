//! Reads items from the pipe, at a bounded rate, and decides when they are written.

use std::fmt::Display;
use std::io::{self, PipeReader, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::time::{Duration, Instant};

use gleaner_base::{Failure, visible};
use gleaner_lambda::{Decision, RESULT_ITEM_MAX};
use gleaner_protocol::process_stats::Heartbeat;
use gleaner_protocol::{ExitRecord, LiveStatus, Report, ResultItem, WokenBy};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::lines::{LineSplitter, PIECE};
use super::sink::{ProcessResults, ResultSink};

/// Bytes read in a turn; further ones stay in the pipe. No healthy lambda sends 16 MiB or 65,000
/// lines a second, and a flood must not take a core or the disk from others.
const TURN_BYTES: usize = 1600 << 10;
const TURN: Duration = Duration::from_millis(100);
/// Bytes that are still read after the runtime has ended. A pipe holds 1 MiB, unless root allowed
/// more.
const DRAIN_BYTES: usize = 4 << 20;

/// Writes items to a sink, and counts those that are invalid.
pub(crate) struct ItemWriter {
    sink: Box<dyn ResultSink>,
    heartbeat: Heartbeat,
    woken_by: Option<WokenBy>,
    last: Option<Box<LiveStatus>>,
    /// Number of lines that were not valid items.
    refused: u64,
    /// Time since which items wait to be flushed; `None` if none do.
    behind_since: Option<Instant>,
    /// Set if a decision with a trigger or a fault waits to be flushed.
    is_urgent: bool,
    is_failing: bool,
    first: Option<Failure>,
}

impl ItemWriter {
    /// Creates a writer, and writes the items that `sink` begins with.
    pub(super) fn new(sink: Box<dyn ResultSink>, heartbeat: Heartbeat) -> Self {
        let mut writer = Self {
            sink,
            heartbeat,
            woken_by: None,
            last: None,
            refused: 0,
            behind_since: None,
            is_urgent: false,
            is_failing: false,
            first: None,
        };
        writer.flush();
        writer
    }

    /// Writes the items from the pipe until `ended` is closed and the pipe is empty.
    pub(super) fn write(mut self, mut items: PipeReader, ended: &PipeReader) -> Self {
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
            self.flush_if_due();
            self.heartbeat.set_unwritten(self.unwritten());
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
        self.heartbeat.set_unwritten(self.unwritten());
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
            self.decision(Box::new(decision.clone()));
            self.flush();
            report(decision);
        }
        let unwritten = self.unwritten();
        let summary = self.last.filter(|_| is_complete).map(|mut last| {
            // The recorder's counts are not the lambda's to report.
            last.recording = None;
            last.unwritten = last.unwritten.saturating_add(unwritten);
            last
        });
        let finished = self.sink.finish(ProcessResults { summary, record, invalid: self.refused });
        self.first.map_or(finished, Err)
    }

    /// Returns the number of items that were not written, for any reason.
    fn unwritten(&self) -> u64 {
        self.sink.lost() + self.refused
    }

    /// Returns the remaining time until the items must be flushed; `None` while none waits.
    fn timeout(&self) -> Option<Duration> {
        self.behind_since.map(|since| self.sink.interval().saturating_sub(since.elapsed()))
    }

    /// Handles one line; `None` for one that is too long.
    fn item(&mut self, line: Option<&[u8]>) {
        match line.map(serde_json::from_slice) {
            None => self.refuse(format_args!("it is longer than {RESULT_ITEM_MAX} bytes")),
            Some(Err(error)) => self.refuse(error),
            Some(Ok(ResultItem::Woken(by))) if self.woken_by.is_none() => {
                self.woken_by = Some(by);
                let begun = self.sink.begin();
                self.written(begun);
            }
            Some(Ok(_)) if self.woken_by.is_none() => self.refuse("the first item must be `woken`"),
            Some(Ok(ResultItem::Woken(_))) => self.refuse("`woken` comes only once"),
            Some(Ok(ResultItem::Last(last))) => self.last = Some(last),
            Some(Ok(ResultItem::Decision(decision))) => self.decision(decision),
            Some(Ok(ResultItem::Log(line))) => {
                let logged = self.sink.log(line);
                self.put(logged);
            }
        }
    }

    fn decision(&mut self, decision: Box<Decision>) {
        self.is_urgent |= !decision.triggers.is_empty() || decision.fault.is_some();
        let taken = self.sink.decision(decision);
        self.put(taken);
    }

    /// Handles the sink's result of taking an item.
    fn put(&mut self, taken: Result<(), Failure>) {
        if self.sink.has_pending() {
            self.behind_since.get_or_insert_with(Instant::now);
        }
        self.written(taken);
        if self.sink.is_due() && !self.is_failing {
            self.flush();
        }
    }

    /// Flushes urgent items at once and others in time. While writing fails, all items wait, so
    /// that a full disk is not tried for each of them.
    fn flush_if_due(&mut self) {
        let is_late = self.timeout().is_some_and(|timeout| timeout.is_zero());
        if is_late || self.is_urgent && !self.is_failing {
            self.flush();
        }
    }

    fn flush(&mut self) {
        (self.is_urgent, self.behind_since) = (false, None);
        if !self.sink.has_pending() {
            return;
        }
        let flushed = self.sink.flush(self.refused);
        // A sink may keep what it could not write.
        self.behind_since = self.sink.has_pending().then(Instant::now);
        if flushed.is_ok() && std::mem::take(&mut self.is_failing) {
            log(format_args!("results are written again; {} items were lost", self.unwritten()));
            if self.sink.lost() == 0 {
                self.first = None;
            }
        }
        self.written(flushed);
    }

    /// Records a failure to write, and logs the first in a row. Later items are tried again.
    fn written(&mut self, result: Result<(), Failure>) {
        let Err(failure) = result else { return };
        if !std::mem::replace(&mut self.is_failing, true) {
            let causes = failure.causes.iter().map(String::as_str);
            let text: Vec<_> = [failure.message.as_str()].into_iter().chain(causes).collect();
            log(format_args!("{}; later items are retried", visible(&text.join(": "))));
        }
        self.first.get_or_insert(failure);
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
