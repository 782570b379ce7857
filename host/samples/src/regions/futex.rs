//! The futex of the kernel, on memory that processes share.

use std::sync::atomic::AtomicU32;
use std::time::Duration;

use gleaner_buffers::shared::Futex;
use rustix::thread::futex;

#[derive(Debug, Clone, Copy, Default)]
pub struct KernelFutex;

impl Futex for KernelFutex {
    fn wait(&self, word: &AtomicU32, seen: u32, timeout: Duration) {
        let timeout = futex::Timespec {
            tv_sec: timeout.as_secs().try_into().unwrap_or(i64::MAX),
            tv_nsec: timeout.subsec_nanos().into(),
        };
        // Each error (another value, a signal, the timeout) only ends the sleep.
        let _ = futex::wait(word, futex::Flags::empty(), seen, Some(&timeout));
    }

    fn wake(&self, word: &AtomicU32) {
        // It fails only for an address without memory.
        let _ = futex::wake(word, futex::Flags::empty(), 1);
    }
}
