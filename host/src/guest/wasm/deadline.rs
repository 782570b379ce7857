//! Wall-clock deadlines: a thread advances the engine's epoch while a call runs, and the guest traps when its time is over.

use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use wasmtime::{Engine, Store};

/// The epoch's period; a deadline is kept to about this.
const EPOCH: Duration = Duration::from_millis(1);

/// How long each call into a guest may take.
pub struct Deadline {
    allowed: Duration,
    control: Option<Sender<bool>>,
    ticker: Option<JoinHandle<()>>,
}

/// A running call; its end stops the ticker.
pub(super) struct Armed<'a> {
    deadline: &'a Deadline,
    started: Instant,
}

impl Deadline {
    /// A deadline of `allowed` for the guests of `engine`. Starts the ticker, which sleeps until a call runs.
    ///
    /// # Errors
    ///
    /// If the thread cannot be started.
    pub fn new(engine: &Engine, allowed: Duration) -> std::io::Result<Self> {
        let engine = engine.clone();
        let (control, commands) = mpsc::channel();
        let ticker = thread::Builder::new().name("gleaner-epoch".to_owned()).spawn(move || {
            let mut armed = false;
            loop {
                let command = if armed {
                    commands.recv_timeout(EPOCH)
                } else {
                    commands.recv().map_err(|_| RecvTimeoutError::Disconnected)
                };
                match command {
                    Ok(arm) => armed = arm,
                    Err(RecvTimeoutError::Timeout) => engine.increment_epoch(),
                    Err(RecvTimeoutError::Disconnected) => return,
                }
            }
        })?;
        Ok(Self { allowed, control: Some(control), ticker: Some(ticker) })
    }

    pub(super) fn arm<T>(&self, store: &mut Store<T>) -> Armed<'_> {
        // One more, since the first epoch may end at once.
        let epochs = self.allowed.as_nanos().div_ceil(EPOCH.as_nanos()) as u64 + 1;
        store.set_epoch_deadline(epochs);
        self.tell(true);
        Armed { deadline: self, started: Instant::now() }
    }

    fn tell(&self, armed: bool) {
        if let Some(control) = &self.control {
            // The ticker ends only with this sender.
            let _ = control.send(armed);
        }
    }
}

impl Drop for Deadline {
    fn drop(&mut self) {
        self.control = None;
        if let Some(ticker) = self.ticker.take() {
            let _ = ticker.join();
        }
    }
}

impl Armed<'_> {
    /// Nanoseconds since the call began, and those it was allowed.
    pub(super) fn elapsed_and_allowed(&self) -> (u64, u64) {
        (self.started.elapsed().as_nanos() as u64, self.deadline.allowed.as_nanos() as u64)
    }
}

impl Drop for Armed<'_> {
    fn drop(&mut self) {
        self.deadline.tell(false);
    }
}
