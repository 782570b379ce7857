//! The session of a run: its inputs, models, triggers, log and scratch memory, and the thread-local
//! through which the functions of the SDK reach it.

use std::any::Any;
use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_rules::log::line;
use gleaner_rules::refused;
use gleaner_rules::scratch::Scratch;
use gleaner_rules::triggers::Triggers;
use gleaner_rules::units::size_in_words;

use super::data::InputState;
use super::decision::{Fault, FaultKind, Trigger};
use super::inference::ModelTable;
use super::log::Log;
use super::manifest::Limits;

/// The session of a run. It survives faults: a fresh instance of the lambda finds it unchanged.
pub(crate) struct Session {
    limits: Limits,
    pub(super) inputs: Vec<Arc<InputState>>,
    pub(super) models: ModelTable,
    state: Mutex<SessionState>,
}

pub(super) struct SessionState {
    pub(super) now_ns: i64,
    pub(super) triggers: Triggers<Trigger>,
    pub(super) log: Log,
    pub(super) scratch: Scratch,
    pub(super) backed_off: u64,
}

impl Session {
    pub(super) fn new(
        limits: Limits,
        inputs: Vec<Arc<InputState>>,
        models: ModelTable,
    ) -> Arc<Self> {
        let (triggers, log) = (Triggers::new(limits.events_per_minute), Log::new(&limits));
        let scratch = Scratch::new(limits.scratch, limits.per_call.bytes);
        let state = Mutex::new(SessionState { now_ns: 0, triggers, log, scratch, backed_off: 0 });
        Arc::new(Self { limits, inputs, models, state })
    }

    pub(super) fn limits(&self) -> &Limits {
        &self.limits
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, SessionState> {
        // A lambda that panics in a call leaves the state consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Ends the lambda if it passes more bytes in one call than `call_bytes` in `[limits]`, as the
    /// host ends a component.
    pub(super) fn check_bytes(&self, bytes: usize) {
        let allowed = self.limits.per_call.bytes;
        if bytes > allowed {
            let what = "too much data is being copied between the host and the guest";
            let message = format!("{what}: at most {} in one call", size_in_words(allowed as u64));
            end(Fault {
                kind: FaultKind::HostCall,
                message,
                used: None,
                allowed: Some(allowed as u64),
            });
        }
    }

    /// Runs code that is not part of a wake, though it may run in the middle of one: `init`, or the
    /// `drop` of a lambda. Triggers are refused meanwhile.
    pub(super) fn without_triggers<R>(&self, run: impl FnOnce() -> R) -> R {
        let triggers = self.lock().triggers.suspend();
        let result = run();
        self.lock().triggers.resume(triggers);
        result
    }
}

thread_local! {
    /// The session of the lambda that runs on this thread.
    static CURRENT: RefCell<Option<Arc<Session>>> = const { RefCell::new(None) };
}

/// Returns the session of the calling lambda.
///
/// # Panics
///
/// If no lambda runs on this thread.
pub(super) fn current() -> Arc<Session> {
    CURRENT.with_borrow(Clone::clone).unwrap_or_else(|| {
        panic!(
            "no host is running on this thread: natively, gleaner_sdk calls the fake host of \
             gleaner_sdk::testing, and only while it runs a lambda; load the lambda with \
             testing::Host, or test functions that do not call the host"
        )
    })
}

/// Calls code of the lambda in `session`. An error or a panic is a fault, whose message begins with
/// `when`.
pub(super) fn attempt<R>(
    session: &Arc<Session>,
    when: &str,
    call: impl FnOnce() -> crate::Result<R>,
) -> Result<R, Fault> {
    struct Back(Option<Arc<Session>>);
    impl Drop for Back {
        fn drop(&mut self) {
            CURRENT.set(self.0.take());
        }
    }
    let _back = Back(CURRENT.replace(Some(Arc::clone(session))));
    let plain = |kind, message: &str| {
        let message = format!("{when}{}", line(message));
        Fault { kind, message, used: None, allowed: None }
    };
    match catch_unwind(AssertUnwindSafe(call)) {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(error)) => Err(plain(FaultKind::Exception, &error.to_string())),
        Err(panic) => Err(match panic.downcast::<Fault>() {
            Ok(fault) => Fault { message: format!("{when}{}", fault.message), ..*fault },
            Err(panic) => plain(FaultKind::Trap, &format!("panicked: {}", panic_text(&*panic))),
        }),
    }
}

/// Ends the lambda from within a call. The panic hook does not run, so nothing is printed.
fn end(fault: Fault) -> ! {
    resume_unwind(Box::new(fault))
}

fn panic_text(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("the panic has no message")
}

/// Counts the samples, frames, tensors and other objects that a lambda holds, up to a limit.
pub(crate) struct HandleCounter {
    held: AtomicU64,
    allowed: u64,
}

/// One held object, counted until dropped.
pub(crate) struct Handle(Arc<HandleCounter>);

impl HandleCounter {
    pub(super) fn new(limits: &Limits) -> Arc<Self> {
        Arc::new(Self { held: AtomicU64::new(0), allowed: limits.handles })
    }

    /// Counts one more object. Ends the lambda if it would exceed the limit.
    pub(super) fn acquire(self: &Arc<Self>) -> Handle {
        let held = self.held.fetch_add(1, Ordering::Relaxed);
        let handle = Handle(Arc::clone(self));
        let allowed = self.allowed;
        if held >= allowed {
            let message = refused::too_many_handles(allowed);
            drop(handle);
            end(Fault {
                kind: FaultKind::HostCall,
                message,
                used: Some(allowed + 1),
                allowed: Some(allowed),
            });
        }
        handle
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        self.0.held.fetch_sub(1, Ordering::Relaxed);
    }
}
