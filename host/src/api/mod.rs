//! The API of lambdas, written once, in plain Rust.
//!
//! Five of the files beside this one carry the names of the five WIT interfaces. WebAssembly
//! (`guest::wasm`) and Python (`host/python`) are thin skins over them: they convert arguments and
//! errors, and decide nothing. This room depends on neither.
//!
//! So each call does three things here. It is charged ([`fuel`]), before its work if the work is
//! known by then. Long work checks the deadline as it proceeds (`call`, by the rule of
//! [`call_time`]). And an error names its case in the WIT (`kind`). A call that only reads a value
//! has the base price, which a skin charges when it resolves the handle.

mod call;
pub mod call_time;
pub mod curves;
pub mod data;
mod error;
mod field;
pub mod frame;
pub mod fuel;
mod images;
pub mod inference;
pub(crate) mod live_layout;
pub mod log;
mod look_back;
pub mod models;
pub mod relayed;
mod sample;
pub mod scratch;
mod shared_bytes;
mod tensor;
pub mod trace;
pub mod trigger;
mod values;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_journal::LogDigest;
use gleaner_lambda::Trigger;
use gleaner_lambda::manifest::{ConfigValue, Limits};

use call::PerCall;
use data::{DataError, Due, Topic};
use field::FIELD_BYTES;
use fuel::{Fuel, OutOfFuel};
use gleaner_rules::frames::Budget;
use log::{Log, LogLine};
use models::Models;
use scratch::Scratch;
use tensor::TensorLimits;
use trigger::Triggers;

/// Inputs, triggers, log and scratch of one lambda, shared with its guest. One lock, held for the
/// length of one call, by one thread.
#[derive(Clone)]
pub struct Session {
    state: Arc<Mutex<SessionState>>,
    fuel: Fuel,
    models: Models,
    tensors: TensorLimits,
}

struct SessionState {
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
    /// A session over `inputs`, in the manifest's order, with `config`, within `limits`.
    pub fn new(
        inputs: Vec<Arc<Topic>>,
        config: Vec<(String, ConfigValue)>,
        limits: &Limits,
    ) -> Self {
        // All inputs of a lambda share them.
        let due = inputs.first().map(|topic| topic.due());
        let fuel = inputs.first().map(|topic| topic.fuel()).unwrap_or_default();
        let tensors = match inputs.first() {
            Some(topic) => topic.tensor_limits(),
            None => TensorLimits {
                per_call: PerCall::new(limits),
                budget: Budget::new(
                    usize::try_from(limits.frames).unwrap_or(usize::MAX),
                    limits.memory.as_usize(),
                ),
            },
        };
        let (triggers, log) = (Triggers::new(limits.events_per_minute), Log::new(limits));
        let scratch = Scratch::new(limits.scratch.bytes(), limits.call_bytes.as_usize());
        let state =
            SessionState { inputs, config, now_ns: 0, triggers, log, scratch, due, backed_off: 0 };
        let state = Arc::new(Mutex::new(state));
        Self { state, fuel, models: Models::default(), tensors }
    }

    #[must_use]
    pub fn with_models(self, models: Models) -> Self {
        Self { models, ..self }
    }

    pub fn models(&self) -> &Models {
        &self.models
    }

    pub fn tensors(&self) -> &TensorLimits {
        &self.tensors
    }

    /// Begins a wake at `now_ns`, and drops triggers of an earlier one.
    pub fn begin(&self, now_ns: i64) {
        let mut state = self.lock();
        state.now_ns = now_ns;
        state.triggers.begin();
        self.models.begin();
    }

    /// Ends a wake and returns its triggers, in the order of the calls.
    pub fn end(&self) -> Vec<Trigger> {
        self.lock().triggers.end()
    }

    /// Runs an `init`, which may happen during a wake but is no part of it: it cannot trigger.
    pub fn during_init<R>(&self, init: impl FnOnce() -> R) -> R {
        let triggers = self.lock().triggers.suspend();
        let result = init();
        self.lock().triggers.resume(triggers);
        result
    }

    /// Takes the log lines written since the last call, and their digest for the journal.
    pub fn take_log(&self) -> (Vec<LogLine>, LogDigest) {
        self.lock().log.take()
    }

    /// Number of log lines dropped by the rate limit, since the start.
    pub fn log_dropped(&self) -> u64 {
        self.lock().log.dropped()
    }

    /// Number of triggers refused by the rate limit, since the start.
    pub fn triggers_refused(&self) -> u64 {
        self.lock().triggers.refused()
    }

    /// Counts a wake that was skipped because the lambda backs off after faults.
    pub fn count_backed_off(&self) {
        self.lock().backed_off += 1;
    }

    /// Number of wakes skipped by back-off, since the start.
    pub fn backed_off(&self) -> u64 {
        self.lock().backed_off
    }

    /// Returns the error of a lambda that keeps too many samples, if samples could not be read
    /// since the last call for that reason.
    pub fn take_refused_holds(&self) -> Option<DataError> {
        let state = self.lock();
        // Each topic is asked, so that none reports the same samples again.
        state.inputs.iter().fold(None, |found, topic| topic.take_refused_holds().or(found))
    }

    /// Due time of the lambda's calls; `None` without inputs, where no call is long.
    pub fn due(&self) -> Option<Due> {
        self.lock().due.clone()
    }

    /// Fuel account of the lambda's calls. Nothing is charged unless its guest begins an allowance.
    pub fn fuel(&self) -> &Fuel {
        &self.fuel
    }

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
    pub fn input_names(&self) -> Result<Vec<String>, OutOfFuel> {
        let state = self.lock();
        self.fuel.charge(|| state.inputs.len() * FIELD_BYTES)?;
        Ok(state.inputs.iter().map(|topic| topic.name().to_owned()).collect())
    }

    /// The input of that name.
    ///
    /// # Errors
    ///
    /// [`DataError::NoSuchInput`], which names the existing inputs; [`DataError::OutOfFuel`].
    pub fn input(&self, name: &str) -> Result<Arc<Topic>, DataError> {
        self.fuel.charge(|| name.len())?;
        let state = self.lock();
        let found = state.inputs.iter().find(|topic| topic.name() == name);
        found.cloned().ok_or_else(|| DataError::NoSuchInput {
            asked: name.to_owned(),
            known: state.inputs.iter().map(|topic| topic.name().to_owned()).collect(),
        })
    }

    fn lock(&self) -> MutexGuard<'_, SessionState> {
        // No call leaves the state half changed: after a panic, a list may be shorter at worst.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
