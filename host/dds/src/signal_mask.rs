//! Blocks signals on the threads of RustDDS, which end for good at the first wait that is
//! interrupted (`src/rtps/dp_event_loop.rs`, `event_loop`; `src/discovery/discovery.rs`,
//! `discovery_event_loop`).
//!
//! Even a signal without a handler interrupts a wait: an ignored SIGCHLD is delivered to another
//! thread while the first one is about to start a process. A stop of the whole process (SIGSTOP, a
//! debugger, a frozen container, suspend) cannot be blocked;
//! [`Health::dead`](gleaner_messages::transport::Health::dead) reports its effect.

use nix::sys::signal::{SigSet, SigmaskHow, Signal};

/// While it lives, this thread takes no signals, and neither do, as long as they live, the threads
/// that it starts meanwhile.
pub(super) struct SignalMask(SigSet);

/// Signals for a thread's own faults: blocked, they would end the process without a message.
const FAULTS: [Signal; 4] = [Signal::SIGSEGV, Signal::SIGBUS, Signal::SIGILL, Signal::SIGFPE];

impl SignalMask {
    pub(super) fn block() -> Self {
        let mut others = SigSet::all();
        FAULTS.into_iter().for_each(|signal| others.remove(signal));
        // It fails only for an invalid way of setting.
        Self(others.thread_swap_mask(SigmaskHow::SIG_BLOCK).unwrap_or_else(|_| SigSet::empty()))
    }
}

impl Drop for SignalMask {
    fn drop(&mut self) {
        let _ = self.0.thread_set_mask();
    }
}
