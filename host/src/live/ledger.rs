//! What leaves the process of a lambda: results to `gleaner-shim`, which writes them, and reports
//! to the starter. A disk that is slow, or a reader that has stopped, never holds up the lambda.

use std::io::Write;
use std::sync::mpsc::{self, Receiver, SyncSender, TrySendError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::Decision;
use gleaner_protocol::{Live, Page, Report};

use super::pages::Pages;
use crate::api::log::Line;

/// Reports that may wait while the starter does not read.
const REPORTS: usize = 256;
/// How long the last results may take on their way to the shim, and then the last report to the
/// starter.
const LAST_RESULTS: Duration = Duration::from_secs(20);
const LAST_REPORT: Duration = Duration::from_secs(2);

/// The writing end.
pub(super) struct Ledger {
    pages: Pages,
    /// Whether decisions without trigger and fault are kept, too.
    all: bool,
    reports: SyncSender<Report>,
    speaker: JoinHandle<()>,
}

impl Ledger {
    /// Hands results to `pages`, and writes reports to `reports`. With `all`, decisions without
    /// trigger and fault are results, too.
    pub(super) fn start(
        pages: Pages,
        all: bool,
        reports: impl Write + Send + 'static,
    ) -> Result<Self, Failure> {
        let cannot = |error| Failure::caused_by(Exit::Internal, "cannot start a thread", &error);
        let (say, said) = mpsc::sync_channel(REPORTS);
        let speaker = thread::Builder::new().name("gleaner-report".to_owned());
        let speaker = speaker.spawn(move || speak(&said, reports)).map_err(cannot)?;
        Ok(Self { pages, all, reports: say, speaker })
    }

    /// Keeps a decision; one with a trigger or a fault is reported, too, and is with the shim
    /// before: the shim writes it even if this process is killed a moment later.
    pub(super) fn decision(&mut self, decision: Decision) {
        if decision.triggers.is_empty() && decision.fault.is_none() {
            if self.all {
                self.pages.add(&Page::Decision(Box::new(decision)));
            }
            return;
        }
        let decision = Box::new(decision);
        self.pages.add(&Page::Decision(decision.clone()));
        self.pages.send();
        // A starter that reads too slowly finds it in the file.
        let _ = self.reports.try_send(Report::Decision(decision));
    }

    /// Keeps log lines.
    pub(super) fn log(&mut self, lines: Vec<Line>) {
        if lines.is_empty() {
            return;
        }
        for line in lines {
            self.pages.add(&Page::Log(line));
        }
        // They may say why this process ends in the next wake.
        self.pages.send();
    }

    /// Adds a page of another kind, and sends what waits.
    pub(super) fn page(&mut self, page: &Page) {
        self.pages.add(page);
        self.pages.send();
    }

    /// Sends what waits.
    pub(super) fn flush(&mut self) {
        self.pages.send();
    }

    /// Sends a report, unless the starter does not read.
    pub(super) fn report(&mut self, report: Report) {
        let _ = self.reports.try_send(report);
    }

    /// Decisions and lines that were not written.
    pub(super) fn unwritten(&self) -> u64 {
        self.pages.unwritten()
    }

    /// Hands on what waits, and the last report as the summary.
    ///
    /// # Errors
    ///
    /// A failure if results do not reach the shim.
    pub(super) fn finish(self, last: Option<Live>) -> Result<(), Failure> {
        let Self { mut pages, reports, speaker, .. } = self;
        if let Some(last) = &last {
            // The shim adds its own count.
            pages.add(&Page::Last(Box::new(Live { unwritten: pages.unsent(), ..last.clone() })));
        }
        // Here it may take its time: nothing runs any more.
        let finished = pages.finish(Instant::now() + LAST_RESULTS);
        let deadline = Instant::now() + LAST_REPORT;
        if let Some(last) = last {
            let mut report = Report::Ended(Box::new(last));
            // The starter may have stopped reading without going away.
            while let Err(TrySendError::Full(back)) = reports.try_send(report) {
                report = back;
                if Instant::now() >= deadline {
                    break;
                }
                thread::sleep(Duration::from_millis(5));
            }
        }
        drop(reports);
        while !speaker.is_finished() && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(5));
        }
        finished
    }
}

fn speak(said: &Receiver<Report>, mut reports: impl Write) {
    while let Ok(report) = said.recv() {
        let Ok(mut line) = serde_json::to_string(&report) else { continue };
        line.push('\n');
        // The starter may have gone; the results are in files.
        let _ = reports.write_all(line.as_bytes());
    }
}
