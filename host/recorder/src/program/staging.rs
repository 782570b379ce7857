//! Samples on their way from the transport to the loop.
//!
//! Two blocks of memory: into one the transport's thread writes, the other is read by the loop, and they change places when
//! that one is empty. So a sample is copied once, nothing is allocated while samples come, and the lock is held for no longer
//! than it takes to copy one sample.

use std::hint::black_box;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Thread;

use gleaner_transport::{SampleMeta, Sink, Verdict};

use crate::TopicId;

/// Samples in a block.
const SAMPLES: usize = 64 << 10;

/// Distance at which memory is touched, so that the system gives it; no page is smaller.
const PAGE: usize = 4096;

/// A sample that waits.
#[derive(Copy, Clone, Debug)]
pub(super) struct Staged {
    pub(super) topic: TopicId,
    pub(super) meta: SampleMeta,
    /// Where its bytes are; `None`: there was no room for them.
    pub(super) bytes: Option<(usize, usize)>,
}

/// Samples in the order in which they came.
#[derive(Default)]
pub(super) struct Block {
    bytes: Vec<u8>,
    samples: Vec<Staged>,
}

impl Block {
    /// One for as many bytes, all of which is there at once.
    pub(super) fn new(bytes: usize) -> Block {
        let mut memory = vec![0_u8; bytes];
        memory.iter_mut().step_by(PAGE).for_each(|byte| *black_box(byte) = 0);
        memory.clear();
        Block { bytes: memory, samples: Vec::with_capacity(SAMPLES) }
    }

    pub(super) fn room(&self) -> usize {
        self.bytes.capacity()
    }

    pub(super) fn get(&self, index: usize) -> Option<(Staged, &[u8])> {
        let staged = *self.samples.get(index)?;
        let (at, len) = staged.bytes.unwrap_or_default();
        Some((staged, &self.bytes[at..at + len]))
    }

    pub(super) fn clear(&mut self) {
        self.bytes.clear();
        self.samples.clear();
    }
}

/// Where the sinks of all topics put samples.
pub(super) struct Staging {
    filling: Mutex<Block>,
    /// The loop, which looks by itself every few ms; it is woken only when half of the room is taken.
    reader: Thread,
}

impl Staging {
    pub(super) fn new(bytes: usize, reader: Thread) -> Arc<Staging> {
        Arc::new(Staging { filling: Mutex::new(Block::new(bytes)), reader })
    }

    /// Takes what came, for `empty`.
    pub(super) fn exchange(&self, empty: Block) -> Block {
        std::mem::replace(&mut *self.filling(), empty)
    }

    fn filling(&self) -> MutexGuard<'_, Block> {
        self.filling.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What came of one topic.
#[derive(Debug, Default)]
pub(super) struct Arrivals {
    pub(super) received: AtomicU64,
    pub(super) no_slot: AtomicU64,
    pub(super) too_big: AtomicU64,
}

/// Takes the samples of one topic.
pub(super) struct Lane {
    pub(super) topic: TopicId,
    pub(super) staging: Arc<Staging>,
    pub(super) arrivals: Arc<Arrivals>,
}

impl Sink for Lane {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Verdict {
        let mut block = self.staging.filling();
        let (at, room) = (block.bytes.len(), block.bytes.capacity());
        let verdict = match () {
            () if cdr.len() > room => Verdict::TooBig,
            () if cdr.len() > room - at || block.samples.len() == SAMPLES => Verdict::NoSlot,
            () => Verdict::Taken,
        };
        let taken = verdict == Verdict::Taken;
        if taken {
            block.bytes.extend_from_slice(cdr);
        }
        // A sample without room is still known to have been there. If there is no room even for that, its number will be missing.
        if block.samples.len() < SAMPLES {
            let bytes = taken.then_some((at, cdr.len()));
            block.samples.push(Staged { topic: self.topic, meta: *meta, bytes });
        }
        let is_late = block.bytes.len() > room / 2 || block.samples.len() > SAMPLES / 2;
        drop(block);
        match verdict {
            Verdict::Taken => &self.arrivals.received,
            Verdict::NoSlot => &self.arrivals.no_slot,
            Verdict::TooBig => &self.arrivals.too_big,
        }
        .fetch_add(1, Ordering::Relaxed);
        if is_late {
            self.staging.reader.unpark();
        }
        verdict
    }
}
