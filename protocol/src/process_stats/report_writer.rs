//! Writes reports to the starter in a thread of its own: a slow starter does not delay a process
//! that serves lambdas.

use std::fs::File;
use std::io::{self, Write};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::Builder;
use std::time::Duration;

use serde::Serialize;
use tracing::warn;

/// Maximum number of queued reports. A status more or less does not matter, and there are few
/// others.
const WAITING: usize = 256;

/// Time to wait at the end for a starter that does not read.
const END_TIMEOUT: Duration = Duration::from_secs(2);

pub struct ReportWriter<T> {
    reports: SyncSender<T>,
    /// Nothing is sent over it; it closes when the thread has ended.
    ended: Receiver<()>,
}

/// Queues reports without blocking.
pub struct ReportSender<T> {
    reports: SyncSender<T>,
    /// Reports without room since the last one that had some.
    dropped: AtomicU64,
}

impl<T: Serialize + Send + 'static> ReportWriter<T> {
    /// Starts the thread, which writes each report to `to` as a line of JSON.
    ///
    /// # Errors
    ///
    /// If the system starts no thread.
    pub fn start(to: File) -> io::Result<Self> {
        let (reports, inbox) = sync_channel(WAITING);
        let (ends, ended) = sync_channel::<()>(0);
        Builder::new().name("reports".to_owned()).spawn(move || {
            write(to, &inbox);
            drop(ends);
        })?;
        Ok(Self { reports, ended })
    }

    pub fn sender(&self) -> ReportSender<T> {
        ReportSender { reports: self.reports.clone(), dropped: AtomicU64::new(0) }
    }

    /// Waits until all reports are written, once all senders are dropped; not for a starter that
    /// does not read.
    pub fn end(self) {
        let Self { reports, ended } = self;
        drop(reports);
        let _ = ended.recv_timeout(END_TIMEOUT);
    }
}

impl<T> ReportSender<T> {
    /// Queues a report. One that finds no room is dropped; their number is logged once there is
    /// room again, and at the end.
    pub fn send(&self, report: T) {
        match self.reports.try_send(report) {
            Ok(()) => self.log_dropped(),
            Err(TrySendError::Disconnected(_)) => {}
            Err(TrySendError::Full(_)) => drop(self.dropped.fetch_add(1, Ordering::Relaxed)),
        }
    }

    fn log_dropped(&self) {
        let dropped = self.dropped.swap(0, Ordering::Relaxed);
        if dropped > 0 {
            warn!(dropped, "reports dropped: the parent process did not read them");
        }
    }
}

impl<T> Drop for ReportSender<T> {
    fn drop(&mut self) {
        self.log_dropped();
    }
}

fn write<T: Serialize>(mut to: File, reports: &Receiver<T>) {
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

    use crate::ingress::IngressReport;

    use super::*;

    #[test]
    fn a_starter_that_does_not_read_delays_nothing() {
        let (reader, writer) = std::io::pipe().unwrap();
        let reports = ReportWriter::start(File::from(OwnedFd::from(writer))).unwrap();
        let sender = reports.sender();
        // The pipe holds 64 KiB; the queue is full some time after it is.
        while sender.dropped.load(Ordering::Relaxed) < 3 {
            sender.send(IngressReport::Status(Box::default()));
        }
        drop(sender);
        let reading = std::thread::spawn(move || BufReader::new(reader).lines().count());
        reports.end();
        assert!(reading.join().unwrap() >= WAITING);
    }
}
