//! Results on their way to `gleaner-shim`, which writes the files: this process holds none that it
//! could write.
//!
//! Nothing here waits while the lambda lives. What the pipe does not take waits in memory that was
//! reserved before, and what has no room there is counted.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Write};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::PAGE_BYTES;
use gleaner_protocol::{Page, RESULTS_ENV};
use gleaner_vitals::{Pulse, inherited};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FileType, fstat};

/// Bytes that may wait: some seconds of a lambda at 1 kHz whose decisions are all written.
const WAITING: usize = 2 * PAGE_BYTES;
/// From so many bytes on they are sent, however little they matter.
const FULL: usize = 32 << 10;

/// The pipe to the shim.
pub struct Pages {
    pipe: File,
    /// Lines that the pipe has not taken; of the first one it may have a part.
    waiting: VecDeque<u8>,
    /// The line that is made.
    line: Vec<u8>,
    unwritten: u64,
    /// The shim counts there what it cannot write.
    pulse: Pulse,
}

impl Pages {
    /// The pipe that the shim has made: [`RESULTS_ENV`].
    ///
    /// # Errors
    ///
    /// A failure if this process was started without one.
    pub fn open(pulse: Pulse) -> Result<Self, Failure> {
        let cannot =
            |error: &io::Error| Failure::caused_by(Exit::Internal, "cannot hand on results", error);
        let pipe = inherited(RESULTS_ENV).map_err(|error| cannot(&error))?.ok_or_else(|| {
            Failure::new(Exit::Usage, "no process writes the results of this one")
                .with_help("start it by `gleaner run`, or by `gleaner-shim --results DIR -- gleaner-runtime run`")
        })?;
        let found = fstat(&pipe).map_err(|error| cannot(&error.into()))?;
        if FileType::from_raw_mode(found.st_mode) != FileType::Fifo {
            return Err(cannot(&io::Error::new(
                io::ErrorKind::InvalidInput,
                format!("{RESULTS_ENV} names no pipe"),
            )));
        }
        Ok(Self::over(pipe.into(), pulse))
    }

    /// Results go into `pipe`, which does not block; `pulse` shows what of them could not be
    /// written.
    pub fn over(pipe: File, pulse: Pulse) -> Self {
        let waiting = VecDeque::with_capacity(WAITING);
        Self { pipe, waiting, line: Vec::new(), unwritten: 0, pulse }
    }

    /// Adds `page`, to be sent with what waits. Returns whether there was room.
    pub(super) fn add(&mut self, page: &Page) -> bool {
        self.line.clear();
        serde_json::to_writer(&mut self.line, page)
            .expect("a page has text keys and finite numbers");
        self.line.push(b'\n');
        let has_room =
            self.line.len() <= PAGE_BYTES && self.waiting.len() + self.line.len() <= WAITING;
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

    /// Sends what the pipe takes.
    pub(super) fn send(&mut self) {
        while !self.waiting.is_empty() {
            match self.pipe.write(self.waiting.as_slices().0) {
                Ok(written) => drop(self.waiting.drain(..written)),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                Err(error) => {
                    let lines = self.waiting.iter().filter(|byte| **byte == b'\n').count() as u64;
                    if self.unwritten == 0 {
                        tracing::error!(%error, "results cannot be handed to gleaner-shim; they are counted as not written");
                    }
                    self.unwritten += lines;
                    self.waiting.clear();
                }
            }
        }
        // From the start of its memory again, so that most of it is never touched.
        self.waiting.clear();
    }

    /// Sends all, for which it waits until `deadline`.
    ///
    /// # Errors
    ///
    /// A failure if something was not taken.
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
                    "results are not written: their disk has stood still too long",
                );
                return Err(failure.with_help("choose a folder on another disk: --out DIR"));
            }
            let patience = Timespec::try_from(left.min(Duration::from_secs(1))).ok();
            // Whatever ends the wait, it is tried again.
            let _ = poll(&mut [PollFd::new(&self.pipe, PollFlags::OUT)], patience.as_ref());
        }
    }

    /// Pages that did not fit, here, and those that the shim could not write.
    pub(super) fn unwritten(&self) -> u64 {
        self.unwritten.saturating_add(self.pulse.unwritten())
    }

    /// Pages that did not fit.
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

    fn log(at_ns: i64) -> Page {
        Page::Log(LogLine { at_ns, level: LogLevel::Info, message: "x".repeat(1000) })
    }

    fn pages() -> (impl Read, Pages) {
        let (reader, writer) = pipe().unwrap();
        ioctl_fionbio(&writer, true).unwrap();
        (reader, Pages::over(OwnedFd::from(writer).into(), Pulse::make().unwrap().0))
    }

    #[test]
    fn what_the_pipe_does_not_take_waits_and_what_has_no_room_is_counted_and_cuts_no_line() {
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
            lines.map(|line| serde_json::from_str(&line.unwrap()).unwrap()).collect::<Vec<Page>>()
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
    fn what_cannot_be_sent_any_more_is_counted() {
        let (reader, mut pages) = pages();
        drop(reader);
        for at_ns in 0..3 {
            assert!(pages.add(&log(at_ns)));
        }
        pages.send();
        assert_eq!(pages.unwritten(), 3);
        pages.pulse.set_unwritten(4);
        assert_eq!((pages.unwritten(), pages.unsent()), (7, 3));
    }

    #[test]
    fn a_page_that_is_too_long_is_counted_and_not_sent() {
        let (_reader, mut pages) = pages();
        let message = "x".repeat(PAGE_BYTES);
        assert!(!pages.add(&Page::Log(LogLine { at_ns: 0, level: LogLevel::Info, message })));
        assert_eq!((pages.unwritten(), pages.waiting.len()), (1, 0));
    }
}
