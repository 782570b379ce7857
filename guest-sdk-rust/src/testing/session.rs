//! What one lambda sees and causes for as long as a run lasts, and how the functions of the SDK
//! find it.

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

use super::data::Source;
use super::decision::{Fault, FaultKind, Trigger};
use super::log::Log;
use super::manifest::Limits;

/// The session of a run: a lambda that is made anew finds it as it was.
pub(crate) struct Session {
    limits: Limits,
    pub(super) inputs: Vec<Arc<Source>>,
    state: Mutex<State>,
}

pub(super) struct State {
    pub(super) now_ns: i64,
    pub(super) triggers: Triggers<Trigger>,
    pub(super) log: Log,
    pub(super) scratch: Scratch,
    pub(super) backed_off: u64,
}

impl Session {
    pub(super) fn new(limits: Limits, inputs: Vec<Arc<Source>>) -> Arc<Self> {
        let (triggers, log) = (Triggers::new(limits.events_per_minute), Log::new(&limits));
        let scratch = Scratch::new(limits.scratch, limits.per_call.bytes);
        let state = Mutex::new(State { now_ns: 0, triggers, log, scratch, backed_off: 0 });
        Arc::new(Self { limits, inputs, state })
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        // A lambda that panics in a call leaves nothing half done.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The lambda passes so many bytes in one call. More than `call_bytes` of `[limits]` end it, as
    /// they end a component.
    pub(super) fn passed(&self, bytes: usize) {
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

    /// Runs an `init`, or drops a lambda: in the middle of a wake maybe, but no part of it. It can
    /// cause nothing.
    pub(super) fn aside<R>(&self, run: impl FnOnce() -> R) -> R {
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

/// The session of the lambda that calls.
///
/// # Panics
///
/// If none runs on this thread.
pub(super) fn current() -> Arc<Session> {
    CURRENT.with_borrow(Clone::clone).unwrap_or_else(|| {
        panic!(
            "no host is running here: natively, calls of gleaner_sdk reach the fake host of gleaner_sdk::testing, and only while \
             it runs a lambda; load the lambda with testing::Host, or keep what is tested in functions that call no host"
        )
    })
}

/// Calls code of the lambda over `session`. An error is a fault, and so is a panic; both are said
/// with `when` before them.
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
            Err(panic) => plain(FaultKind::Trap, &format!("panicked: {}", said(&*panic))),
        }),
    }
}

/// Ends the lambda from within a call. It is no panic, so no hook prints it.
fn end(fault: Fault) -> ! {
    resume_unwind(Box::new(fault))
}

fn said(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("it did not say why")
}

/// How many samples, frames, fields and topics a lambda may hold, and holds.
pub(crate) struct Handles {
    held: AtomicU64,
    allowed: u64,
}

/// One of them, given back when dropped.
pub(crate) struct Handle(Arc<Handles>);

impl Handles {
    pub(super) fn new(limits: &Limits) -> Arc<Self> {
        Arc::new(Self { held: AtomicU64::new(0), allowed: limits.handles })
    }

    /// One more; the lambda ends where it has as many as it may.
    pub(super) fn hand_out(self: &Arc<Self>) -> Handle {
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
