//! What is written down, by a thread of its own: a disk that is slow, or a reader that has stopped, never holds up the lambda.

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, SyncSender, TrySendError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_protocol::{Decision, Exit, Failure, Live, Report};

use crate::api::log::Line;
use crate::stage::{Output, OutputError};

/// What may wait to be written: some seconds of a lambda at 1 kHz.
const WAITING: usize = 8192;
/// Reports that may wait while nobody reads them.
const REPORTS: usize = 256;
/// How long written lines may be on their way to the file.
const FLUSH: Duration = Duration::from_millis(500);

enum Page {
    Decision(Decision),
    Log(Vec<Line>),
    Last(Box<Live>),
}

/// The writing end.
pub(super) struct Ledger {
    pages: SyncSender<Page>,
    reports: SyncSender<Report>,
    unwritten: Arc<AtomicU64>,
    files: JoinHandle<Result<(), OutputError>>,
    speaker: JoinHandle<()>,
}

impl Ledger {
    /// Writes results to `output`, and reports to `reports`.
    pub(super) fn start(output: Output, reports: impl Write + Send + 'static) -> Result<Self, Failure> {
        let cannot = |error| Failure::caused_by(Exit::Internal, "cannot start a thread", &error);
        let (pages, to_write) = mpsc::sync_channel(WAITING);
        let (say, said) = mpsc::sync_channel(REPORTS);
        let unwritten = Arc::new(AtomicU64::new(0));
        let count = Arc::clone(&unwritten);
        let files = thread::Builder::new().name("gleaner-ledger".to_owned());
        let files = files.spawn(move || keep(&to_write, output, &count)).map_err(cannot)?;
        let speaker = thread::Builder::new().name("gleaner-report".to_owned());
        let speaker = speaker.spawn(move || speak(&said, reports)).map_err(cannot)?;
        Ok(Self { pages, reports: say, unwritten, files, speaker })
    }

    /// Keeps a decision; one with a trigger or a fault is reported, too.
    pub(super) fn decision(&mut self, decision: Decision) {
        if !decision.triggers.is_empty() || decision.fault.is_some() {
            // It is in the file as well, so whoever reads too slowly misses nothing.
            let _ = self.reports.try_send(Report::Decision(Box::new(decision.clone())));
        }
        self.page(Page::Decision(decision), 1);
    }

    /// Keeps log lines.
    pub(super) fn log(&mut self, lines: Vec<Line>) {
        let count = lines.len() as u64;
        if count > 0 {
            self.page(Page::Log(lines), count);
        }
    }

    /// Sends a report, unless nobody reads them.
    pub(super) fn report(&mut self, report: Report) {
        let _ = self.reports.try_send(report);
    }

    /// Decisions and lines that were not written.
    pub(super) fn unwritten(&self) -> u64 {
        self.unwritten.load(Ordering::Relaxed)
    }

    /// Writes what waits, and the last report as the summary.
    ///
    /// # Errors
    ///
    /// The first thing that could not be written.
    pub(super) fn finish(self, last: Option<Live>) -> Result<(), Failure> {
        let Self { pages, reports, files, speaker, .. } = self;
        let deadline = Instant::now() + Duration::from_secs(2);
        if let Some(last) = last {
            // Here it may take its time: nothing runs any more.
            let _ = pages.send(Page::Last(Box::new(last.clone())));
            let mut report = Report::Ended(Box::new(last));
            // Whoever started us may have stopped reading without going away.
            while let Err(TrySendError::Full(back)) = reports.try_send(report) {
                report = back;
                if Instant::now() >= deadline {
                    break;
                }
                thread::sleep(Duration::from_millis(5));
            }
        }
        drop((pages, reports));
        let written = files.join().expect("writing files does not panic");
        while !speaker.is_finished() && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(5));
        }
        Ok(written?)
    }

    fn page(&mut self, page: Page, count: u64) {
        if self.pages.try_send(page).is_err() {
            self.unwritten.fetch_add(count, Ordering::Relaxed);
        }
    }
}

