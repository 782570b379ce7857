//! Notes the models that are being loaded and run, for the starter: if this process dies, it reads
//! there which one to blame. Also limits the time that a model may take.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::backend::StopSignal;

/// Time for an overdue run to end after its backend was notified.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);

/// Length of a note: the hexadecimal digits of SHA-256.
const NOTE_BYTES: usize = 64;

/// Kind of work, and with it the place of its note in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum WorkKind {
    /// The model is being loaded, at the first place of the file.
    Load,
    /// The model runs, at the second one.
    Run,
}

#[derive(Debug, Clone)]
pub(crate) struct ModelWork {
    /// SHA-256 of the file.
    pub(crate) sha256: String,
    pub(crate) path: String,
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
    kind: WorkKind,
    file: Option<Arc<File>>,
    work: Arc<Mutex<Option<ModelWork>>>,
}

impl WorkNote {
    /// Creates the note of a thread. Without a file, only the time is limited.
    pub(crate) fn new(kind: WorkKind, file: Option<Arc<File>>) -> Self {
        Self { kind, file, work: Arc::default() }
    }

    pub(crate) fn begin(&self, work: ModelWork) {
        let mut note = [0; NOTE_BYTES];
        let digits = work.sha256.as_bytes();
        let length = digits.len().min(NOTE_BYTES);
        note[..length].copy_from_slice(&digits[..length]);
        self.write(&note);
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
        self.write(&[0; NOTE_BYTES]);
    }

    pub(crate) fn is_busy(&self) -> bool {
        self.lock().is_some()
    }

    /// Returns the work in progress if it takes too long and cannot be interrupted.
    pub(crate) fn overdue(&self, now: Instant) -> Option<ModelWork> {
        let mut work = self.lock();
        let overdue = work.as_mut().filter(|work| work.until <= now)?;
        if overdue.stop.stop() {
            overdue.until = now + STOP_TIMEOUT;
            return None;
        }
        Some(overdue.clone())
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Option<ModelWork>> {
        self.work.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self, note: &[u8; NOTE_BYTES]) {
        let offset = match self.kind {
            WorkKind::Load => 0,
            WorkKind::Run => NOTE_BYTES as u64,
        };
        if let Some(file) = &self.file
            && let Err(error) = file.write_all_at(note, offset)
        {
            // The starter then blames no model.
            tracing::debug!(%error, "cannot note the model in use");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_is_noted_while_it_lasts_and_is_overdue_after_its_limit() {
        let file = Arc::new(tempfile::tempfile().unwrap());
        let (load, run) = (
            WorkNote::new(WorkKind::Load, Some(Arc::clone(&file))),
            WorkNote::new(WorkKind::Run, Some(Arc::clone(&file))),
        );
        let read = || {
            let mut text = [b'?'; 128];
            file.read_at(&mut text, 0).unwrap();
            text.map(|byte| if byte == 0 { b'-' } else { byte })
        };
        let (now, limit) = (Instant::now(), Duration::from_secs(60));
        let work = |digit: &str| ModelWork {
            sha256: digit.repeat(64),
            path: String::new(),
            lambdas: Vec::new(),
            until: now + limit,
            limit,
            stop: Arc::default(),
        };
        run.begin(work("b"));
        load.begin(work("a"));
        assert_eq!(read()[..], ["a".repeat(64), "b".repeat(64)].concat().as_bytes()[..]);
        assert!(run.is_busy() && run.overdue(now).is_none());
        assert!(run.overdue(now + limit).is_some_and(|work| work.sha256.starts_with('b')));
        run.limit(Duration::ZERO);
        assert!(run.overdue(Instant::now()).is_some());
        let interruptible = work("b");
        interruptible.stop.on_stop(|| {});
        run.begin(interruptible);
        let late = now + limit;
        assert!(run.overdue(late).is_none(), "it is interrupted");
        assert!(run.overdue(late).is_none(), "it has a while to end");
        assert!(run.overdue(late + STOP_TIMEOUT).is_some());
        load.end();
        assert_eq!(read()[..], ["-".repeat(64), "b".repeat(64)].concat().as_bytes()[..]);
        run.end();
        assert!(!run.is_busy() && read() == [b'-'; 128]);
    }
}
