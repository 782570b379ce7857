//! What a source has lost from the preroll, so that a window which reaches over it can say so.

use std::collections::VecDeque;

/// Stamps that are remembered of each source and cause. A window that reaches further back cannot
/// be told how many.
const REMEMBERED: usize = 4096;

/// What one source has lost.
#[derive(Debug, Default)]
pub struct Losses {
    /// Pushed out for want of bytes.
    pub overwritten: Gone,
    /// Larger than the store.
    pub too_big: Gone,
    /// Older than any window reaches, unless its trigger comes late.
    pub aged: Horizon,
    /// Lost before it came here, at the stamps of what came next.
    pub lost: Gone,
}

/// Stamps of what went for one cause.
#[derive(Debug, Default)]
pub struct Gone {
    /// Stamp, the group in whose clips it is, and how many went at once.
    stamps: VecDeque<(i64, u64, u64)>,
    forgotten: Horizon,
}

impl Gone {
    /// Something of stamp `at` went; it is in the clips of group `group`, 0 for none.
    pub fn add(&mut self, at: i64, group: u64) {
        self.add_some(at, group, 1);
    }

    /// As [`add`](Self::add), for so many at once.
    pub fn add_some(&mut self, at: i64, group: u64, count: u64) {
        if self.stamps.len() == REMEMBERED
            && let Some((at, group, _)) = self.stamps.pop_front()
        {
            self.forgotten.add(at, group);
        }
        self.stamps.push_back((at, group, count));
    }

    /// One of those that went last and are in no clip's count has come after all.
    pub fn take_back(&mut self) {
        if let Some((_, _, count)) =
            self.stamps.iter_mut().rev().find(|(_, group, count)| *group == 0 && *count > 0)
        {
            *count -= 1;
        }
    }

    /// How many of those that `covered` wants are missing from the clips of group `group`. They are
    /// counted once.
    pub fn count(&mut self, group: u64, covered: impl Fn(i64) -> bool) -> u64 {
        let missing =
            self.stamps.iter_mut().filter(|(at, in_clip, _)| *in_clip != group && covered(*at));
        missing
            .map(|(_, in_clip, count)| {
                *in_clip = group;
                *count
            })
            .fold(0, u64::saturating_add)
    }

    /// Whether more may have gone, from `from` on, than is remembered.
    pub fn is_unknown(&self, from: i64, group: u64) -> bool {
        self.forgotten.hides(from, group)
    }
}

/// Up to where something is missing.
#[derive(Debug)]
pub struct Horizon {
    /// Newest stamp of what is in no clip.
    unwritten: i64,
    /// The group into whose clips something went last, and its newest stamp.
    written: (u64, i64),
}

impl Default for Horizon {
    fn default() -> Horizon {
        Horizon { unwritten: i64::MIN, written: (0, i64::MIN) }
    }
}

impl Horizon {
    /// Something of stamp `at` is gone; it is in the clips of group `group`, 0 for none.
    pub fn add(&mut self, at: i64, group: u64) {
        if group == 0 {
            self.unwritten = self.unwritten.max(at);
        } else if group == self.written.0 {
            self.written.1 = self.written.1.max(at);
        } else {
            // For any later group, what is in the clips of an earlier one is missing as well.
            self.unwritten = self.unwritten.max(self.written.1);
            self.written = (group, at);
        }
    }

    /// Whether a window of group `group` that begins at `from` reaches over something that is in
    /// none of its clips.
    pub fn hides(&self, from: i64, group: u64) -> bool {
        from <= self.unwritten || (group != self.written.0 && from <= self.written.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_missing_is_counted_once_for_each_group_of_windows() {
        let mut gone = Gone::default();
        for at in 0..10 {
            gone.add(at, if at < 3 { 7 } else { 0 });
        }
        assert_eq!(gone.count(7, |at| at < 5), 2, "three of five are in its clips");
        assert_eq!(gone.count(7, |at| at < 6), 1);
        assert_eq!(gone.count(8, |at| at < 6), 6);
        assert!(!gone.is_unknown(0, 7));
    }

    #[test]
    fn beyond_what_is_remembered_nobody_knows() {
        let mut gone = Gone::default();
        for at in 0..REMEMBERED as i64 + 10 {
            gone.add(at, 0);
        }
        assert!(gone.is_unknown(9, 1) && !gone.is_unknown(10, 1));
    }

    #[test]
    fn what_is_in_a_clip_is_not_missing_from_it_when_it_ages() {
        let mut aged = Horizon::default();
        aged.add(5, 0);
        aged.add(9, 2);
        assert!(!aged.hides(6, 2) && aged.hides(5, 2) && aged.hides(6, 3) && !aged.hides(10, 3));
        aged.add(12, 3);
        assert!(aged.hides(9, 3) && !aged.hides(10, 3));
    }
}
