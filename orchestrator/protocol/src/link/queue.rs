//! Frames that wait for the recorder.

use std::collections::VecDeque;

use super::frame::HEAD;

/// Where in a frame stands how many wakes are missing before it: behind the time of the decision.
const MISSING: std::ops::Range<usize> = HEAD + 8..HEAD + 12;

/// Frames that are sent together.
const TOGETHER: usize = 64;

/// Wakes that wait, oldest first, in at most so many bytes.
#[derive(Debug)]
pub(super) struct Queue {
    frames: VecDeque<Frame>,
    bytes: usize,
    most: usize,
    /// How much of the first one is sent.
    sent: usize,
    /// Wakes that were left out since the last frame.
    missing: u32,
    /// Wakes without a trigger that were left out in all.
    pub(super) wakes_dropped: u64,
    /// Triggers for which there was no room.
    pub(super) triggers_lost: u64,
}

#[derive(Debug)]
struct Frame {
    bytes: Vec<u8>,
    triggers: usize,
}

impl Queue {
    pub(super) fn new(most: usize) -> Queue {
        Queue {
            frames: VecDeque::new(),
            bytes: 0,
            most,
            sent: 0,
            missing: 0,
            wakes_dropped: 0,
            triggers_lost: 0,
        }
    }

    /// Adds a wake as a frame. If there is no room, wakes without triggers go for one with
    /// triggers, the oldest first; else it goes itself. `false` if triggers are lost by that.
    pub(super) fn push(&mut self, bytes: &[u8], triggers: usize) -> bool {
        while self.bytes + bytes.len() > self.most {
            if triggers == 0 || !self.drop_one() {
                self.leave_out(triggers);
                return triggers == 0;
            }
        }
        let mut bytes = bytes.to_vec();
        add_missing(&mut bytes, self.missing);
        self.missing = 0;
        self.bytes += bytes.len();
        self.frames.push_back(Frame { bytes, triggers });
        true
    }

    /// A wake is left out that is not even a frame.
    pub(super) fn leave_out(&mut self, triggers: usize) {
        self.missing = self.missing.saturating_add(1);
        self.wakes_dropped += u64::from(triggers == 0);
        self.triggers_lost += triggers as u64;
    }

    /// Leaves out the oldest wake without triggers of which nothing is sent.
    fn drop_one(&mut self) -> bool {
        let begun = usize::from(self.sent > 0);
        let Some(index) = self.frames.iter().skip(begun).position(|frame| frame.triggers == 0)
        else {
            return false;
        };
        let Some(gone) = self.frames.remove(begun + index) else { return false };
        self.bytes -= gone.bytes.len();
        self.wakes_dropped += 1;
        let missing = missing(&gone.bytes).saturating_add(1);
        match self.frames.get_mut(begun + index) {
            Some(next) => add_missing(&mut next.bytes, missing),
            None => self.missing = self.missing.saturating_add(missing),
        }
        true
    }

    /// Leaves out all that waits.
    pub(super) fn give_up(&mut self) {
        for frame in std::mem::take(&mut self.frames) {
            self.leave_out(frame.triggers);
        }
        (self.bytes, self.sent) = (0, 0);
    }

    /// What is to be sent next.
    pub(super) fn next(&self) -> Option<&[u8]> {
        self.frames.front().map(|frame| &frame.bytes[self.sent..])
    }

    /// What is to be sent next, and what follows it, instead of what is in `bytes`.
    pub(super) fn together(&self, bytes: &mut Vec<u8>) {
        bytes.clear();
        let mut from = self.sent;
        for frame in self.frames.iter().take(TOGETHER) {
            bytes.extend_from_slice(&frame.bytes[from..]);
            from = 0;
        }
    }

    /// So much of that was sent.
    pub(super) fn sent(&mut self, bytes: usize) {
        self.sent += bytes;
        while let Some(frame) = self.frames.pop_front_if(|frame| frame.bytes.len() <= self.sent) {
            self.bytes -= frame.bytes.len();
            self.sent -= frame.bytes.len();
        }
    }

    /// Bytes that wait.
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

    /// A wake that is told from others by its first byte.
    fn wake(number: u8) -> Vec<u8> {
        let mut bytes = Vec::new();
        open(tag::WAKE, &mut bytes);
        bytes.extend([0; 12]);
        bytes.extend([number; 20]);
        assert!(close(&mut bytes));
        bytes
    }

    /// Of each frame that is left its number, and how many are missing before it.
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
    fn what_has_no_room_is_counted_in_the_frame_that_follows() {
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
    fn frames_go_together_and_are_cut_anywhere() {
        let mut queue = Queue::new(1 << 20);
        let all: Vec<u8> = (0..100).flat_map(wake).collect();
        (0..100).for_each(|number| assert!(queue.push(&wake(number), 0)));
        let (mut sent, mut bytes) = (Vec::new(), Vec::new());
        for step in (1..).map(|n| n * 37 % 500) {
            queue.together(&mut bytes);
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
    fn wakes_without_triggers_go_for_one_with_triggers() {
        let mut queue = Queue::new(3 * wake(0).len());
        for (number, triggers) in [(0, 0), (1, 1), (2, 0), (3, 2)] {
            assert!(queue.push(&wake(number), triggers));
        }
        assert_eq!(queue.wakes_dropped, 1);
        // One that is partly sent cannot be taken back.
        queue.sent(1);
        assert!(queue.push(&wake(4), 1), "2 goes");
        assert!(!queue.push(&wake(5), 3), "nothing is left that could");
        assert_eq!((queue.wakes_dropped, queue.triggers_lost), (2, 3));
        queue.sent(wake(0).len() - 1);
        assert!(queue.push(&wake(6), 0));
        assert_eq!(left(queue), [(3, 1), (4, 0), (6, 1)]);
    }
}
