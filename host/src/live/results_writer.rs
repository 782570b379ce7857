//! Sends results to `gleaner-shim`, which writes them, and reports to the parent. A slow disk, or a
//! reader that has stopped, never delays the lambda.

use std::io::Write;
use std::sync::mpsc::{self, Receiver, SyncSender, TrySendError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::Decision;
use gleaner_protocol::{LiveStatus, Report, ResultItem};

use super::results_pipe::ResultsPipe;
use crate::api::log::LogLine;

/// Maximum number of reports that wait while the parent does not read.
const REPORTS: usize = 256;
/// Timeouts of the last results to the shim, and then of the last report to the parent.
const LAST_RESULTS: Duration = Duration::from_secs(20);
const LAST_REPORT: Duration = Duration::from_secs(2);

pub(super) struct ResultsWriter {
    pages: ResultsPipe,
    /// Set if decisions without trigger and fault are results, too.
    all: bool,
    reports: SyncSender<Report>,
    report_thread: JoinHandle<()>,
}

impl ResultsWriter {
    /// Sends results to `pages`, and writes reports to `reports`. With `all`, decisions without
    /// trigger and fault are results, too.
    pub(super) fn start(
        pages: ResultsPipe,
        all: bool,
        reports: impl Write + Send + 'static,
    ) -> Result<Self, Failure> {
        let cannot = |error| Failure::caused_by(Exit::Internal, "cannot start a thread", &error);
        let (sender, receiver) = mpsc::sync_channel(REPORTS);
        let report_thread = thread::Builder::new().name("gleaner-report".to_owned());
        let report_thread =
            report_thread.spawn(move || write_reports(&receiver, reports)).map_err(cannot)?;
        Ok(Self { pages, all, reports: sender, report_thread })
    }

    /// Adds a decision. One with a trigger or a fault is reported, too, after it was sent to the
    /// shim, which writes it even if this process is killed a moment later.
    pub(super) fn decision(&mut self, decision: Decision) {
        if decision.triggers.is_empty() && decision.fault.is_none() {
            if self.all {
                self.pages.add(&ResultItem::Decision(Box::new(decision)));
            }
            return;
        }
        let decision = Box::new(decision);
        self.pages.add(&ResultItem::Decision(decision.clone()));
        self.pages.send();
        // A parent that reads too slowly finds it in the file.
        let _ = self.reports.try_send(Report::Decision(decision));
    }

    pub(super) fn log(&mut self, lines: Vec<LogLine>) {
        if lines.is_empty() {
            return;
        }
        for line in lines {
            self.pages.add(&ResultItem::Log(line));
        }
        // They may explain a crash of this process in the next wake.
        self.pages.send();
    }

    /// Adds an item of another kind, and sends waiting items.
    pub(super) fn page(&mut self, page: &ResultItem) {
        self.pages.add(page);
        self.pages.send();
    }

    pub(super) fn flush(&mut self) {
        self.pages.send();
    }

    /// Sends a report, unless the parent does not read.
    pub(super) fn report(&mut self, report: Report) {
        let _ = self.reports.try_send(report);
    }

    /// Number of decisions and lines that were not written.
    pub(super) fn unwritten(&self) -> u64 {
        self.pages.unwritten()
    }

    /// Sends waiting items, and the last report as the summary.
    pub(super) fn finish(self, last: Option<LiveStatus>) -> Result<(), Failure> {
        let Self { mut pages, reports, report_thread, .. } = self;
        if let Some(last) = &last {
            // The shim adds its own count.
            pages.add(&ResultItem::Last(Box::new(LiveStatus {
                unwritten: pages.unsent(),
                ..last.clone()
            })));
        }
        // The lambda no longer runs, so this may block.
        let finished = pages.finish(Instant::now() + LAST_RESULTS);
        let deadline = Instant::now() + LAST_REPORT;
        if let Some(last) = last {
            let mut report = Report::Ended(Box::new(last));
            // The parent may have stopped reading without going away.
            while let Err(TrySendError::Full(back)) = reports.try_send(report) {
                report = back;
                if Instant::now() >= deadline {
                    break;
                }
                thread::sleep(Duration::from_millis(5));
            }
        }
        drop(reports);
        while !report_thread.is_finished() && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(5));
        }
        finished
    }
}

fn write_reports(receiver: &Receiver<Report>, mut reports: impl Write) {
    while let Ok(report) = receiver.recv() {
        let Ok(mut line) = serde_json::to_string(&report) else { continue };
        line.push('\n');
        // The parent may have ended; the results are in files.
        let _ = reports.write_all(line.as_bytes());
    }
}
