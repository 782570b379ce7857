//! Stages samples between the transport and the loop.
//!
//! There are two blocks of memory: the transport's thread writes one, the loop reads the other, and
//! they are swapped when that one is empty. Nothing is allocated per sample. A sample is copied
//! here once, from the transport's memory, before its metadata is known: it counts when it is
//! accepted.
//!
//! The loop never waits for a copy: during a copy the transport has the block, and the loop tries
//! again later. The transport's thread waits for the loop only if a copy that is not accepted yet
//! has to be moved behind accepted samples, once for each such copy.

use std::hint::black_box;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Thread;

use gleaner_transport::{Delivery, SampleMeta, Sink};

use crate::TopicId;

/// Maximum number of samples in a block.
const SAMPLES: usize = 64 << 10;

/// Distance at which memory is touched, so that the system allocates it; no page is smaller.
const PAGE: usize = 4096;

/// A staged sample.
#[derive(Copy, Clone, Debug)]
pub(super) struct Staged {
    pub(super) topic: TopicId,
    pub(super) meta: SampleMeta,
    /// Position and length of its bytes; `None`: there was no room for them.
    pub(super) bytes: Option<(usize, usize)>,
}

/// Staged samples in order of arrival.
#[derive(Default)]
pub(super) struct Block {
    bytes: Vec<u8>,
    samples: Vec<Staged>,
}

impl Block {
    /// Creates a block for this many bytes, all of them allocated at once.
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

/// The staging area of the sinks of all topics. They are all called by one thread, the transport's.
pub(super) struct Staging {
    filling: Mutex<Filling>,
    /// The thread of the loop, which checks by itself every few ms; it is unparked only when half
    /// of the room is taken.
    reader: Thread,
}

struct Filling {
    /// `None` while a sample is being copied into it.
    block: Option<Block>,
    /// The last copy, until it is accepted.
    copied: Option<Copied>,
}

/// A sample whose bytes are the last ones of the block, or that was refused.
struct Copied {
    topic: TopicId,
    delivery: Delivery,
    /// Start of its bytes, which reach to the end of the block.
    at: usize,
    /// True if the loop has requested the block once since.
    is_awaited: bool,
}

impl Staging {
    pub(super) fn new(bytes: usize, reader: Thread) -> Arc<Staging> {
        let filling = Filling { block: Some(Block::new(bytes)), copied: None };
        Arc::new(Staging { filling: Mutex::new(filling), reader })
    }

    /// Swaps the filled block for `empty`, which has at least as much room. Returns `empty` as the
    /// error while a sample is being copied or about to be accepted: the caller tries again later.
    pub(super) fn exchange(&self, mut empty: Block) -> Result<Block, Block> {
        let mut filling = self.filling();
        let Filling { block: Some(block), copied } = &mut *filling else { return Err(empty) };
        if let Some(copied) = copied.as_mut().filter(|copied| copied.delivery == Delivery::Taken) {
            if !copied.is_awaited {
                copied.is_awaited = true;
                return Err(empty);
            }
            // It may never be accepted, or its thread was interrupted. Earlier samples do not wait
            // for it: it moves to the next block. Alone it stays where it is.
            if block.samples.is_empty() {
                return Ok(empty);
            }
            empty.bytes.extend_from_slice(&block.bytes[copied.at..]);
            block.bytes.truncate(copied.at);
            copied.at = 0;
        }
        Ok(std::mem::replace(block, empty))
    }

    /// Copies a sample into the block: the only copy that is made of it.
    fn fill(&self, topic: TopicId, cdr: &[u8]) -> Delivery {
        let mut filling = self.filling();
        let unaccepted = filling.copied.take();
        // All samples come from one thread, so there is no other copy in progress.
        let Some(mut block) = filling.block.take() else { return Delivery::NoSlot };
        drop(filling);
        // A copy that was never accepted is dropped.
        if let Some(copied) = unaccepted {
            block.bytes.truncate(copied.at);
        }
        let (at, room) = (block.bytes.len(), block.bytes.capacity());
        let delivery = match () {
            () if cdr.len() > room => Delivery::TooBig,
            () if cdr.len() > room - at || block.samples.len() == SAMPLES => Delivery::NoSlot,
            () => Delivery::Taken,
        };
        if delivery == Delivery::Taken {
            block.bytes.extend_from_slice(cdr);
        }
        let mut filling = self.filling();
        filling.block = Some(block);
        filling.copied = Some(Copied { topic, delivery, at, is_awaited: false });
        delivery
    }

    /// Accepts the last copy as this sample of `topic`. Returns the delivery that was decided when
    /// it was copied; `None` if there is no copy for `topic`.
    fn accept(&self, topic: TopicId, meta: &SampleMeta) -> Option<Delivery> {
        let mut filling = self.filling();
        let copied = filling.copied.take_if(|copied| copied.topic == topic)?;
        let block = filling.block.as_mut()?;
        // A sample without room is still recorded as present. If there is no room even for that,
        // its number will be missing.
        if block.samples.len() < SAMPLES {
            let bytes = (copied.delivery == Delivery::Taken)
                .then(|| (copied.at, block.bytes.len() - copied.at));
            block.samples.push(Staged { topic, meta: *meta, bytes });
        }
        let is_late = block.bytes.len() > block.room() / 2 || block.samples.len() > SAMPLES / 2;
        drop(filling);
        if is_late {
            self.reader.unpark();
        }
        Some(copied.delivery)
    }

