//! Delivers the messages of a drive at their times.

use std::error::Error;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use gleaner_base::chain;
use tracing::warn;

use crate::drive::Replay;

#[derive(Default)]
pub(super) struct PlaybackState {
    progress: Mutex<PlaybackProgress>,
    stop: Condvar,
}

#[derive(Default)]
struct PlaybackProgress {
    stop: bool,
    ended: bool,
    damage: Option<String>,
}

impl PlaybackState {
    /// Ends the thread before its next message.
    pub(super) fn stop(&self) {
        self.lock().stop = true;
        self.stop.notify_all();
    }

    /// Notes the end of the drive, and the damage that caused it.
    pub(super) fn end(&self, damage: Option<String>) {
        let mut progress = self.lock();
        progress.ended = true;
        progress.damage = damage;
    }

    pub(super) fn has_ended(&self) -> bool {
        self.lock().ended
    }

    pub(super) fn damage(&self) -> Option<String> {
        self.lock().damage.clone()
    }

    /// Waits until `due`; returns false if the playback has to stop.
    fn wait_until(&self, due: Instant) -> bool {
        let mut progress = self.lock();
        while !progress.stop {
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return true;
            }
            let waited = self.stop.wait_timeout(progress, left);
            progress = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        false
    }

    fn lock(&self) -> MutexGuard<'_, PlaybackProgress> {
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

pub(super) struct Playback {
    drive: Replay,
    rate: f64,
    state: Arc<PlaybackState>,
}

impl Playback {
    pub(super) fn new(drive: Replay, rate: f64, state: Arc<PlaybackState>) -> Self {
        Self { drive, rate, state }
    }

    /// Plays to the end of the drive, or until it has to stop.
    pub(super) fn run(mut self) {
        let damage = self.play().err().map(|error| {
            warn!(error = &error as &dyn Error, "the drive ends early");
            chain(&error)
        });
        self.state.end(damage);
    }

    fn play(&mut self) -> Result<(), crate::ReplayError> {
        let mut first = None;
        while let Some(at_ns) = self.drive.peek_at_ns()? {
            let (start, from_ns) = *first.get_or_insert_with(|| (Instant::now(), at_ns));
            let since = u64::try_from(at_ns.saturating_sub(from_ns)).unwrap_or(0);
            let since = Duration::try_from_secs_f64(since as f64 / 1e9 / self.rate);
            // A time that no clock reaches: it is never due.
            let due = since.ok().and_then(|since| start.checked_add(since));
            let Some(due) = due else { return Ok(()) };
            if !self.state.wait_until(due) {
                return Ok(());
            }
            self.drive.step()?;
        }
        Ok(())
    }
}
