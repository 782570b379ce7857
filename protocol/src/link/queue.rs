//! The queue of frames for the recorder.

use std::collections::VecDeque;

use super::frame::HEAD;

/// Position in a frame of the number of missing wakes before it: after the time of the decision.
const MISSING: std::ops::Range<usize> = HEAD + 8..HEAD + 12;

/// Maximum number of frames sent together.
const BATCH: usize = 64;

/// Queued wakes, oldest first, up to a maximum number of bytes.
#[derive(Debug, Default)]
pub(super) struct Queue {
    frames: VecDeque<QueuedFrame>,
    bytes: usize,
    max_bytes: usize,
    /// Number of bytes of the first frame that are sent.
    sent: usize,
    /// Number of wakes dropped since the last frame.
    missing: u32,
    /// Total number of dropped wakes without a trigger.
    pub(super) wakes_dropped: u64,
    /// Total number of dropped triggers.
    pub(super) triggers_lost: u64,
}

#[derive(Debug)]
struct QueuedFrame {
    bytes: Vec<u8>,
    triggers: usize,
}

impl Queue {
    pub(super) fn new(max_bytes: usize) -> Queue {
        Queue { max_bytes, ..Queue::default() }
    }

    /// Adds a wake as a frame. If the queue is full, older wakes without triggers are dropped for
    /// one with triggers, the oldest first; otherwise the new wake is dropped. Returns `false` if
    /// triggers are lost.
    pub(super) fn push(&mut self, bytes: &[u8], triggers: usize) -> bool {
        while self.bytes + bytes.len() > self.max_bytes {
            if triggers == 0 || !self.drop_oldest() {
                self.count_dropped(triggers);
                return triggers == 0;
            }
        }
        let mut bytes = bytes.to_vec();
        add_missing(&mut bytes, self.missing);
        self.missing = 0;
        self.bytes += bytes.len();
        self.frames.push_back(QueuedFrame { bytes, triggers });
        true
    }

    pub(super) fn count_dropped(&mut self, triggers: usize) {
        self.missing = self.missing.saturating_add(1);
        self.wakes_dropped += u64::from(triggers == 0);
        self.triggers_lost += triggers as u64;
    }

    /// Drops the oldest wake without triggers of which nothing is sent. Returns `false` if there is
    /// none.
    fn drop_oldest(&mut self) -> bool {
        let started = usize::from(self.sent > 0);
        let Some(index) = self.frames.iter().skip(started).position(|frame| frame.triggers == 0)
        else {
            return false;
        };
        let Some(dropped) = self.frames.remove(started + index) else { return false };
        self.bytes -= dropped.bytes.len();
        self.wakes_dropped += 1;
        let missing = missing(&dropped.bytes).saturating_add(1);
        match self.frames.get_mut(started + index) {
            Some(next) => add_missing(&mut next.bytes, missing),
            None => self.missing = self.missing.saturating_add(missing),
        }
        true
    }

    pub(super) fn drop_all(&mut self) {
        for frame in std::mem::take(&mut self.frames) {
            self.count_dropped(frame.triggers);
        }
        (self.bytes, self.sent) = (0, 0);
    }

    /// Returns the bytes to send next.
    pub(super) fn next(&self) -> Option<&[u8]> {
        self.frames.front().map(|frame| &frame.bytes[self.sent..])
    }

    /// Replaces `bytes` by the next frames to send.
    pub(super) fn next_batch(&self, bytes: &mut Vec<u8>) {
        bytes.clear();
        let mut from = self.sent;
        for frame in self.frames.iter().take(BATCH) {
            bytes.extend_from_slice(&frame.bytes[from..]);
            from = 0;
        }
    }

    /// Removes the first `bytes` bytes, which were sent.
    pub(super) fn sent(&mut self, bytes: usize) {
        self.sent += bytes;
        while let Some(frame) = self.frames.pop_front_if(|frame| frame.bytes.len() <= self.sent) {
            self.bytes -= frame.bytes.len();
            self.sent -= frame.bytes.len();
        }
    }

    /// Makes the first frame be sent from its start again, over another connection.
    pub(super) fn send_again(&mut self) {
        self.sent = 0;
    }

    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }
}

fn missing(frame: &[u8]) -> u32 {
    frame.get(MISSING).and_then(|bytes| bytes.try_into().ok()).map_or(0, u32::from_le_bytes)
}

fn add_missing(frame: &mut [u8], count: u32) {
    let sum = missing(frame).saturating_add(count);
    if let Some(bytes) = frame.get_mut(MISSING) {
        bytes.copy_from_slice(&sum.to_le_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::frame::{close, open, tag};

    /// Returns a wake with `number` as its content.
    fn wake(number: u8) -> Vec<u8> {
        let mut bytes = Vec::new();
        open(tag::WAKE, &mut bytes);
        bytes.extend([0; 12]);
        bytes.extend([number; 20]);
        assert!(close(&mut bytes));
        bytes
    }

    /// Returns the number of each remaining frame, and the number of missing wakes before it.
    fn left(mut queue: Queue) -> Vec<(u8, u32)> {
        let mut left = Vec::new();
        while let Some(next) = queue.next() {
            left.push((next[next.len() - 1], missing(next)));
            let len = next.len();
            queue.sent(len);
        }
        assert_eq!(queue.bytes, 0);
        left
    }

    #[test]
    fn dropped_wakes_are_counted_in_the_next_frame() {
        let mut queue = Queue::new(3 * wake(0).len());
        for number in 0..5 {
            assert!(queue.push(&wake(number), 0));
        }
        queue.sent(wake(0).len());
        assert!(queue.push(&wake(5), 0));
        assert_eq!((queue.wakes_dropped, queue.triggers_lost), (2, 0));
        assert_eq!(left(queue), [(1, 0), (2, 0), (5, 2)]);
    }

    #[test]
    fn frames_are_sent_in_batches_and_cut_anywhere() {
        let mut queue = Queue::new(1 << 20);
        let all: Vec<u8> = (0..100).flat_map(wake).collect();
        (0..100).for_each(|number| assert!(queue.push(&wake(number), 0)));
        let (mut sent, mut bytes) = (Vec::new(), Vec::new());
        for step in (1..).map(|n| n * 37 % 500) {
            queue.next_batch(&mut bytes);
            let step = step.min(bytes.len());
            sent.extend_from_slice(&bytes[..step]);
            queue.sent(step);
            if queue.next().is_none() {
                break;
            }
        }
        assert!(sent == all && queue.bytes() == 0);
    }

    #[test]
    fn wakes_without_triggers_are_dropped_for_one_with_triggers() {
        let mut queue = Queue::new(3 * wake(0).len());
        for (number, triggers) in [(0, 0), (1, 1), (2, 0), (3, 2)] {
            assert!(queue.push(&wake(number), triggers));
        }
        assert_eq!(queue.wakes_dropped, 1);
        // It is sent again from its start.
        queue.sent(1);
        queue.send_again();
        assert_eq!(queue.next().map(<[u8]>::len), Some(wake(0).len()));
        // A partly sent frame cannot be dropped.
        queue.sent(1);
        assert!(queue.push(&wake(4), 1), "2 is dropped");
        assert!(!queue.push(&wake(5), 3), "no other can be dropped");
        assert_eq!((queue.wakes_dropped, queue.triggers_lost), (2, 3));
        queue.sent(wake(0).len() - 1);
        assert!(queue.push(&wake(6), 0));
        assert_eq!(left(queue), [(3, 1), (4, 0), (6, 1)]);
    }
}
