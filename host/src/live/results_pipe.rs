//! The pipe that sends results to `gleaner-shim`, which writes the files: this process has no
//! writable file.
//!
//! Nothing here blocks while the lambda runs. Items that the pipe does not accept wait in memory
//! that was reserved before; items without room there are counted.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Write};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::RESULT_ITEM_MAX;
use gleaner_protocol::process_stats::{Heartbeat, inherited};
use gleaner_protocol::{RESULTS_ENV, ResultItem};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FileType, fstat};

/// Maximum number of bytes that wait: some seconds of a lambda at 1 kHz whose decisions are all
/// written.
const WAITING: usize = 2 * RESULT_ITEM_MAX;
/// Number of waiting bytes from which on they are sent in any case.
const FULL: usize = 32 << 10;

pub struct ResultsPipe {
    pipe: File,
    /// Lines that the pipe has not accepted; it may have accepted a part of the first.
    waiting: VecDeque<u8>,
    line: Vec<u8>,
    unwritten: u64,
    /// The page in which the shim counts what it cannot write.
    heartbeat: Heartbeat,
}

impl ResultsPipe {
    /// Opens the pipe that the shim has created: [`RESULTS_ENV`]. Fails if this process was
    /// started without one.
    pub fn open(heartbeat: Heartbeat) -> Result<Self, Failure> {
        let cannot =
            |error: &io::Error| Failure::caused_by(Exit::Internal, "cannot send results", error);
        let pipe = inherited(RESULTS_ENV).map_err(|error| cannot(&error))?.ok_or_else(|| {
            Failure::new(Exit::Usage, "this process has no pipe for its results").with_help(
                "start it with `gleaner run`, or with `gleaner-shim --results DIR -- \
                     gleaner-runtime run`",
            )
        })?;
        let found = fstat(&pipe).map_err(|error| cannot(&error.into()))?;
        if FileType::from_raw_mode(found.st_mode) != FileType::Fifo {
            return Err(cannot(&io::Error::new(
                io::ErrorKind::InvalidInput,
                format!("{RESULTS_ENV} names no pipe"),
            )));
        }
        Ok(Self::over(pipe.into(), heartbeat))
    }

    /// A sender over `pipe`, which does not block; `heartbeat` has the number of items that could
    /// not be written.
    pub fn over(pipe: File, heartbeat: Heartbeat) -> Self {
        let waiting = VecDeque::with_capacity(WAITING);
        Self { pipe, waiting, line: Vec::new(), unwritten: 0, heartbeat }
    }

    /// Adds `item`, to be sent with the waiting ones. Returns whether there was room.
    pub(super) fn add(&mut self, item: &ResultItem) -> bool {
        self.line.clear();
        serde_json::to_writer(&mut self.line, item)
            .expect("an item has text keys and finite numbers");
        self.line.push(b'\n');
        let has_room =
            self.line.len() <= RESULT_ITEM_MAX && self.waiting.len() + self.line.len() <= WAITING;
        if has_room {
            self.waiting.extend(&self.line);
        } else {
            self.unwritten += 1;
        }
        // A long line is rare.
        self.line.shrink_to(FULL);
        if self.waiting.len() >= FULL {
            self.send();
        }
        has_room
    }

    /// Sends as much as the pipe accepts.
    pub(super) fn send(&mut self) {
        while !self.waiting.is_empty() {
            match self.pipe.write(self.waiting.as_slices().0) {
                Ok(written) => drop(self.waiting.drain(..written)),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                Err(error) => {
                    let lines = self.waiting.iter().filter(|byte| **byte == b'\n').count() as u64;
                    if self.unwritten == 0 {
                        tracing::error!(
                            %error,
                            "cannot send results to gleaner-shim; counted as not written"
                        );
                    }
                    self.unwritten += lines;
                    self.waiting.clear();
                }
            }
        }
        // From the start of its memory again, so that most of it is never touched.
        self.waiting.clear();
    }

    /// Sends all items, and waits until `deadline` for that. Fails if an item was not
    /// accepted.
    pub(super) fn finish(&mut self, deadline: Instant) -> Result<(), Failure> {
        loop {
            self.send();
            let left = deadline.saturating_duration_since(Instant::now());
            if self.waiting.is_empty() {
                return Ok(());
            }
            if left.is_zero() {
                let failure = Failure::new(
                    Exit::Internal,
                    "cannot write results: the disk did not respond in time",
                );
                return Err(failure.with_help("choose a folder on another disk: --out DIR"));
            }
            let patience = Timespec::try_from(left.min(Duration::from_secs(1))).ok();
            // After any result of the wait, sending is tried again.
            let _ = poll(&mut [PollFd::new(&self.pipe, PollFlags::OUT)], patience.as_ref());
        }
    }

    /// Number of items that did not fit here, or that the shim could not write.
    pub(super) fn unwritten(&self) -> u64 {
        self.unwritten.saturating_add(self.heartbeat.unwritten())
    }

    /// Number of items that did not fit here.
    pub(super) fn unsent(&self) -> u64 {
        self.unwritten
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader, Read, pipe};
    use std::os::fd::OwnedFd;

    use gleaner_lambda::{LogLevel, LogLine};
    use rustix::io::ioctl_fionbio;

    use super::*;

    fn log(at_ns: i64) -> ResultItem {
        ResultItem::Log(LogLine { at_ns, level: LogLevel::Info, message: "x".repeat(1000) })
    }

    fn pages() -> (impl Read, ResultsPipe) {
        let (reader, writer) = pipe().unwrap();
        ioctl_fionbio(&writer, true).unwrap();
        (reader, ResultsPipe::over(OwnedFd::from(writer).into(), Heartbeat::create().unwrap().0))
    }

    #[test]
    fn items_wait_for_the_pipe_and_items_without_room_are_counted_and_cut_no_line() {
        let (reader, mut pages) = pages();
        let mut kept = Vec::new();
        for at_ns in 0.. {
            if pages.add(&log(at_ns)) {
                kept.push(at_ns);
            }
            if pages.unwritten() == 100 {
                break;
            }
        }
        assert!(kept.len() > WAITING / 1100, "{} lines had room", kept.len());
        let read = std::thread::spawn(move || {
            let lines = BufReader::new(reader).lines();
            lines
                .map(|line| serde_json::from_str(&line.unwrap()).unwrap())
                .collect::<Vec<ResultItem>>()
        });
        pages.finish(Instant::now() + Duration::from_secs(60)).unwrap();
        // There is room again.
        assert!(pages.add(&log(-1)));
        pages.finish(Instant::now() + Duration::from_secs(60)).unwrap();
        assert_eq!(pages.unwritten(), 100);
        drop(pages);
        kept.push(-1);
        assert!(read.join().unwrap() == kept.into_iter().map(log).collect::<Vec<_>>());
    }

    #[test]
    fn items_that_cannot_be_sent_are_counted() {
        let (reader, mut pages) = pages();
        drop(reader);
        for at_ns in 0..3 {
            assert!(pages.add(&log(at_ns)));
        }
        pages.send();
        assert_eq!(pages.unwritten(), 3);
        pages.heartbeat.set_unwritten(4);
        assert_eq!((pages.unwritten(), pages.unsent()), (7, 3));
    }

    #[test]
    fn an_item_that_is_too_long_is_counted_and_not_sent() {
        let (_reader, mut pages) = pages();
        let message = "x".repeat(RESULT_ITEM_MAX);
        assert!(!pages.add(&ResultItem::Log(LogLine { at_ns: 0, level: LogLevel::Info, message })));
        assert_eq!((pages.unwritten(), pages.waiting.len()), (1, 0));
    }
}
