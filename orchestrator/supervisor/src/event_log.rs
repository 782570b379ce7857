//! Writes the events of a vehicle to a spool, in a thread: a disk that is slow or full delays
//! nothing else, and a spool that cannot be opened keeps no program from starting.

use std::io::Write;
use std::num::NonZeroU8;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::{Builder, JoinHandle};
use std::time::Duration;

use gleaner_base::{ByteSize, Exit, Failure, chain};
use gleaner_protocol::supervision::VehicleEvent;
use gleaner_spool::{BootId, SpoolConfig, SpoolError, SpoolTime, SpoolWriter};

/// Kind of the records: JSON of a [`VehicleEvent`].
const EVENT: NonZeroU8 = NonZeroU8::MIN;
/// Maximum size of the spool.
const BUDGET: ByteSize = ByteSize::mib(16);
/// Number of events that may wait for the disk.
const QUEUE: usize = 1024;
/// Interval of attempts to write events that could not be made durable.
const RETRY: Duration = Duration::from_secs(1);

/// The log. Dropping it waits for the events that it has.
pub struct EventLog {
    events: Option<SyncSender<(SpoolTime, Vec<u8>)>>,
    lost: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl EventLog {
    /// Opens the spool `stream` in the folder `spool`. Until that succeeds, it is tried again, and
    /// events are lost and counted.
    ///
    /// # Errors
    ///
    /// A failure that names the folder if another program writes to it.
    pub fn open(spool: &Path, stream: &str) -> Result<Self, Failure> {
        let cannot =
            |error: &dyn std::error::Error| Failure::caused_by(Exit::Internal, "cannot log", error);
        let boot = BootId::current().map_err(|error| cannot(&error))?;
        let config = SpoolConfig { stream: stream.to_owned(), boot, budget: BUDGET };
        let path = spool.join(stream);
        let open = move || SpoolWriter::open(&path, config.clone());
        let writer = open();
        if let Err(error @ SpoolError::Busy { .. }) = &writer {
            return Err(Failure::because("cannot open the log of events", error));
        }
        let (events, queue) = sync_channel(QUEUE);
        let lost = Arc::new(AtomicU64::new(0));
        let counted = Arc::clone(&lost);
        let thread = Builder::new().name("events".to_owned());
        let thread = thread.spawn(move || write(&open, writer, &queue, &counted));
        let thread = thread.map_err(|it| cannot(&it))?;
        Ok(Self { events: Some(events), lost, thread: Some(thread) })
    }

    /// Adds an event. It is counted as lost if too many wait for the disk.
    pub fn add(&self, event: &VehicleEvent) {
        let text = serde_json::to_vec(event).expect("an event is plain data");
        let sent = self.events.as_ref().map(|events| events.try_send((SpoolTime::now(), text)));
        if sent.is_some_and(|sent| sent.is_err()) {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Returns the number of events that were not made durable.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }
}

impl Drop for EventLog {
    fn drop(&mut self) {
        self.events = None;
        if let Some(thread) = self.thread.take() {
            // It has reported a panic already.
            let _ = thread.join();
        }
    }
}

/// Writes events until the other end of `queue` is dropped. All that wait become durable together.
fn write(
    open: &dyn Fn() -> Result<SpoolWriter, SpoolError>,
    mut writer: Result<SpoolWriter, SpoolError>,
    queue: &Receiver<(SpoolTime, Vec<u8>)>,
    lost: &AtomicU64,
) {
    let mut is_failing = false;
    loop {
        // What could not be written waits in the spool's own queue.
        let first = match is_failing {
            true => queue.recv_timeout(RETRY),
            false => queue.recv().map_err(|_| RecvTimeoutError::Disconnected),
        };
        if first == Err(RecvTimeoutError::Disconnected) {
            let _ = writer.map(|mut writer| writer.commit());
            return;
        }
        writer = writer.or_else(|_| open());
        for (time, text) in first.into_iter().chain(queue.try_iter()) {
            // A gap record marks one that is refused.
            let refused = !writer.as_mut().is_ok_and(|it| it.append(EVENT, time, &text).is_ok());
            lost.fetch_add(u64::from(refused), Ordering::Relaxed);
        }
        let error = match &mut writer {
            Ok(it) => it.commit().err().map(|it| format!("not durable yet: {}", chain(&it))),
            Err(error) => Some(format!("lost until the spool can be opened: {}", chain(error))),
        };
        if let Some(error) = error.as_ref().filter(|_| !is_failing) {
            let _ = writeln!(std::io::stderr(), "events are {error}");
        }
        is_failing = error.is_some();
    }
}

#[cfg(test)]
mod tests {
    use gleaner_protocol::supervision::EventKind;
    use gleaner_spool::SpoolReader;

    use super::*;

    #[test]
    fn events_are_lost_and_counted_until_the_spool_can_be_opened() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("events");
        std::fs::write(&path, "no folder").unwrap();
        let log = EventLog::open(scratch.path(), "events").unwrap();
        let (event, text) = (EventKind::Started, "the supervisor has started".to_owned());
        let event = VehicleEvent { event, lambda: None, revision: None, text };
        log.add(&event);
        let added = std::time::Instant::now();
        while log.lost() == 0 {
            assert!(added.elapsed() < Duration::from_secs(60), "no event was counted as lost");
            std::thread::yield_now();
        }
        std::fs::remove_file(&path).unwrap();
        log.add(&event);
        drop(log);
        assert_eq!(SpoolReader::open(&path, "events", None).unwrap().count(), 1);
    }
}
