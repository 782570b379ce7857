//! Wakes a reader through a futex word on its own control page.

use std::time::Duration;

use super::bell_fence;
use super::control::{ControlMemory, MappedControl};
use crate::sync::{AtomicU32, Ordering};

/// The two operations of a futex, which the standard library does not have.
pub trait Futex {
    /// Sleeps while `word` is `seen`, until a wake, `timeout` or, at times, for no reason.
    fn wait(&self, word: &AtomicU32, seen: u32, timeout: Duration);
    /// Wakes one thread that sleeps on `word`. Never blocks: a hostile reader could let thousands
    /// of threads sleep there.
    fn wake(&self, word: &AtomicU32);
}

/// The bell of one reader. One thread of the reader waits for it; the writer rings it.
///
/// A ring between the reader's look at its topics and its sleep is not missed: the reader stores
/// `waiting`, fences, and sleeps only while the bell has the value from before its look; the writer
/// raises the bell, fences, and loads `waiting`. If the writer sees 0, its fence came first, and
/// the reader's comparison sees the raised bell.
pub struct Notifier(MappedControl);

impl Notifier {
    pub fn of(memory: impl ControlMemory) -> Self {
        Self(MappedControl::new(memory))
    }

    /// Rings. Never blocks, whatever the reader wrote to its page.
    pub fn ring(&self, futex: &impl Futex) {
        let control = self.0.control();
        control.bell.fetch_add(1, Ordering::Release);
        bell_fence();
        if control.waiting.load(Ordering::Relaxed) != 0 {
            futex.wake(&control.bell);
        }
    }

    /// The value of the bell, to be read before the reader looks at its topics.
    pub fn value(&self) -> u32 {
        self.0.control().bell.load(Ordering::Acquire)
    }

    /// Sleeps until the bell differs from `seen`, for `timeout` at most.
    pub fn wait(&mut self, seen: u32, timeout: Duration, futex: &impl Futex) {
        let control = self.0.control();
        control.waiting.store(1, Ordering::Relaxed);
        bell_fence();
        // Compares again, after the fence.
        futex.wait(&control.bell, seen, timeout);
        control.waiting.store(0, Ordering::Relaxed);
    }
}
