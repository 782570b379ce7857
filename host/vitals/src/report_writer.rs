//! Writes reports to the starter in a thread of its own: a slow starter does not delay a sample.

use std::fs::File;
use std::io::{self, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::Builder;
use std::time::Duration;

use gleaner_protocol::ingress::IngressReport;
use tracing::warn;

/// Maximum number of queued reports. A status more or less does not matter, and there are few
/// others.
const WAITING: usize = 256;

/// Time to wait at the end for a starter that does not read.
const END_TIMEOUT: Duration = Duration::from_secs(2);

/// The thread that writes reports.
pub(super) struct ReportWriter {
    reports: SyncSender<IngressReport>,
    /// Nothing is sent over it; it closes when the thread has ended.
    ended: Receiver<()>,
}

/// Queues reports without blocking.
pub(super) struct ReportSender {
    reports: SyncSender<IngressReport>,
    /// Set once a report was dropped for lack of room.
    has_dropped: AtomicBool,
}

impl ReportWriter {
    pub(super) fn start(to: File) -> io::Result<Self> {
        let (reports, inbox) = sync_channel(WAITING);
        let (ends, ended) = sync_channel::<()>(0);
        Builder::new().name("reports".to_owned()).spawn(move || {
            write(to, &inbox);
            drop(ends);
        })?;
        Ok(Self { reports, ended })
    }

    pub(super) fn sender(&self) -> ReportSender {
        ReportSender { reports: self.reports.clone(), has_dropped: AtomicBool::new(false) }
    }

    /// Waits until all reports are written, once all senders are dropped; not for a starter that
    /// does not read.
    pub(super) fn end(self) {
        let Self { reports, ended } = self;
        drop(reports);
        let _ = ended.recv_timeout(END_TIMEOUT);
    }
}

impl ReportSender {
    pub(super) fn send(&self, report: IngressReport) {
        match self.reports.try_send(report) {
            Ok(()) | Err(TrySendError::Disconnected(_)) => {}
            Err(TrySendError::Full(_)) => {
                if !self.has_dropped.swap(true, Ordering::Relaxed) {
                    warn!("the starter does not read reports: some are dropped");
                }
            }
        }
    }
}

fn write(mut to: File, reports: &Receiver<IngressReport>) {
    for report in reports {
        let mut line = serde_json::to_vec(&report).expect("a report is plain data");
        line.push(b'\n');
        if to.write_all(&line).is_err() {
            // There is no reader any more.
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader};
    use std::os::fd::OwnedFd;

    use super::*;

    #[test]
    fn a_starter_that_does_not_read_delays_nothing() {
        let (reader, writer) = std::io::pipe().unwrap();
        let reports = ReportWriter::start(File::from(OwnedFd::from(writer))).unwrap();
        let sender = reports.sender();
        // The pipe holds 64 KiB; the queue is full some time after it is.
        while !sender.has_dropped.load(Ordering::Relaxed) {
            sender.send(IngressReport::Status(Box::default()));
        }
        drop(sender);
        let reading = std::thread::spawn(move || BufReader::new(reader).lines().count());
        reports.end();
        assert!(reading.join().unwrap() >= WAITING);
    }
}