/// Writes pages until there are no more. What cannot be written is counted, and what comes later is tried again.
fn keep(pages: &Receiver<Page>, mut output: Output, unwritten: &AtomicU64) -> Result<(), OutputError> {
    let mut first = None;
    let (mut is_failing, mut counted) = (false, 0);
    let mut last = None;
    let mut flushed = Instant::now();
    loop {
        let written = match pages.recv_timeout(FLUSH.saturating_sub(flushed.elapsed())) {
            // Whoever is told of a trigger finds it in the file, even if this process is killed a moment later.
            Ok(Page::Decision(decision)) if decision.triggers.is_empty() && decision.fault.is_none() => {
                output.decision(&decision)
            }
            Ok(Page::Decision(decision)) => output.decision(&decision).and_then(|()| output.flush()),
            Ok(Page::Log(lines)) => output.log(&lines),
            Ok(Page::Last(live)) => {
                last = Some(live);
                Ok(())
            }
            Err(RecvTimeoutError::Timeout) => Ok(()),
            Err(RecvTimeoutError::Disconnected) => break,
        };
        let is_due = flushed.elapsed() >= FLUSH;
        let written = written.and_then(|()| if is_due { output.flush() } else { Ok(()) });
        if is_due {
            flushed = Instant::now();
        }
        unwritten.fetch_add(output.lost() - std::mem::replace(&mut counted, output.lost()), Ordering::Relaxed);
        match written {
            Err(error) => {
                if !is_failing {
                    tracing::error!(file = %error.path.display(), error = %error.source, "results cannot be written; what comes is tried again");
                }
                is_failing = true;
                first.get_or_insert(error);
            }
            Ok(()) if is_failing && is_due => {
                is_failing = false;
                let unwritten = unwritten.load(Ordering::Relaxed);
                tracing::warn!(unwritten, "results are written again");
            }
            Ok(()) => {}
        }
    }
    let finished = match last {
        Some(mut live) => {
            live.unwritten = unwritten.load(Ordering::Relaxed);
            output.finish(&live)
        }
        None => output.flush(),
    };
    first.map_or(finished, Err)
}

fn speak(said: &Receiver<Report>, mut reports: impl Write) {
    while let Ok(report) = said.recv() {
        let Ok(mut line) = serde_json::to_string(&report) else { continue };
        line.push('\n');
        // Whoever listened may have gone; the results are in files.
        let _ = reports.write_all(line.as_bytes());
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::Read;
    use std::process::Command;

    use gleaner_protocol::Cause;
    use rustix::fs::OFlags;

    use super::*;

    fn decision(seq: u64) -> Decision {
        Decision {
            at_ns: 0,
            cause: Cause::Event,
            input: None,
            topic: None,
            writer: None,
            seq: Some(seq),
            triggers: Vec::new(),
            fault: None,
            fuel: None,
            run_ns: 0,
        }
    }

    /// A pipe that nobody empties takes no more, as a full disk does; until somebody does.
    #[test]
    fn what_cannot_be_written_is_counted_and_what_comes_later_is_written_again() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("decisions.jsonl");
        assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let mut reader = File::from(rustix::fs::open(&pipe, OFlags::RDONLY | OFlags::NONBLOCK, 0.into()).unwrap());
        let writer = File::from(rustix::fs::open(&pipe, OFlags::WRONLY | OFlags::NONBLOCK, 0.into()).unwrap());
        let results = tempfile::tempdir().unwrap();
        let output = Output::begin(results.path(), true, true).unwrap().with_decisions_in(writer);
        let mut ledger = Ledger::start(output, std::io::sink()).unwrap();
        let mut seq = 0;
        let mut write = |ledger: &mut Ledger| {
            seq += 1;
            ledger.decision(decision(seq));
            thread::sleep(Duration::from_micros(100));
            seq
        };
        while ledger.unwritten() == 0 {
            write(&mut ledger);
        }
        let refused = write(&mut ledger);
        let mut text = Vec::new();
        while !String::from_utf8_lossy(&text).lines().any(|line| {
            serde_json::from_str(line).is_ok_and(|decision: Decision| decision.seq.is_some_and(|seq| seq > refused))
        }) {
            write(&mut ledger);
            let _ = reader.read_to_end(&mut text);
        }
        assert!(ledger.finish(None).unwrap_err().to_string().contains("decisions.jsonl"));
    }
}
