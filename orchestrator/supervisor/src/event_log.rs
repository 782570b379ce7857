//! Writes the events of a vehicle to a spool, in a thread: a disk that is slow or full delays
//! nothing else.

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
use gleaner_spool::{BootId, SpoolConfig, SpoolTime, SpoolWriter};

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
    /// Opens the spool `stream` in the folder `spool`.
    ///
    /// # Errors
    ///
    /// A failure that names the folder.
    pub fn open(spool: &Path, stream: &str) -> Result<Self, Failure> {
        let cannot =
            |error: &dyn std::error::Error| Failure::caused_by(Exit::Internal, "cannot log", error);
        let boot = BootId::current().map_err(|error| cannot(&error))?;
        let config = SpoolConfig { stream: stream.to_owned(), boot, budget: BUDGET };
        let writer = SpoolWriter::open(&spool.join(stream), config)
            .map_err(|error| Failure::because("cannot open the log of events", &error))?;
        let (events, queue) = sync_channel(QUEUE);
        let lost = Arc::new(AtomicU64::new(0));
        let counted = Arc::clone(&lost);
        let thread = Builder::new().name("events".to_owned());
        let thread =
            thread.spawn(move || write(writer, &queue, &counted)).map_err(|it| cannot(&it))?;
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
fn write(mut writer: SpoolWriter, queue: &Receiver<(SpoolTime, Vec<u8>)>, lost: &AtomicU64) {
    let mut is_failing = false;
    loop {
        // What could not be written waits in the spool's own queue.
        let first = match is_failing {
            true => queue.recv_timeout(RETRY),
            false => queue.recv().map_err(|_| RecvTimeoutError::Disconnected),
        };
        if first == Err(RecvTimeoutError::Disconnected) {
            let _ = writer.commit();
            return;
        }
        for (time, text) in first.into_iter().chain(queue.try_iter()) {
            // A gap record marks one that is refused.
            let refused = writer.append(EVENT, time, &text).is_err();
            lost.fetch_add(u64::from(refused), Ordering::Relaxed);
        }
        let committed = writer.commit();
        if let Err(error) = &committed
            && !is_failing
        {
            let text = format!("events are not durable, and tried again: {}", chain(error));
            let _ = writeln!(std::io::stderr(), "{text}");
        }
        is_failing = committed.is_err();
    }
}
