//! Keeps signals away from the threads of RustDDS, which end for ever at the first wait that is
//! interrupted (`src/rtps/dp_event_loop.rs`, `event_loop`; `src/discovery/discovery.rs`,
//! `discovery_event_loop`).
//!
//! It takes less than a handler to interrupt one: SIGCHLD, which is ignored, goes to some other
//! thread while the first one is about to start a process, and ends the wait there. What stops a
//! whole process (SIGSTOP, a debugger, a frozen container, suspend) cannot be kept away;
//! [`Health::dead`](gleaner_transport::Health::dead) tells.

use nix::sys::signal::{SigSet, SigmaskHow, Signal};

/// While it lives, this thread takes no signals, and neither do threads, as long as they live, that
/// it starts meanwhile.
pub(super) struct Shield(SigSet);

/// Those of a thread's own mistakes: blocked, they would end the process without a word.
const MISTAKES: [Signal; 4] = [Signal::SIGSEGV, Signal::SIGBUS, Signal::SIGILL, Signal::SIGFPE];

impl Shield {
    pub(super) fn up() -> Self {
        let mut others = SigSet::all();
        MISTAKES.into_iter().for_each(|signal| others.remove(signal));
        // It can only fail for a way of setting that does not exist.
        Self(others.thread_swap_mask(SigmaskHow::SIG_BLOCK).unwrap_or_else(|_| SigSet::empty()))
    }
}

impl Drop for Shield {
    fn drop(&mut self) {
        let _ = self.0.thread_set_mask();
    }
}
