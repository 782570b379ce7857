//! Forwards signals to the runtime, notices that of its end, and reads the clock.

use std::io::{self, Read};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::process::{Signal, getpid, kill_process};
use rustix::time::{ClockId, clock_gettime};
use signal_hook::consts::{SIGCHLD, SIGHUP, SIGINT, SIGQUIT, SIGTERM};

const FORWARDED: [(i32, Signal); 4] = [
    (SIGTERM, Signal::TERM),
    (SIGINT, Signal::INT),
    (SIGHUP, Signal::HUP),
    (SIGQUIT, Signal::QUIT),
];

/// Signals received and not yet forwarded.
pub(crate) struct Signals {
    /// Becomes readable when a signal is received, or SIGCHLD at the end of a child.
    notified: UnixStream,
    received: [Arc<AtomicBool>; FORWARDED.len()],
}

impl Signals {
    /// Registers for the signals; they no longer end this process.
    pub(crate) fn register() -> io::Result<Self> {
        let (notified, notifier) = UnixStream::pair()?;
        notified.set_nonblocking(true)?;
        let received = std::array::from_fn(|_| Arc::new(AtomicBool::new(false)));
        for ((number, _), received) in FORWARDED.iter().zip(&received) {
            // The flag first: it must be set when `notified` becomes readable.
            signal_hook::flag::register(*number, Arc::clone(received))?;
            signal_hook::low_level::pipe::register(*number, notifier.try_clone()?)?;
        }
        // A handle of the process would need `pidfd_open`, which containers refuse.
        signal_hook::low_level::pipe::register(SIGCHLD, notifier)?;
        Ok(Self { notified, received })
    }

    /// Returns the file descriptor that becomes readable when a signal is received.
    pub(crate) fn as_fd(&self) -> BorrowedFd<'_> {
        self.notified.as_fd()
    }

    /// Returns the signals received since the last call.
    pub(crate) fn take(&mut self) -> impl Iterator<Item = Signal> + '_ {
        let mut buffer = [0; 64];
        while matches!(self.notified.read(&mut buffer), Ok(1..)) {}
        FORWARDED
            .iter()
            .zip(&self.received)
            .filter(|(_, received)| received.swap(false, Ordering::Relaxed))
            .map(|((_, signal), _)| *signal)
    }
}

/// Ends this process by `signal` if possible, and otherwise with an exit code that stands for it.
pub(crate) fn end_by(signal: i32) -> ! {
    if let Some(signal) = Signal::from_named_raw(signal) {
        // A registered handler would keep this process alive.
        let _ = signal_hook::low_level::emulate_default_handler(signal.as_raw());
        let _ = kill_process(getpid(), signal);
    }
    std::process::exit(128 + signal)
}

/// Returns the time of day, in ns since 1970.
pub(crate) fn time_of_day_ns() -> i64 {
    let now = clock_gettime(ClockId::Realtime);
    now.tv_sec.saturating_mul(1_000_000_000).saturating_add(now.tv_nsec)
}
