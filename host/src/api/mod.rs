//! What a lambda may do, written once, in plain Rust.
//!
//! Five of the files beside this one carry the names of the five WIT interfaces. WebAssembly
//! (`guest::wasm`) and Python (`host/python`) are thin skins over them: they convert arguments and
//! errors, and decide nothing. What is here knows neither.
//!
//! So each call does three things here: it is charged ([`fuel`]), before its work wherever that is
//! known; what takes long looks at the deadline as it goes (`call`); and a refusal says which one
//! of the WIT it is (`kind`). A call that only looks at a value costs what any call costs, which a
//! skin charges where it looks up what a handle stands for.

mod call;
pub mod curves;
pub mod data;
mod error;
mod field;
pub mod frame;
pub mod fuel;
mod images;
pub mod inference;
pub mod log;
mod piece;
pub mod relayed;
mod sample;
pub mod scratch;
pub mod trace;
pub mod trigger;
mod values;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_journal::Said;
use gleaner_lambda::Trigger;
use gleaner_lambda::manifest::{ConfigValue, Limits};

use data::{DataError, Due, Topic};
use field::FIELD_BYTES;
use fuel::{Fuel, OutOfFuel};
use log::{Line, Log};
use scratch::Scratch;
use trigger::Triggers;

/// What one lambda sees and causes, lent to its guest. One lock, held for the length of one call,
/// by one thread.
#[derive(Clone)]
pub struct Session {
    state: Arc<Mutex<State>>,
    fuel: Fuel,
}

struct State {
    inputs: Vec<Arc<Topic>>,
    config: Vec<(String, ConfigValue)>,
    now_ns: i64,
    triggers: Triggers<Trigger>,
    log: Log,
    scratch: Scratch,
    due: Option<Due>,
    backed_off: u64,
}

impl Session {
    /// A session over these inputs, in the manifest's order, and this configuration, within these
    /// limits.
    pub fn new(
        inputs: Vec<Arc<Topic>>,
        config: Vec<(String, ConfigValue)>,
        limits: &Limits,
    ) -> Self {
        // All inputs of a lambda have the same.
        let due = inputs.first().map(|topic| topic.due());
        let fuel = inputs.first().map(|topic| topic.fuel()).unwrap_or_default();
        let (triggers, log) = (Triggers::new(limits.events_per_minute), Log::new(limits));
        let scratch = Scratch::new(limits.scratch.bytes(), limits.call_bytes.as_usize());
        let state = State { inputs, config, now_ns: 0, triggers, log, scratch, due, backed_off: 0 };
        Self { state: Arc::new(Mutex::new(state)), fuel }
    }

    /// Begins a wake at `now_ns`: what an earlier wake left behind is dropped.
    pub fn begin(&self, now_ns: i64) {
        let mut state = self.lock();
        state.now_ns = now_ns;
        state.triggers.begin();
    }

    /// Ends a wake and takes what it caused, in the order of the calls.
    pub fn end(&self) -> Vec<Trigger> {
        self.lock().triggers.end()
    }

    /// Runs an `init`, which may come in the middle of a wake but is no part of it: it can cause
    /// nothing.
    pub fn during_init<R>(&self, init: impl FnOnce() -> R) -> R {
        let triggers = self.lock().triggers.suspend();
        let result = init();
        self.lock().triggers.resume(triggers);
        result
    }

    /// Takes the log lines written since the last call, and what a journal notes of them.
    pub fn take_log(&self) -> (Vec<Line>, Said) {
        self.lock().log.take()
    }

    /// Log lines dropped by the rate limit, since the start.
    pub fn log_dropped(&self) -> u64 {
        self.lock().log.dropped()
    }

    /// Triggers refused by the rate limit, since the start.
    pub fn triggers_refused(&self) -> u64 {
        self.lock().triggers.refused()
    }

    /// Counts a wake that did not happen, because the lambda had faulted again and again.
    pub fn pass_over(&self) {
        self.lock().backed_off += 1;
    }

    /// Wakes passed over, since the start.
    pub fn backed_off(&self) -> u64 {
        self.lock().backed_off
    }

    /// When calls of the lambda have to end; none without inputs, where no call takes long.
    pub fn due(&self) -> Option<Due> {
        self.lock().due.clone()
    }

    /// What calls of the lambda cost. Nothing, unless its guest begins an allowance.
    pub fn fuel(&self) -> &Fuel {
        &self.fuel
    }

    /// Time of this wake, in nanoseconds.
    pub fn now_ns(&self) -> i64 {
        self.lock().now_ns
    }

    /// The configuration, in the manifest's order.
    pub fn config(&self) -> Vec<(String, ConfigValue)> {
        self.lock().config.clone()
    }

    /// All inputs, in the manifest's order.
    pub fn inputs(&self) -> Vec<Arc<Topic>> {
        self.lock().inputs.clone()
    }

    /// Names of all inputs, in the manifest's order.
    ///
    /// # Errors
    ///
    /// [`OutOfFuel`].
    pub fn input_names(&self) -> Result<Vec<String>, OutOfFuel> {
        let state = self.lock();
        self.fuel.charge(|| state.inputs.len() * FIELD_BYTES)?;
        Ok(state.inputs.iter().map(|topic| topic.name().to_owned()).collect())
    }

    /// The input of that name.
    ///
    /// # Errors
    ///
    /// [`DataError::NoSuchInput`] names those that exist; [`DataError::OutOfFuel`].
    pub fn input(&self, name: &str) -> Result<Arc<Topic>, DataError> {
        self.fuel.charge(|| name.len())?;
        let state = self.lock();
        let found = state.inputs.iter().find(|topic| topic.name() == name);
        found.cloned().ok_or_else(|| DataError::NoSuchInput {
            asked: name.to_owned(),
            known: state.inputs.iter().map(|topic| topic.name().to_owned()).collect(),
        })
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // No call leaves the state half changed, so a poisoned lock holds nothing worse than a
        // shorter list.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
