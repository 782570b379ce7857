//! Writes reports to the starter, and losses to their list, with one thread each: a slow starter
//! does not delay a loss, and a slow disk does not delay a report.

use std::fs::File;
use std::io::Write;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::Builder;
use std::time::Duration;

use gleaner_protocol::link::{Loss, RecorderReport};
use tracing::{error, warn};

use crate::LossList;

/// Maximum number of reports and losses in a queue. Those of clips are few, and a status more or
/// less does not matter.
const WAITING: usize = 1024;

/// Time to wait for a starter that does not read, and a disk that does not write.
const END_TIMEOUT: Duration = Duration::from_secs(2);

/// Queues reports without blocking.
pub struct ReportWriter {
    reports: SyncSender<RecorderReport>,
    losses: SyncSender<Loss>,
    /// Nothing is sent over it; it closes when both threads have ended.
    ended: Receiver<()>,
    /// Number of reports dropped for lack of room. Clips and losses are still in their lists.
    dropped: u64,
}

impl ReportWriter {
    pub fn start(to: File, list: Arc<LossList>) -> std::io::Result<ReportWriter> {
        let (reports, inbox) = sync_channel(WAITING);
        let (losses, lost) = sync_channel(WAITING);
        let (ends, ended) = sync_channel::<()>(1);
        let notes_end = ends.clone();
        Builder::new().name("reports".to_owned()).spawn(move || {
            write(to, &inbox);
            drop(ends);
        })?;
        Builder::new().name("losses".to_owned()).spawn(move || {
            note(&list, &lost);
            drop(notes_end);
        })?;
        Ok(ReportWriter { reports, losses, ended, dropped: 0 })
    }

    pub fn send(&mut self, report: RecorderReport) {
        if let RecorderReport::Loss(loss) = &report
            // Noted already, before the deletion.
            && !matches!(loss, Loss::Deleted { .. } | Loss::NotDeleted { .. })
            && self.losses.try_send(loss.clone()).is_err()
        {
            error!(?loss, "the disk is too slow to write losses.jsonl");
        }
        match self.reports.try_send(report) {
            Ok(()) | Err(TrySendError::Disconnected(_)) => {}
            Err(TrySendError::Full(_)) => {
                self.dropped += 1;
                if self.dropped == 1 {
                    warn!("the parent process does not read reports: some are dropped");
                }
            }
        }
    }

    /// Sends the last report, and waits until all is written; not for a starter that does not read.
    pub fn end(mut self, report: RecorderReport) {
        self.send(report);
        let ReportWriter { reports, losses, ended, dropped } = self;
        drop((reports, losses));
        let _ = ended.recv_timeout(END_TIMEOUT);
        if dropped > 0 {
            warn!(dropped, "reports dropped: the parent process did not read them");
        }
    }
}

fn write(mut to: File, reports: &Receiver<RecorderReport>) {
    for report in reports {
        let mut line = serde_json::to_vec(&report).expect("a report is plain data");
        line.push(b'\n');
        if to.write_all(&line).is_err() {
            // There is no reader any more.
            return;
        }
    }
}

fn note(list: &LossList, losses: &Receiver<Loss>) {
    for loss in losses {
        if let Err(error) = list.note(&loss) {
            error!(?loss, error = &error as &dyn std::error::Error, "cannot write losses.jsonl");
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader};
    use std::os::fd::OwnedFd;
    use std::time::Instant;

    use super::*;
    use crate::RecordingFolder;
    use crate::recorder::tests::support::TestDir;

    #[test]
    fn a_loss_is_noted_even_if_the_starter_reads_nothing() {
        let scratch = TestDir::new();
        let (folder, _) = RecordingFolder::open(&scratch.0).unwrap();
        let (reader, writer) = std::io::pipe().unwrap();
        let mut reports =
            ReportWriter::start(File::from(OwnedFd::from(writer)), folder.losses()).unwrap();
        // The pipe holds 64 KiB; the queue is full some time after it is.
        while reports.dropped == 0 {
            reports.send(RecorderReport::Status(Box::default()));
        }
        reports.send(RecorderReport::Loss(Loss::Failed { at_ns: 7, reason: "x".to_owned() }));
        let noted = || std::fs::read_to_string(scratch.0.join("losses.jsonl")).unwrap_or_default();
        let deadline = Instant::now() + Duration::from_secs(60);
        while !noted().ends_with('\n') {
            assert!(Instant::now() < deadline, "{}", noted());
            std::thread::yield_now();
        }
        assert_eq!(noted(), "{\"loss\":\"failed\",\"at_ns\":7,\"reason\":\"x\"}\n");
        // The loss itself may have found room that had just become free.
        assert!(reports.dropped >= 1);
        // A starter that reads again gets every queued report.
        let reading = std::thread::spawn(move || {
            BufReader::new(reader).lines().map_while(Result::ok).count()
        });
        drop(reports);
        assert!(reading.join().unwrap() >= WAITING);
    }
}