    fn filling(&self) -> MutexGuard<'_, Filling> {
        self.filling.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Counts of one topic.
#[derive(Debug, Default)]
pub(super) struct Arrivals {
    pub(super) received: AtomicU64,
    pub(super) no_slot: AtomicU64,
    pub(super) too_big: AtomicU64,
}

/// The sink of one topic.
pub(super) struct TopicSink {
    pub(super) topic: TopicId,
    pub(super) staging: Arc<Staging>,
    pub(super) arrivals: Arc<Arrivals>,
}

impl Sink for TopicSink {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        let delivery = self.staging.fill(self.topic, cdr);
        self.accept(meta);
        delivery
    }

    fn copy(&self, cdr: &[u8]) -> Option<Delivery> {
        Some(self.staging.fill(self.topic, cdr))
    }

    fn accept(&self, meta: &SampleMeta) {
        let arrivals = match self.staging.accept(self.topic, meta) {
            Some(Delivery::Taken) => &self.arrivals.received,
            Some(Delivery::NoSlot) => &self.arrivals.no_slot,
            Some(Delivery::TooBig) => &self.arrivals.too_big,
            None => return,
        };
        arrivals.fetch_add(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::support::{TestDir, meta, topic};

    /// Creates a staging area for 100 bytes, and the sinks of two topics.
    fn sinks() -> (Arc<Staging>, [TopicSink; 2]) {
        let scratch = TestDir::new();
        let mut recorder = scratch.recorder(|_| {});
        let staging = Staging::new(100, std::thread::current());
        let sinks = ["/a", "/b"].map(|name| TopicSink {
            topic: recorder.add_topic(topic(name)).unwrap(),
            staging: Arc::clone(&staging),
            arrivals: Arc::default(),
        });
        (staging, sinks)
    }

    /// Topic, number and bytes of a staged sample; `None` for one without room.
    type StagedEntry = (TopicId, u64, Option<Vec<u8>>);

    fn staged(block: &Block) -> Vec<StagedEntry> {
        let entry = |(staged, cdr): (Staged, &[u8])| {
            (staged.topic, staged.meta.seq, staged.bytes.map(|_| cdr.to_vec()))
        };
        (0..).map_while(|index| block.get(index).map(entry)).collect()
    }

    fn take(staging: &Staging) -> Vec<StagedEntry> {
        staged(&staging.exchange(Block::new(100)).ok().expect("nothing is being copied"))
    }

    #[test]
    fn a_copy_is_staged_once_it_is_accepted() {
        let (staging, [a, b]) = sinks();
        assert_eq!(a.copy(b"first"), Some(Delivery::Taken));
        a.accept(&meta(1, 1));
        assert_eq!(b.deliver(&meta(2, 2), b"second"), Delivery::Taken);
        a.accept(&meta(3, 3));
        b.accept(&meta(3, 3));
        let expected =
            [(a.topic, 1, Some(b"first".to_vec())), (b.topic, 2, Some(b"second".to_vec()))];
        assert_eq!(take(&staging), expected, "nothing else was accepted");
        assert_eq!(a.arrivals.received.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn copies_that_are_never_accepted_take_no_room_and_delay_no_sample() {
        let (staging, [a, b]) = sinks();
        b.deliver(&meta(1, 1), b"before");
        for _ in 0..10 {
            assert_eq!(a.copy(&[7; 60]), Some(Delivery::Taken));
        }
        let empty =
            staging.exchange(Block::new(100)).err().expect("it may be accepted at any time");
        let block = staging.exchange(empty).ok().expect("or never");
        assert_eq!(staged(&block), [(b.topic, 1, Some(b"before".to_vec()))]);
        assert_eq!(b.deliver(&meta(2, 2), &[8; 100]), Delivery::Taken, "its room is free again");
        a.accept(&meta(3, 3));
        assert_eq!(take(&staging), [(b.topic, 2, Some(vec![8; 100]))]);
    }

    #[test]
    fn a_copy_that_waits_alone_is_not_moved() {
        let (staging, [a, _]) = sinks();
        a.copy(b"late");
        let mut empty =
            staging.exchange(Block::new(100)).err().expect("it may be accepted at any time");
        for _ in 0..3 {
            empty = staging.exchange(empty).ok().expect("nothing to take");
            assert!(empty.bytes.is_empty());
        }
        a.accept(&meta(1, 1));
        assert_eq!(take(&staging), [(a.topic, 1, Some(b"late".to_vec()))]);
    }

    #[test]
    fn a_copy_that_is_accepted_late_is_in_the_next_block() {
        let (staging, [a, b]) = sinks();
        b.deliver(&meta(1, 1), b"before");
        a.copy(b"late");
        let empty =
            staging.exchange(Block::new(100)).err().expect("it may be accepted at any time");
        assert!(staging.exchange(empty).is_ok());
        a.accept(&meta(2, 2));
        b.deliver(&meta(3, 3), b"after");
        assert_eq!(
            take(&staging),
            [(a.topic, 2, Some(b"late".to_vec())), (b.topic, 3, Some(b"after".to_vec()))]
        );
    }

    #[test]
    fn a_sample_without_room_is_counted_and_recorded_as_present() {
        let (staging, [a, b]) = sinks();
        assert_eq!(a.copy(&[0; 101]), Some(Delivery::TooBig));
        a.accept(&meta(1, 1));
        assert_eq!(a.copy(&[1; 60]), Some(Delivery::Taken));
        a.accept(&meta(2, 2));
        assert_eq!(b.copy(&[2; 60]), Some(Delivery::NoSlot));
        b.accept(&meta(3, 3));
        assert_eq!(
            take(&staging),
            [(a.topic, 1, None), (a.topic, 2, Some(vec![1; 60])), (b.topic, 3, None)]
        );
        let counts = |sink: &TopicSink| {
            let Arrivals { received, no_slot, too_big } = &*sink.arrivals;
            [received, no_slot, too_big].map(|count| count.load(Ordering::Relaxed))
        };
        assert_eq!((counts(&a), counts(&b)), ([1, 0, 1], [0, 1, 0]));
    }
}
