//! Signals that are meant for the runtime, and the clock.

use std::io::{self, Read};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::process::{Signal, getpid, kill_process};
use rustix::time::{ClockId, clock_gettime};
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM};

/// What somebody may send us to say it to the runtime.
const PASSED_ON: [(i32, Signal); 4] = [
    (SIGTERM, Signal::TERM),
    (SIGINT, Signal::INT),
    (SIGHUP, Signal::HUP),
    (SIGQUIT, Signal::QUIT),
];

/// Signals that came.
pub(crate) struct Signals {
    bell: UnixStream,
    came: [Arc<AtomicBool>; PASSED_ON.len()],
}

impl Signals {
    /// From now on they end nothing here.
    pub(crate) fn hear() -> io::Result<Self> {
        let (bell, ring) = UnixStream::pair()?;
        bell.set_nonblocking(true)?;
        let came = std::array::from_fn(|_| Arc::new(AtomicBool::new(false)));
        for ((number, _), came) in PASSED_ON.iter().zip(&came) {
            // The flag first: who hears the bell must find it.
            signal_hook::flag::register(*number, Arc::clone(came))?;
            signal_hook::low_level::pipe::register(*number, ring.try_clone()?)?;
        }
        Ok(Self { bell, came })
    }

    /// Becomes readable when a signal has come.
    pub(crate) fn bell(&self) -> BorrowedFd<'_> {
        self.bell.as_fd()
    }

    /// Those that came since the last call.
    pub(crate) fn take(&mut self) -> impl Iterator<Item = Signal> + '_ {
        let mut heard = [0; 64];
        while matches!(self.bell.read(&mut heard), Ok(1..)) {}
        PASSED_ON
            .iter()
            .zip(&self.came)
            .filter(|(_, came)| came.swap(false, Ordering::Relaxed))
            .map(|((_, it), _)| *it)
    }
}

/// Ends this process by `signal`, as far as that is possible; else returns nothing and the exit
/// code has to tell it.
pub(crate) fn end_by(signal: i32) -> ! {
    if let Some(signal) = Signal::from_named_raw(signal) {
        // A handler of ours, or none, would let us live.
        let _ = signal_hook::low_level::emulate_default_handler(signal.as_raw());
        let _ = kill_process(getpid(), signal);
    }
    std::process::exit(128 + signal)
}

/// The time of day, in ns since 1970.
pub(crate) fn time_of_day_ns() -> i64 {
    let now = clock_gettime(ClockId::Realtime);
    now.tv_sec.saturating_mul(1_000_000_000).saturating_add(now.tv_nsec)
}
