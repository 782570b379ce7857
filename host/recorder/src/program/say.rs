//! Reports to the starter, and losses to their file, by a thread of their own: the starter may be slow to read.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::time::Duration;

use gleaner_protocol::link::{Loss, RecorderReport};
use tracing::{error, warn};

/// Reports that wait. Those of clips are few; of status, one more or less does not matter.
const WAITING: usize = 1024;

/// How long a starter is waited for that does not read.
const PATIENCE: Duration = Duration::from_secs(2);

/// Says things without waiting.
pub(super) struct Say {
    reports: SyncSender<RecorderReport>,
    /// Nothing comes over it; it closes when the thread has ended.
    ended: Receiver<()>,
    /// Reports for which there was no room. Clips and losses stand in their files all the same.
    left_out: u64,
}

impl Say {
    pub(super) fn start(to: File, losses: PathBuf) -> std::io::Result<Say> {
        let (reports, inbox) = sync_channel(WAITING);
        let (ends, ended) = sync_channel::<()>(1);
        std::thread::Builder::new().name("reports".to_owned()).spawn(move || {
            write(to, &losses, &inbox);
            drop(ends);
        })?;
        Ok(Say { reports, ended, left_out: 0 })
    }

    pub(super) fn say(&mut self, report: RecorderReport) {
        match self.reports.try_send(report) {
            Ok(()) | Err(TrySendError::Disconnected(_)) => {}
            Err(TrySendError::Full(_)) => {
                self.left_out += 1;
                if self.left_out == 1 {
                    warn!("the starter does not read reports: some are left out");
                }
            }
        }
    }

    /// Says the last thing, and waits until all is said; not for a starter that does not read.
    pub(super) fn end(mut self, report: RecorderReport) {
        self.say(report);
        drop(self.reports);
        let _ = self.ended.recv_timeout(PATIENCE);
    }
}

fn write(mut to: File, losses: &PathBuf, reports: &Receiver<RecorderReport>) {
    let mut is_read = true;
    for report in reports {
        if let RecorderReport::Loss(loss) = &report {
            note(losses, loss);
        }
        let mut line = serde_json::to_vec(&report).expect("a report is plain data");
        line.push(b'\n');
        // Losses are noted even if nobody reads.
        is_read = is_read && to.write_all(&line).is_ok();
    }
}

/// A clip that was deleted is noted by whoever deletes it, before.
fn note(path: &PathBuf, loss: &Loss) {
    if matches!(loss, Loss::Deleted { .. }) {
        return;
    }
    let mut line = serde_json::to_vec(loss).expect("a loss is plain data");
    line.push(b'\n');
    let file = OpenOptions::new().append(true).create(true).open(path);
    if let Err(why) = file.and_then(|mut file| file.write_all(&line)) {
        error!(path = %path.display(), error = %why, "cannot note a loss");
    }
}
