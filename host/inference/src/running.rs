//! Notes the models that are being loaded and run, for the starter: if this process dies, it reads
//! there which one to blame. Also limits the time that a model may take.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use gleaner_protocol::inference::NOTE_BYTES;

use crate::backend::StopSignal;
use crate::memory;

/// Time for an overdue run to end after its backend was notified.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);

#[derive(Debug, Clone)]
pub(crate) struct ModelWork {
    /// SHA-256 of the file, and while it runs, a space and the identity of the lambda.
    pub(crate) note: String,
    pub(crate) path: String,
    /// Memory that the model has taken already, in bytes.
    pub(crate) held: u64,
    /// Names of the lambdas that requested it.
    pub(crate) lambdas: Vec<String>,
    /// Time at which it is overdue.
    pub(crate) until: Instant,
    /// The limit, for messages.
    pub(crate) limit: Duration,
    /// Ends the run, if the backend can be interrupted.
    pub(crate) stop: Arc<StopSignal>,
}

/// The work of one thread, noted in the file while it lasts.
#[derive(Debug, Clone)]
pub(crate) struct WorkNote {
    /// Place of its note: 0 for the load.
    place: usize,
    file: Option<Arc<File>>,
    work: Arc<Mutex<Option<ModelWork>>>,
}

impl WorkNote {
    /// Creates the note of a thread. Without a file, only the time is limited.
    pub(crate) fn new(place: usize, file: Option<Arc<File>>) -> Self {
        Self { place, file, work: Arc::default() }
    }

    pub(crate) fn begin(&self, work: ModelWork) {
        let is_short = memory::is_short(memory::RUN_PART, work.held);
        self.write(&if is_short { work.note.clone() + "\n" } else { work.note.clone() });
        *self.lock() = Some(work);
    }

    /// Begins another part of the same work, with a limit of its own.
    pub(crate) fn limit(&self, limit: Duration) {
        if let Some(work) = self.lock().as_mut() {
            (work.until, work.limit) = (Instant::now() + limit, limit);
        }
    }

    pub(crate) fn end(&self) {
        *self.lock() = None;
        self.write("");
    }

    pub(crate) fn is_busy(&self) -> bool {
        self.lock().is_some()
    }

    /// Returns the work in progress if it takes too long and cannot be interrupted. It is the only
    /// one that is noted then, as this process has to end.
    pub(crate) fn overdue(&self, now: Instant) -> Option<ModelWork> {
        let mut work = self.lock();
        let overdue = work.as_mut().filter(|work| work.until <= now)?;
        if overdue.stop.stop() {
            overdue.until = now + STOP_TIMEOUT;
            return None;
        }
        if let Some(file) = &self.file {
            // If it fails, the starter charges none of several models.
            let _ = file.set_len(0);
        }
        self.write(&overdue.note);
        Some(overdue.clone())
    }

    fn write(&self, text: &str) {
        let mut note = text.as_bytes().to_vec();
        note.resize(NOTE_BYTES, 0);
        if let Some(file) = &self.file
            && let Err(error) = file.write_all_at(&note, (self.place * NOTE_BYTES) as u64)
        {
            // The starter then blames no model.
            tracing::debug!(%error, "cannot note the model in use");
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Option<ModelWork>> {
        self.work.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use gleaner_protocol::inference::models_in_use;

    use super::*;

    #[test]
    fn work_is_noted_while_it_lasts_and_alone_once_it_is_overdue() {
        let file = Arc::new(tempfile::tempfile().unwrap());
        let [load, run] = [0, 2].map(|place| WorkNote::new(place, Some(Arc::clone(&file))));
        let limit = Duration::from_secs(60);
        let now = Instant::now();
        let work = |note: &str| ModelWork {
            note: note.to_owned(),
            path: String::new(),
            held: 0,
            lambdas: Vec::new(),
            until: now + limit,
            limit,
            stop: Arc::default(),
        };
        run.begin(work("b front"));
        load.begin(work("a"));
        assert_eq!(models_in_use(&file), ["a", "b front"]);
        assert!(run.is_busy() && run.overdue(now).is_none());
        let interruptible = work("b front");
        interruptible.stop.on_stop(|| {});
        run.begin(interruptible);
        let late = now + limit;
        assert!(run.overdue(late).is_none(), "it is interrupted");
        assert!(run.overdue(late).is_none(), "it has a while to end");
        load.end();
        assert_eq!(models_in_use(&file), ["b front"]);
        load.begin(work("a"));
        assert!(run.overdue(late + STOP_TIMEOUT).is_some_and(|work| work.note == "b front"));
        assert_eq!(models_in_use(&file), ["b front"], "it is the cause of the end");
        run.end();
        assert!(!run.is_busy() && models_in_use(&file).is_empty());
    }
}
