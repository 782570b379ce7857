//! The queue of messages that were read ahead: lanes in the order of the drive, with one limit on
//! the bytes of all.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use gleaner_messages::Endian;

use crate::buffer::Buffer;

/// A message that waits until it is due.
#[derive(Debug)]
pub(crate) struct QueuedMessage {
    /// Index of its topic.
    pub(crate) topic: usize,
    /// Time at which it is due, in ns since the begin of the drive, earlier rounds included.
    pub(crate) at_ns: i64,
    /// Duration of the earlier rounds, in ns.
    pub(crate) rounds_ns: i64,
    pub(crate) endian: Endian,
    /// Encapsulation, CDR, and zeros up to a multiple of four.
    pub(crate) bytes: Buffer,
}

/// Memory of a message besides its bytes, so that small messages are bounded too.
const OVERHEAD: usize = 256;

impl QueuedMessage {
    fn cost(&self) -> usize {
        self.bytes.len() + OVERHEAD
    }
}

/// A bounded queue with one producer and one consumer per lane.
pub(crate) struct Queue<'s> {
    inner: Mutex<Inner>,
    changed: Condvar,
    budget: usize,
    stop: &'s AtomicBool,
}

struct Inner {
    lanes: Vec<VecDeque<QueuedMessage>>,
    /// Cost of all messages that are queued or being sent.
    held: usize,
    is_closed: bool,
}

/// Interval at which a waiting thread checks whether the player stops.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);

impl<'s> Queue<'s> {
    /// Creates a queue of `lanes` lanes that holds `budget` bytes, or one larger message.
    pub(crate) fn new(lanes: usize, budget: usize, stop: &'s AtomicBool) -> Queue<'s> {
        let lanes = std::iter::repeat_with(VecDeque::new).take(lanes).collect();
        let inner = Mutex::new(Inner { lanes, held: 0, is_closed: false });
        Queue { inner, changed: Condvar::new(), budget, stop }
    }

    pub(crate) fn lanes(&self) -> usize {
        self.lock().lanes.len()
    }

    /// Appends a message to its lane when there is room. Returns false if the player stops.
    pub(crate) fn push(&self, lane: usize, message: QueuedMessage) -> bool {
        let mut inner = self.lock();
        while inner.held > 0 && inner.held + message.cost() > self.budget {
            if self.is_stopping() {
                return false;
            }
            inner = self.sleep(inner);
        }
        inner.held += message.cost();
        inner.lanes[lane].push_back(message);
        self.changed.notify_all();
        !self.is_stopping()
    }

    /// Takes the next message of a lane; `None` after the last one, or if the player stops. Its
    /// cost counts until [`Self::sent`] is called with its length.
    pub(crate) fn pop(&self, lane: usize) -> Option<QueuedMessage> {
        let mut inner = self.lock();
        loop {
            if self.is_stopping() {
                return None;
            }
            match inner.lanes[lane].pop_front() {
                Some(message) => return Some(message),
                None if inner.is_closed => return None,
                None => inner = self.sleep(inner),
            }
        }
    }

    /// Releases the cost of a sent message of `bytes` bytes.
    pub(crate) fn sent(&self, bytes: usize) {
        let mut inner = self.lock();
        inner.held = inner.held.saturating_sub(bytes + OVERHEAD);
        self.changed.notify_all();
    }

    /// Marks the end: no more messages follow.
    pub(crate) fn close(&self) {
        self.lock().is_closed = true;
        self.changed.notify_all();
    }

    /// Waits until enough was read ahead to begin: half of the budget, everything, or as much as
    /// came within a second of the first message.
    pub(crate) fn wait_until_filled(&self) {
        let mut inner = self.lock();
        let mut checks = 0;
        while !inner.is_closed
            && inner.held <= self.budget / 2
            && checks < 10
            && !self.is_stopping()
        {
            checks += u32::from(inner.held > 0);
            let is_filling = |inner: &mut Inner| !inner.is_closed && inner.held <= self.budget / 2;
            inner = self
                .changed
                .wait_timeout_while(inner, CHECK_INTERVAL, is_filling)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
    }

    fn is_stopping(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn sleep<'g>(&self, inner: MutexGuard<'g, Inner>) -> MutexGuard<'g, Inner> {
        self.changed.wait_timeout(inner, CHECK_INTERVAL).unwrap_or_else(PoisonError::into_inner).0
    }

    /// Each change of the state is a single step, so it stays valid even if a thread panicked while
    /// it held the lock.
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(topic: usize, len: usize) -> QueuedMessage {
        QueuedMessage {
            topic,
            at_ns: 0,
            rounds_ns: 0,
            endian: Endian::Little,
            bytes: vec![0; len].into(),
        }
    }

    #[test]
    fn lanes_keep_their_order_and_end_when_the_queue_is_closed() {
        let stop = AtomicBool::new(false);
        let queue = Queue::new(2, 10_000, &stop);
        for (lane, topic) in [(0, 1), (1, 2), (0, 3)] {
            assert!(queue.push(lane, message(topic, 10)));
        }
        queue.close();
        let topics = |lane| {
            std::iter::from_fn(|| queue.pop(lane)).map(|message| message.topic).collect::<Vec<_>>()
        };
        assert_eq!((topics(0), topics(1)), (vec![1, 3], vec![2]));
    }

    #[test]
    fn a_full_queue_makes_its_reader_wait_until_a_message_was_sent() {
        let stop = AtomicBool::new(false);
        let queue = Queue::new(1, 1000, &stop);
        std::thread::scope(|scope| {
            let reader = scope.spawn(|| (0..100).all(|topic| queue.push(0, message(topic, 500))));
            for topic in 0..100 {
                let message = queue.pop(0).unwrap();
                assert_eq!(message.topic, topic);
                assert!(queue.lock().held <= 1000);
                queue.sent(message.bytes.len());
            }
            assert!(reader.join().unwrap());
        });
        assert_eq!(queue.lock().held, 0);
    }

    #[test]
    fn a_message_larger_than_the_budget_is_accepted_alone() {
        let stop = AtomicBool::new(false);
        let queue = Queue::new(1, 10, &stop);
        assert!(queue.push(0, message(0, 5000)));
        assert_eq!(queue.pop(0).unwrap().bytes.len(), 5000);
    }

    #[test]
    fn a_stop_wakes_the_producer_and_the_consumer() {
        let stop = AtomicBool::new(false);
        let queue = Queue::new(2, 10, &stop);
        assert!(queue.push(0, message(0, 10)));
        std::thread::scope(|scope| {
            let reader = scope.spawn(|| queue.push(0, message(1, 10)));
            let lane = scope.spawn(|| queue.pop(1).is_none());
            stop.store(true, Ordering::Relaxed);
            assert!(!reader.join().unwrap());
            assert!(lane.join().unwrap());
        });
    }
}
