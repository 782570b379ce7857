//! Deadlines of components: a thread checks whether a call may be overdue, and then advances the
//! engine's epoch, at which the guest traps if the call has used its time.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use wasmtime::{Engine, Store, Trap, UpdateDeadline};

use super::Hosted;
use crate::api::call_time::CallTime;

/// Idle time after which the ticker sleeps until the next call. A lambda at 1 Hz wakes it with each
/// call, one at 100 Hz never: waking a thread costs a call more than the rest of hosting.
const IDLE: Duration = Duration::from_millis(500);

/// Value of [`TickerState::due`] while no call runs.
const NONE: u64 = 0;

/// Ends each call into a guest that exceeds its time.
pub struct Deadline {
    shared: Arc<TickerState>,
    ticker: Option<JoinHandle<()>>,
}

struct TickerState {
    base: Instant,
    /// Time of the first check of the current call, in ns since `base`.
    due: AtomicU64,
    /// Set while the ticker sleeps until it is woken.
    sleeps: AtomicBool,
    stop: AtomicBool,
}

pub(super) struct ArmedCall<'a> {
    deadline: &'a Deadline,
    pub(super) time: CallTime,
}

impl Deadline {
    /// A deadline for the guests of `engine`, whose limits are `shortest` or longer. Starts the
    /// ticker, which sleeps until a call runs.
    pub fn new(engine: &Engine, shortest: Duration) -> std::io::Result<Self> {
        let shared = Arc::new(TickerState {
            base: Instant::now(),
            due: AtomicU64::new(NONE),
            sleeps: AtomicBool::new(false),
            stop: AtomicBool::new(false),
        });
        let (engine, seen) = (engine.clone(), Arc::clone(&shared));
        let ticker = thread::Builder::new().name("gleaner-epoch".to_owned());
        let ticker = ticker.spawn(move || seen.tick(&engine, shortest))?;
        Ok(Self { shared, ticker: Some(ticker) })
    }

    /// Begins a call that may take `allowed`.
    pub(super) fn arm(&self, store: &mut Store<Hosted>, allowed: Duration) -> ArmedCall<'_> {
        let time = CallTime::begin(allowed);
        store.data_mut().call = Some(time);
        store.set_epoch_deadline(1);
        let due = time.first_check().duration_since(self.shared.base);
        self.shared.due.store((due.as_nanos() as u64).max(NONE + 1), Ordering::SeqCst);
        // Either the ticker sees the call before it sleeps, or this thread sees that it sleeps.
        if self.shared.sleeps.load(Ordering::SeqCst) {
            self.wake();
        }
        ArmedCall { deadline: self, time }
    }

    fn wake(&self) {
        if let Some(ticker) = &self.ticker {
            ticker.thread().unpark();
        }
    }
}

impl TickerState {
    fn tick(&self, engine: &Engine, shortest: Duration) {
        // With a check at least every half of the shortest limit, the ticker finds each call before
        // it is due, and sleeps exactly until then.
        let step = (shortest / 2).max(Duration::from_micros(500));
        let mut quiet = Instant::now();
        while !self.stop.load(Ordering::SeqCst) {
            let now = Instant::now();
            let due = self.due.load(Ordering::SeqCst);
            if due != NONE {
                quiet = now;
                let left = Duration::from_nanos(due).saturating_sub(now.duration_since(self.base));
                if left.is_zero() {
                    engine.increment_epoch();
                }
                // A call into the host ends by itself; the epoch is checked when it returns to the
                // guest. A guest that had to wait for a core has time left, and is checked again.
                thread::park_timeout(left.clamp(Duration::from_micros(500), step));
            } else if now.duration_since(quiet) < IDLE {
                thread::park_timeout(step);
            } else {
                self.sleeps.store(true, Ordering::SeqCst);
                if self.due.load(Ordering::SeqCst) == NONE && !self.stop.load(Ordering::SeqCst) {
                    thread::park();
                }
                self.sleeps.store(false, Ordering::SeqCst);
                quiet = Instant::now();
            }
        }
    }
}

/// Sets the callback of a guest at which the epoch advances: it traps only if its own call has no
/// time left, since the ticker may have meant an earlier one.
pub(super) fn check_time_at_epoch(store: &mut Store<Hosted>) {
    store.epoch_deadline_callback(|context| match context.data().call {
        Some(call) if !call.left(Duration::ZERO).is_zero() => Ok(UpdateDeadline::Continue(1)),
        _ => Err(Trap::Interrupt.into()),
    });
}

impl Drop for Deadline {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::SeqCst);
        self.wake();
        if let Some(ticker) = self.ticker.take() {
            let _ = ticker.join();
        }
    }
}

impl Drop for ArmedCall<'_> {
    fn drop(&mut self) {
        self.deadline.shared.due.store(NONE, Ordering::SeqCst);
    }
}
